"""Conditioning: a degauss by the driver, in a worker thread, and after it the newest of the requests that wait.

A degauss that was begun goes on: a newer request takes the place of the one that waits, a cancelled one leaves the
mirror at mid range with its history known.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from dm_msgs.msg import FocusRequest, FocusState
from dm_msgs.srv import Degauss
from rclpy.node import Node

from dm_common.errors import ErrorCode, Refusal
from dm_common.ros.worker import ServiceCallError, call
from dm_controller.driver_watch import DriverWatch

#: Half-swings that the driver does when it is not told how many, as far as can be known from here.
STEPS_ASSUMED = 100
#: Longest wait for the report of a degauss that has been answered, s.
REPORT_S = 2.0


class Waiting:
    """A request that waits for the end of a degauss.

    Attributes:
        request: what is to be carried out.
        state: what became of it; None until then.
    """

    def __init__(self, request: FocusRequest) -> None:
        self.request = request
        self.state: FocusState | None = None
        self._done = threading.Event()

    @property
    def done(self) -> bool:
        return self._done.is_set()

    def finish(self, state: FocusState) -> None:
        """Tell what became of it; only the first call counts."""
        if not self.done:
            self.state = state
            self._done.set()


class Conditioner:
    """Degausses through the service of the driver.

    Args:
        node: hosts the client.
        values: parameter `condition.timeout`.
        turn: held while a request is judged and carried out, so that none comes between; `submit` needs it.
        carry_out: executes a request right after a degauss of `steps` half-swings; called in the worker thread.
        refuse: makes, and publishes, the state of a request that could not be conditioned for.
        degausses: the driver's count, as far as it has been followed.
        driver: tells when a driver that degausses is no longer there.
        on_learnt: called when the time that a degauss takes has been measured.

    Attributes:
        busy: a degauss of this node is under way.
        steps: half-swings of it; 0 = as configured in the driver.
    """

    def __init__(
        self,
        node: Node,
        values: Mapping[str, Any],
        turn: threading.RLock,
        carry_out: Callable[[FocusRequest, int], FocusState],
        refuse: Callable[[FocusRequest, Refusal], FocusState],
        degausses: Callable[[], int],
        driver: DriverWatch,
        on_learnt: Callable[[], None],
    ) -> None:
        self._driver = driver
        self._values, self._turn = values, turn
        self._carry_out, self._refuse, self._degausses, self._on_learnt = carry_out, refuse, degausses, on_learnt
        self._client = node.create_client(Degauss, "degauss")
        self._waiting: Waiting | None = None
        self.busy = False
        self._begun = 0.0
        self._learnt: dict[int, float] = {}
        self.steps = 0

    def duration(self, steps: int, slew_rate: float, span: float) -> float:
        """Time in s that a degauss of `steps` half-swings (0 = as the driver does) takes; 0 = not known.

        As the last one took; before the first from the way, which is half the span per half-swing, and the slew rate.
        """
        if steps in self._learnt:
            return self._learnt[steps]
        for known, seconds in self._learnt.items():
            if known and steps:
                return seconds * steps / known
        if not math.isfinite(slew_rate):
            return 0.0
        return (0.5 * span * (steps or STEPS_ASSUMED) + span) / slew_rate

    def remaining(self, slew_rate: float, span: float) -> float:
        """Time in s until the degauss under way should end."""
        return max(0.0, self.duration(self.steps, slew_rate, span) - (time.monotonic() - self._begun))

    def check_service(self) -> None:
        """Raise Refusal when there is no driver that could degauss."""
        if not self._client.service_is_ready():
            raise Refusal(ErrorCode.DRIVER_UNAVAILABLE, "service degauss: pdm_driver does not offer it (yet)")

    def submit(self, request: FocusRequest, steps: int) -> Waiting:
        """Carry out `request` after a degauss of `steps`, or after the one under way; the newest request wins."""
        waiting = Waiting(request)
        with self._turn:
            old, self._waiting = self._waiting, waiting
            begin, self.busy = not self.busy, True
            if begin:
                self.steps, self._begun = steps, time.monotonic()
            if old is not None:
                self._preempt(old)
        if begin:
            threading.Thread(target=self._work, args=(steps,), daemon=True).start()
        return waiting

    def drop(self, waiting: Waiting) -> bool:
        """Do not carry out `waiting` after all; the degauss under way goes on. False = it is too late for that."""
        with self._turn:
            dropped = self._waiting is waiting
            if dropped:
                self._waiting = None
            return dropped

    def _preempt(self, old: Waiting) -> None:
        refusal = Refusal(ErrorCode.PREEMPTED, "a newer request took its place during the degauss")
        old.finish(self._refuse(old.request, refusal))

    def _work(self, steps: int) -> None:
        refusal: Refusal | None = None
        try:
            self._degauss(steps)
        except Refusal as error:
            refusal = error
        except Exception as error:  # a defect must not leave the node waiting for ever
            refusal = Refusal(ErrorCode.INTERNAL, f"{type(error).__name__}: {error}")
        with self._turn:
            waiting, self._waiting, self.busy = self._waiting, None, False
            if waiting is None:
                return
            if refusal is not None:
                waiting.finish(self._refuse(waiting.request, refusal))
            else:
                waiting.finish(self._carry_out(waiting.request, steps))

    def _degauss(self, steps: int) -> None:
        before, starts = self._degausses(), self._driver.starts

        def gone() -> str:
            return "pdm_driver was restarted" if self._driver.starts != starts else self._driver.stopped

        try:
            # A driver that is killed or stopped never answers; its successor knows nothing of the degauss.
            response = call(
                self._client, Degauss.Request(steps=steps), self._values["condition.timeout"], lambda: bool(gone())
            )
        except ServiceCallError as error:
            raise Refusal(ErrorCode.DRIVER_UNAVAILABLE, f"conditioning: {gone() or error}") from error
        if response.error_code != ErrorCode.OK:
            raise Refusal(response.error_code, f"conditioning: {response.message}")
        self._learnt[steps] = response.duration
        self._on_learnt()
        deadline = time.monotonic() + REPORT_S
        while self._degausses() <= before:
            if time.monotonic() > deadline:
                raise Refusal(ErrorCode.TIMEOUT, "conditioning: the driver did not report the degauss as complete")
            time.sleep(0.002)
