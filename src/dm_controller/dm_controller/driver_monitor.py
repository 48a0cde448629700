"""The driver's last report, whether reports still come, whether it took the last command, and its latency.

A driver that was stopped or killed sends nothing: its last report would say for ever that it is active. So reports
expire here, by the steady clock, and a command that no report confirms in time counts as not taken.
"""

import math
import statistics
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from dm_msgs.msg import ActuatorState, FocusRequest

from dm_common.errors import ErrorCode, Refusal
from dm_common.limits import same_signals
from dm_common.messages import driver_refusal, stamp_ns
from dm_common.mirror import counts_anew
from dm_controller.focus_types import Effect, Log, Moment, Order, Progress, PublishState

#: States that a driver does not leave by itself, unlike a lost link.
_STOPPED = (ActuatorState.STATE_UNCONFIGURED, ActuatorState.STATE_INACTIVE, ActuatorState.STATE_SAFING)
#: Longest wait until the driver confirms a command where `driver_timeout` sets none, s.
CONFIRM_S = 3.0
#: A clock that gains this much on the steady one between two reports, s, was set, or the computer slept.
CLOCK_JUMP_S = 5.0
#: Number of moves whose median latency is taken.
MOVES = 20
#: Longer latencies, s, are ignored: the driver's stamps come from another clock, or its report came late.
LATENCY_MAX_S = 1.0
#: Progress of an order whose shape somebody else has replaced.
SUPERSEDED = Progress(failed=Refusal(ErrorCode.PREEMPTED, "another command took over"))


