"""Holding a shape: creep is fed forward in small corrections, as often as the shape would leave its tolerance.

Creep slows down with the age of a shape, so corrections come in ever longer intervals: after an hour in minutes.
What is kept are the effective signals of the move. Each correction is the inverse of the hysteresis model from the
state that the driver reports, so that what was rounded or cut short is made good by the next.

A shape that was set from an unknown history is held too: creep is known from the moves that were seen, and its error is
a small part of a small correction. When the history gets lost during a hold, the hold ends: the guess that replaces the
state says nothing of where the shape stands.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dm_common.hysteresis.model import HysteresisModel
from dm_common.hysteresis.observer import ActuatorEstimate
from dm_controller.driver_monitor import SAME_SIGNAL
from dm_controller.planning.planner import Planner

Floats = NDArray[np.float64]

#: Shortest time between two corrections unless configured otherwise, s. Creep follows the logarithm of time: it does as
#: much from 0.05 to 0.5 s as from 1 to 10 s.
PERIOD_S = 0.02
#: A shape that needs no correction is checked again after this share of the time since the last command.
CHECK_SHARE = 0.1
#: Time for the driver to report a command as its own, s; after it another publisher has overtaken it.
CONFIRM_S = 1.0


@dataclass
class _Held:
    planner: Planner
    effective: Floats
    known: bool
    signals: Floats
    sent: float
    checked: float
    confirmed: bool = False


class CreepHold:
    """At most one shape.

    Args:
        values: parameters `hold.*`, live.

    Attributes:
        corrections: sent so far.
        ended: the reason why the last hold ended.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        self._held: _Held | None = None
        self.corrections = 0
        self.ended = ""

    @property
    def active(self) -> bool:
        return self._held is not None

    @property
    def next_check(self) -> float:
        """When a correction can be due, s; infinite without a shape to hold."""
        held = self._held
        if held is None:
            return math.inf
        return max(held.sent + self._values["hold.period"], held.checked + CHECK_SHARE * (held.checked - held.sent))

    def would_keep(self, law: HysteresisModel) -> bool:
        """Whether a shape under `law` will be held."""
        return bool(self._values["hold.enable"]) and law.creep_rate > 0.0

    def begin(self, planner: Planner, effective: Floats, signals: Floats, now: float, known: bool) -> None:
        """Hold `effective` (N,) after the command `signals` (N,) sent at `now` (s)."""
        self._held = None
        if self.would_keep(planner.law):
            self._held = _Held(planner, effective, known, signals, now, now)

    def end(self, reason: str) -> None:
        """Leave the shape as it stands."""
        if self._held is not None:
            self._held, self.ended = None, reason

    def driver_requested(self, requested: Floats, now: float) -> None:
        """What the driver reports as its last request (N,): the hold ends when it is another's."""
        held = self._held
        if held is None:
            return
        if requested.shape == held.signals.shape and np.abs(requested - held.signals).max() <= SAME_SIGNAL:
            held.confirmed = True
        elif held.confirmed or now - held.sent > CONFIRM_S:
            self.end("another command came")

    def correction(self, estimate: ActuatorEstimate, now: float) -> Floats | None:
        """The next command (N,) at `now` (s), the mirror being at rest in the state `estimate`; None = not yet."""
        held, values = self._held, self._values
        if held is None or estimate.state is None or not held.confirmed:
            return None
        if held.known and not estimate.known:
            self.end(f"the history of the actuators was lost: {estimate.unknown}")
            return None
        if not values["hold.enable"]:
            self.end("hold.enable is false")
            return None
        held.sent, held.checked = min(held.sent, now), min(held.checked, now)  # the clock was set back
        if now < self.next_check:
            return None
        held.checked = now
        if held.planner.drift(estimate.state, now, held.effective) <= values["hold.tolerance"]:
            return None
        # The interval to come is about as long as the one that ends; the shape is to be right in its middle.
        ahead = 0.5 * (now - held.sent)
        change = held.planner.hold(estimate.state, now, held.effective, ahead) - estimate.state.signals
        largest = float(np.abs(change).max())
        if largest < 0.5 * values["hold.resolution"]:
            return None
        return estimate.state.signals + change * min(1.0, values["hold.slew"] / largest)

    def sent(self, signals: Floats, now: float) -> None:
        """A correction went out."""
        held = self._held
        if held is not None:
            held.signals, held.sent, held.confirmed = signals, now, False
            self.corrections += 1
