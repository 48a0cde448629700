"""Holding a shape: predicted creep is corrected in small steps, whenever the shape would leave its tolerance.

Creep slows down with the age of a shape, so corrections become rarer: after an hour they are minutes apart.
The hold keeps the effective signals of the move. Each correction inverts the hysteresis model from the state that
follows from the driver's reports, so it also makes up for the rounding and slew limit of earlier corrections.

A shape that was set from an unknown history is held too: creep is known from the moves that were seen, and its error is
a small part of a small correction. If the history is lost during a hold, the hold ends: the state is then only a guess,
which does not describe the shape that the mirror holds.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dm_common import Floats
from dm_common.errors import ErrorCode
from dm_common.hysteresis.observer import ActuatorEstimate
from dm_common.limits import same_signals
from dm_controller.driver_monitor import DriverMonitor
from dm_controller.focus_types import Effect, Log, Moment

#: Shortest time between two corrections unless configured otherwise, s. Creep follows the logarithm of time: it does as
#: much from 0.05 to 0.5 s as from 1 to 10 s.
PERIOD_S = 0.02
#: A shape that needs no correction is checked again after this share of the time since the last command.
CHECK_SHARE = 0.1
#: Time within which the driver reports a command as its own, s, steady; after that, other signals are another client's.
CONFIRM_S = 1.0


class CreepHold:
    """Holds the shape commanded last, that of `monitor.order`, against creep; the parameters `hold.*` are read live.

    Attributes:
        corrections: number sent so far.
        ended: the reason why the last hold ended.
    """

    def __init__(self, values: Mapping[str, Any], monitor: DriverMonitor) -> None:
        self._values, self._monitor = values, monitor
        self.corrections = 0
        self.ended = ""
        self._told_of = int(ErrorCode.OK)  # the driver's refusal that was logged since a correction was taken

    @property
    def active(self) -> bool:
        """Whether a shape is held."""
        return self._monitor.order is not None and self._monitor.order.creep_held

    @property
    def next_check(self) -> float:
        """When a correction can be due, s; infinite without a shape to hold."""
        order = self._monitor.order
        if order is None or order.command is None or not order.creep_held:
            return math.inf
        sent = order.command.sent.time
        return max(sent + self._values["hold.period"], order.checked + CHECK_SHARE * (order.checked - sent))

    def not_confirmed(self) -> None:
        """The driver has not taken the last command: go on holding the shape before it, if it is still there."""
        previous = self._monitor.previous_order
        self.end("the driver did not accept the command")
        if previous is not None:
            self._monitor.order = previous

    def end(self, reason: str) -> None:
        """Leave the shape as it is, and forget the one before."""
        if (order := self._monitor.order) is not None:
            order.previous_order = None
            if order.creep_held:
                order.creep_held, self.ended = False, reason

    def driver_requested(self, requested: Sequence[float] | Floats, now: float) -> None:
        """End the hold if the signals (N,) that the driver follows, reported at `now` (s, steady), are another's."""
        order = self._monitor.order
        if order is None or order.command is None or same_signals(requested, order.command.signals):
            return
        command = order.command
        # `DriverMonitor.unconfirmed` judges the first command, which may be on its way for longer.
        due = command.confirmed or (command.expected_turns and now - command.sent.steady > CONFIRM_S)
        if due and not order.follow(requested):  # else a correction was lost, or one that seemed lost has come
            self.end("another command came")

    def command(self, estimate: ActuatorEstimate, now: Moment) -> list[Effect]:
        """The corrections that are due for the shape, by the driver's last report and the estimate for `now`.

        They are sent again until the driver takes one; a refusal, perhaps of another client's command, is logged once.
        """
        order, report = self._monitor.order, self._monitor.latest
        if order is None or not order.creep_held or report is None or report.moving:
            return []
        if report.holder not in ("", order.request.holder):
            return []  # goes on afterwards if the holder leaves the shape as it is
        if (signals := self.correction(estimate, now.time)) is None:
            return []
        news: list[Effect] = []
        if order.sent[-1].confirmed:
            self._told_of = int(ErrorCode.OK)
        elif report.error_code not in (ErrorCode.OK, self._told_of):
            self._told_of = report.error_code
            text = f"a correction for creep was not taken; the driver's last refusal: {report.message}"
            news.append(Log("warning", text))
        return [*news, order.send(signals, now, report.turns)]

    def correction(self, estimate: ActuatorEstimate, now: float) -> Floats | None:
        """The next command (N,) at `now` (s) for a mirror at rest in the state `estimate`; None = none is due."""
        order, values = self._monitor.order, self._values
        if order is None or not order.creep_held or estimate.state is None:
            return None
        assert order.active is not None and order.move is not None and order.command is not None
        planner, move, command = order.active.planner, order.move, order.command
        if not command.confirmed:
            return None
        if move.known and not estimate.known:
            self.end(f"the history of the actuators was lost: {estimate.unknown}")
            return None
        if not values["hold.enable"]:
            self.end("hold.enable is false")
            return None
        # The clock may have been set back.
        command.sent = command.sent._replace(time=min(command.sent.time, now))
        order.checked = min(order.checked, now)
        if now < self.next_check:
            return None
        order.checked = now
        if planner.drift(estimate.state, now, move.effective) <= values["hold.tolerance"]:
            return None
        # The next interval is about as long as the last one; the shape is to be right in its middle.
        ahead = 0.5 * (now - command.sent.time)
        change = planner.hold(estimate.state, now, move.effective, ahead) - estimate.state.signals
        largest = float(np.abs(change).max())
        if largest <= 0.5 * values["hold.resolution"]:
            return None
        self.corrections += 1
        return estimate.state.signals + change * min(1.0, values["hold.slew"] / largest)
