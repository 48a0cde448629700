"""A degauss on the way to a shape: which order waits for it, how long it takes, and when it has failed.

A degauss, once begun, is completed. A newer order replaces the one that waits; after a cancel the degauss leaves the
mirror at mid range with a known history. Times are those of the steady clock, s.
"""

import math
from dataclasses import dataclass

from dm_common.errors import ErrorCode, Refusal
from dm_controller.driver_monitor import DriverMonitor
from dm_controller.focus_types import Order
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.choice import Degauss

#: Half-swings assumed where the driver uses its own configured number, which is not known here.
STEPS_ASSUMED = 100
#: Longest time between the driver's answer that a degauss is done and the report that counts it, s.
REPORT_S = 2.0


@dataclass
class Run:
    """A degauss under way.

    Attributes:
        number: identifies the run.
        steps: half-swings; 0 = as configured in the driver.
        began: when, s.
        degausses, starts: degausses and restarts of the driver that had been counted before it.
        answered: s, when the driver said that it is done; None = not yet.
    """

    number: int
    steps: int
    began: float
    degausses: int
    starts: int
    answered: float | None = None


class Conditioning:
    """At most one degauss at a time, and the order that waits for its end.

    Attributes:
        run: the degauss under way; None = there is none.
        order: the order that waits; None = none does.
    """

    def __init__(self) -> None:
        self.run: Run | None = None
        self.order: Order | None = None
        self._number = 0
        self._learnt: dict[int, float] = {}
        self._learnt_at = (math.nan, math.nan)  # slew rate and half range under which they were learnt

    def duration(self, steps: int, active: ActiveCalibration) -> float:
        """Time in s that a degauss of `steps` half-swings (0 = as configured in the driver) takes; 0 = not known.

        As measured on the last one; before the first, from the path (half the span per half-swing) and the slew rate.
        """
        slew_rate, half_span = active.planner.slew_rate, active.mirror.limits.half_range
        if (slew_rate, half_span) != self._learnt_at:  # another mirror, or another configuration
            self._learnt, self._learnt_at = {}, (slew_rate, half_span)
        if steps in self._learnt:
            return self._learnt[steps]
        for known, seconds in self._learnt.items():
            if known and steps:
                return seconds * steps / known
        if not math.isfinite(slew_rate):
            return 0.0
        return half_span * ((steps or STEPS_ASSUMED) + 2) / slew_rate

    def expected_degauss(self, active: ActiveCalibration, configured: int, now: float) -> Degauss:
        """The degauss that a move would wait for: the one under way, or a new one of `configured` half-swings."""
        run = self.run
        if run is None:
            steps = active.degauss_steps(configured)
            return Degauss(steps, False, self.duration(steps, active))
        return Degauss(run.steps, True, max(0.0, self.duration(run.steps, active) - (now - run.began)))

    def begin(self, steps: int, monitor: DriverMonitor, now: float) -> int:
        """Note that a degauss begins; returns the number of the run."""
        self._number += 1
        report = monitor.latest
        degausses = report.degausses if report is not None else 0
        self.run = Run(self._number, steps, now, degausses, monitor.starts)
        return self._number

    def wait(self, order: Order) -> Order | None:
        """Let `order` wait; returns the order that it replaces."""
        before, self.order = self.order, order
        order.pending = True
        return before

    def withdraw(self, order: Order) -> bool:
        """Do not carry out `order` after all; returns False if it does not wait (any more)."""
        waits = self.order is order
        if waits:
            self.order, order.pending = None, False
        return waits

    def answered(self, duration: float, now: float) -> None:
        """Note that the driver has answered the run under way, which took `duration` s, as done."""
        if self.run is not None:
            self.run.answered = now
            self._learnt[self.run.steps] = duration

    def reported(self, monitor: DriverMonitor) -> bool:
        """Whether the driver has answered and reported the degauss as complete."""
        run, report = self.run, monitor.latest
        if run is None or run.answered is None or report is None:
            return False
        return report.degausses > run.degausses

    def failure(self, monitor: DriverMonitor, timeout: float, now: float) -> Refusal | None:
        """The reason why the degauss under way cannot succeed any more; None = it can."""
        run = self.run
        if run is None:
            return None
        if run.answered is not None:
            if now - run.answered <= REPORT_S:
                return None
            return Refusal(ErrorCode.TIMEOUT, "conditioning: the driver did not report the degauss as complete")
        # A driver that is killed or stopped never answers; its successor knows nothing of the degauss.
        cause = "pdm_driver was restarted" if monitor.starts != run.starts else monitor.stopped(now)
        if not cause and now - run.began > timeout:
            cause = f"degauss: no answer within {timeout:g} s"
        return Refusal(ErrorCode.DRIVER_UNAVAILABLE, f"conditioning: {cause}") if cause else None

    def end(self) -> Order | None:
        """Note that the degauss has ended; returns the order that waited for it."""
        order, self.order, self.run = self.order, None, None
        if order is not None:
            order.pending = False
        return order
