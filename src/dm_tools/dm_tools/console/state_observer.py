"""Effective signals now and at the time of a map, from the driver's reports and the hysteresis of the calibration."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.hysteresis.observer import ActuatorEstimate, HysteresisObserver
from dm_common.messages import applied_from, hysteresis_model_from

Floats = NDArray[np.float64]


class SettledState(NamedTuple):
    """The mirror at one moment.

    Attributes:
        effective: (N,); None = not known.
        doubt: the reason why it is a guess only or not known; "" = it is known.
    """

    effective: Floats | None
    doubt: str


class StateObserver:
    """Follows one mirror. May be asked from any thread.

    Attributes:
        fault: the reason why the hysteresis of the calibration is not followed; "" = it is.
    """

    def __init__(self) -> None:
        self._observer = HysteresisObserver()
        self._moved_before: bool | None = None
        self.fault = ""

    @property
    def law(self) -> HysteresisModel:
        """The law that is followed; the linear one when no hysteresis was identified."""
        return self._observer.law

    @property
    def creep_before(self) -> bool:
        """Whether moves before the first report still creep, which not even a degauss makes known."""
        return bool(self._moved_before) and self.law.creep_rate > 0.0

    def use(self, calibration: Any, middle: float) -> None:
        """Follow the law of a dm_msgs/Calibration from now on."""
        try:
            law, self.fault = hysteresis_model_from(calibration.hysteresis), ""
        except ValueError as error:
            law, self.fault = None, str(error)
        self._observer.use(law if law is not None else HysteresisModel.linear(), middle)

    def observe(self, message: Any) -> None:
        """Take the driver's next dm_msgs/ActuatorState."""
        if self._moved_before is None:
            self._moved_before = message.turns > 0
        try:
            self._observer.observe(applied_from(message))
        except ValueError:
            pass  # another mirror, or numbers that are none: the estimate says so

    def state(self) -> HysteresisState | None:
        """The last state; None before the first report."""
        return self._observer.state

    def now(self, time: float) -> SettledState:
        """The mirror at `time` (s, ROS time), taken as not before the last report."""
        return self._settled(ActuatorEstimate(self._observer.state, self._observer.unknown), time)

    def at(self, time: float) -> SettledState:
        """The mirror at `time` (s), which may lie before the last report."""
        found = self._observer.at(time)
        if found is None:
            return SettledState(None, "no report of the driver is as old as this map")
        return self._settled(found, time)

    def _settled(self, estimate: ActuatorEstimate, time: float) -> SettledState:
        law, state = self._observer.law, estimate.state
        if state is None:
            return SettledState(None, "the driver has not reported yet")
        if state.play.shape[1] != len(law.play_radius):
            return SettledState(None, "the calibration is being replaced")
        return SettledState(law.effective(law.advance(state, time)), estimate.unknown)