class DriverMonitor:
    """Judges the driver by its reports, `driver_timeout` and `move_timeout`. Methods take steady times, s.

    Attributes:
        order: the order whose shape was commanded last; None = none was yet.
        latest: the driver's last report; None before the first.
        starts: number of times the driver was activated anew, as far as reports show.
        open_until: s, until when anybody may send commands without a `check`.
        loss: what happened to a driver that is known to be dead, as a sentence; "" = it may live.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        self.order: Order | None = None
        self.latest: ActuatorState | None = None
        self.starts = 0
        self.open_until = -math.inf
        self.loss = ""
        self._heard = 0.0
        # s: ROS minus steady time, and how far stamps are ahead of each; infinite until known, which shows no gain.
        self._drift, self._ahead = math.inf, (math.inf, math.inf)
        self._stamp: int | None = None
        self._latencies: deque[float] = deque(maxlen=MOVES)

    @property
    def latency(self) -> float:
        """s from a command to the driver's first write of it, median; 0 = not known."""
        return statistics.median(self._latencies) if self._latencies else 0.0

    @property
    def previous_order(self) -> Order | None:
        """The previous order, while the driver holds its shape and has not taken the last order's first command."""
        previous, report = self.order.previous_order if self.order is not None else None, self.latest
        return previous if previous is not None and report is not None and previous.has_sent(report.requested) else None

    @property
    def shape(self) -> Order | None:
        """The last order, if the driver reports its shape, with or without the latest creep corrections; else None."""
        order, report = self.order, self.latest
        if order is None or order.move is None or order.stopped or report is None:
            return None
        return order if order.has_sent(report.requested) else None

    def lost(self, reason: str) -> None:
        """Note what happened to a driver that is known to be dead, as a sentence; "" = it may live."""
        self.loss = reason
        self._trust()  # a parameter may have changed, too

    def observe(self, report: ActuatorState, now: float) -> bool:
        """Take the driver's next report; returns True if it is the first to make the latency known."""
        before, self.latest, self._heard = self.latest, report, now
        self.loss = ""  # a driver that reports is alive
        anew = before is not None and counts_anew(report, before)
        self.starts += anew
        self._trust()
        command = self.order.command if self.order is not None else None
        if command is None or command.confirmed:
            return False
        # A driver that is not active may stand in this shape by itself.
        active = report.driver_state == ActuatorState.STATE_ACTIVE
        command.confirmed = active and same_signals(report.requested, command.signals)
        written = stamp_ns(report.header.stamp)
        seconds = 1e-9 * (written - command.sent.ns)
        # The command may still be on its way to a driver that was active before it was sent.
        command.lost |= anew and (not active or written > command.sent.ns)
        if not command.confirmed or not 0.0 <= seconds <= LATENCY_MAX_S:
            return False
        self._latencies.append(seconds)
        return len(self._latencies) == 1

    def clock_gain(self, report: ActuatorState, now: Moment) -> float:
        """s by which this clock, or that of the stamps, has jumped ahead since the last report; 0 in simulated time."""
        drift, stamp = now.time - now.steady, stamp_ns(report.header.stamp)
        gain = drift - self._drift
        # The driver's clock may be on another machine, and a stamp is repeated while the mirror rests: only a new one
        # shows how far ahead that clock is. It must gain on both clocks here, since one may have been set back.
        if stamp and self._stamp not in (None, stamp):
            ahead = max(0.0, 1e-9 * stamp - now.time)
            gain = max(gain, min(ahead - self._ahead[0], ahead + drift - self._ahead[1]))
            self._ahead = ahead, ahead + drift
        self._drift, self._stamp = drift, stamp
        return gain if gain > CLOCK_JUMP_S and not now.simulated else 0.0

    def _trust(self) -> None:
        report, limit = self.latest, self._values["driver_timeout"] or math.inf
        is_open = report is not None and report.driver_state == ActuatorState.STATE_ACTIVE and not report.holder
        self.open_until = self._heard + limit if is_open and not self.loss else -math.inf

    def silent(self, now: float) -> str:
        """Why the driver counts as silent, as a sentence; "" = it reports, or never did."""
        if self.loss:
            return self.loss
        limit = self._values["driver_timeout"]
        age = now - self._heard
        if self.latest is None or not limit or age <= limit:
            return ""
        return f"pdm_driver has not reported for {age:.1f} s (driver_timeout {limit:g} s): is it running?"

    def refusal(self, now: float) -> Refusal | None:
        """The reason why the driver takes no commands, by its last report and its age; None = it takes them."""
        if (refusal := driver_refusal(self.latest)) is not None and not self.loss:
            return refusal
        if silent := self.silent(now):
            return Refusal(ErrorCode.DRIVER_UNAVAILABLE, silent)
        return None

    def check(self, request: FocusRequest, now: float) -> None:
        """Raise the Refusal that `refusal` or `held` returns, if any."""
        if refusal := self.refusal(now) or self.held(request):
            raise refusal

    def held(self, request: FocusRequest) -> Refusal | None:
        """The refusal if somebody else holds the mirror and `request` does not take it over; None = it may have it."""
        report = self.latest
        if report is None or report.holder in ("", request.holder) or request.take_over:
            return None
        return Refusal(ErrorCode.BUSY, report.holding)

    def settled(self, replaced: str = "") -> list[PublishState]:
        """Publish the outcome of the last order's command, once: confirmed, or not because it was `replaced`."""
        order = self.order
        if order is None or order.command is None or order.answered or not (order.command.confirmed or replaced):
            return []
        order.answered, order.applied = True, order.command.confirmed
        order.previous_order = None if order.applied else order.previous_order
        order.refusal = None if order.applied else Refusal(ErrorCode.PREEMPTED, replaced)
        return [PublishState(order)]

    def stopped(self, now: float) -> str:
        """The reason why the driver cannot finish what it has begun; "" = it can: a lost link comes back."""
        report = self.latest
        if report is not None and report.driver_state in _STOPPED and not self.loss:
            return "pdm_driver left its active state" + (f" ({report.message})" if report.message else "")
        return self.silent(now)

    def keeps(self, order: Order) -> bool:
        """Whether the last command keeps the shape of `order`, possibly corrected for creep."""
        last = self.order
        if order.move is None or last is None or last.move is None or last.stopped:
            return False
        return same_signals(order.move.signals, last.move.signals)

    def progress(self, order: Order, now: float) -> Progress:
        """How far the driver is with `order`."""
        if order.refusal is not None:
            return Progress(failed=order.refusal)
        assert order.move is not None
        waited = now - order.began.steady
        if order.pending:
            expected = order.move.duration
            return Progress(True, min(1.0, waited / expected) if expected > 0.0 else 0.0)
        if not self.keeps(order):
            return SUPERSEDED
        assert self.order is not None and self.order.command is not None  # else nothing keeps a shape
        signals, last = order.move.signals, self.order.command
        report = self.latest
        if report is not None and (refusal := driver_refusal(report)) is not None:
            return Progress(failed=refusal)
        if silent := self.silent(now):
            return Progress(failed=Refusal(ErrorCode.DRIVER_UNAVAILABLE, silent))
        gap = share = 0.0
        if report is not None and len(report.requested) == len(report.applied) == len(signals):
            gap = float(np.abs(np.asarray(report.applied) - signals).max())
            order.gap = max(order.gap, gap)
            share = 1.0 - gap / order.gap if order.gap else 1.0
            ours = any(same_signals(report.requested, own) for own in (signals, last.signals))
            if ours and not report.moving:
                return Progress(share=1.0, remaining=gap, reached=True)
            if not ours and order.starts != self.starts:
                return Progress(failed=Refusal(ErrorCode.DRIVER_UNAVAILABLE, "pdm_driver was restarted meanwhile"))
            # A correction follows a command that was confirmed: what was not sent for this shape is another client's.
            foreign = last.expected_turns and not self.order.has_sent(report.requested)
            if not ours and (last.confirmed or last.given_up or foreign):
                return SUPERSEDED
        # Since its last command: a correction for creep may come long after the first.
        if now - last.sent.steady > self._values["move_timeout"]:
            text = report.message if report is not None else ""
            return Progress(failed=Refusal(ErrorCode.TIMEOUT, text or "the driver did not report the shape"))
        return Progress(share=share, remaining=gap)

    def ended_early(self, now: float, failed: Refusal | None = None) -> list[Effect]:
        """Publish that a shape is not reached, once, if the driver took the command and something ended the move; and
        that it is, if a driver that was not heard has reached it nevertheless.

        A move that takes longer than `move_timeout` may still end well: only `move_focus` gives up on it.

        Args:
            failed: what ends it now; None = whatever `progress` finds.
        """
        order = self.order
        if order is None or order.reached or order.stopped:
            return []
        if not order.applied:
            return self._reached_nevertheless(order, now)
        if failed is None:
            progress = self.progress(order, now)
            order.reached, failed = progress.reached, progress.failed
        if failed is None or failed.error_code == ErrorCode.TIMEOUT:
            return []
        order.applied, order.refusal = False, failed
        return [Log("warning", f"the shape was not reached: {failed}"), PublishState(order)]

    def _reached_nevertheless(self, order: Order, now: float) -> list[Effect]:
        """Publish, once, that a driver that was not heard for a while has ended the move well."""
        told = order.refusal
        if told is None or told.error_code != ErrorCode.DRIVER_UNAVAILABLE or order.move is None:
            return []
        if not self.progress(replace(order, refusal=None), now).reached:
            return []
        order.applied, order.reached, order.refusal = True, True, None
        return [PublishState(order)]

    def cancelled(self, now: float) -> list[Effect]:
        """Publish that the last order is cancelled, once, unless the mirror has stood in its shape."""
        on_its_way = self.ended_early(now, Refusal(ErrorCode.CANCELED, "it was cancelled on its way"))
        return [*self.settled("it was cancelled before the driver confirmed it"), *on_its_way]

    def unconfirmed(self, now: float) -> Refusal | None:
        """The reason why the driver has not confirmed the last command in time, once; None = there is none.

        Only the latest command counts, as at the driver.
        """
        if self.order is None or (command := self.order.command) is None or command.confirmed or command.given_up:
            return None
        limit = self._values["driver_timeout"] or CONFIRM_S
        if not (command.lost or self.loss or now - command.sent.steady > limit):
            return None
        command.given_up = True
        text = "the driver has not confirmed the command"
        if command.lost:
            return Refusal(ErrorCode.DRIVER_UNAVAILABLE, f"{text}: pdm_driver was restarted meanwhile")
        if (refusal := self.refusal(now)) is not None:
            return Refusal(refusal.error_code, f"{text}: {refusal}")
        report = self.latest
        assert report is not None  # else there had been a refusal
        if self._heard < command.sent.steady:
            return Refusal(ErrorCode.TIMEOUT, f"{text} and has not reported since: is it running?")
        if command.expected_turns:  # a creep correction, which was lost, or which another client's command overtook
            self.order.follow(report.requested)  # an error may belong to any client's command
            return None
        if report.error_code != ErrorCode.OK:
            return Refusal(report.error_code, f"{text}: {report.message}")
        if stamp_ns(report.header.stamp) < command.sent.ns:
            return Refusal(ErrorCode.TIMEOUT, f"{text}: it holds the earlier shape, no command has reached it since")
        return Refusal(ErrorCode.PREEMPTED, f"{text}: it follows another command")
