"""Effective signals now and at the time of a map, from what the focus controller publishes of the actuators."""

from __future__ import annotations

import math
from collections import deque
from typing import Any, NamedTuple

import numpy as np

from dm_common import Floats
from dm_common.hysteresis.model import HysteresisModel
from dm_common.hysteresis.observer import ESTIMATES_KEPT, ActuatorEstimate
from dm_common.messages import estimate_from, hysteresis_model_from, seconds

#: Creep left by shapes held unobserved is reported above this standard deviation, as a share of a full-range shape.
CREEP_UNSEEN = 0.05
#: A move that is not in the controller's estimate after this time counts as not followed, s.
LATE_S = 1.0


class EffectiveSignals(NamedTuple):
    """Effective signals at one moment.

    Attributes:
        effective: (N,); None = not known.
        doubt: the reason why it is only a guess or not known; "" = it is known.
    """

    effective: Floats | None
    doubt: str

    def near(self, other: EffectiveSignals, tolerance: float = 0.0) -> bool:
        """Whether both have the same doubt, and signals that differ by no more than `tolerance`."""
        mine, theirs = (np.array(each.effective, dtype=np.float64) for each in (self, other))  # None becomes NaN
        alike = self.doubt == other.doubt and mine.shape == theirs.shape
        return alike and np.allclose(mine, theirs, rtol=0.0, atol=tolerance, equal_nan=True)


class StateObserver:
    """Keeps the latest estimates of one mirror. May be queried from any thread.

    Attributes:
        law: of the calibration; the linear one when no hysteresis was identified.
        fault: the reason why the hysteresis of the calibration is not followed; "" = it is.
    """

    def __init__(self) -> None:
        self.law, self.fault = HysteresisModel.linear(), ""
        self._calibration = ""  # its id; an update by later maps is a new revision with the same law
        self._estimates: deque[tuple[str, ActuatorEstimate]] = deque(maxlen=ESTIMATES_KEPT)
        self._reported: Any = None

    def use(self, calibration: Any) -> None:
        """Use a dm_msgs/Calibration from now on."""
        try:
            law, self.fault = hysteresis_model_from(calibration.hysteresis), ""
        except ValueError as error:
            law, self.fault = None, str(error)
        self.law = law if law is not None else HysteresisModel.linear()
        self._calibration = calibration.id

    def take(self, message: Any) -> None:
        """Take the controller's next dm_msgs/ActuatorEstimate."""
        try:
            estimate = estimate_from(message)
        except ValueError as error:
            estimate = ActuatorEstimate(None, f"actuator_estimate: {error}")
        self._estimates.append((message.calibration_id, estimate))

    def observe(self, message: Any) -> None:
        """Take the driver's next dm_msgs/ActuatorState."""
        self._reported = message

    def latest(self) -> ActuatorEstimate:
        """The last estimate under the calibration in use."""
        return self._before(math.inf)

    @property
    def creep_unseen(self) -> bool:
        """Whether creep is expected from shapes that were held before the controller followed the mirror."""
        state = self.latest().state
        return state is not None and bool((state.crept_sigma > CREEP_UNSEEN).any())

    def now(self, time: float) -> EffectiveSignals:
        """Effective signals at `time` (s, ROS time), taken as no earlier than the last estimate."""
        estimate, reported = self.latest(), self._reported
        if estimate.state is not None and not estimate.unknown and reported is not None and not reported.moving:
            applied = np.array(reported.applied)
            late = time > seconds(reported.header.stamp) + LATE_S
            if late and not np.array_equal(applied, estimate.state.signals):
                estimate = estimate._replace(unknown="focus_controller has not followed the last move")
        return self._settled(estimate, time)

    def at(self, time: float) -> EffectiveSignals:
        """Effective signals at `time` (s), which may lie before the last estimate."""
        return self._settled(self._before(time), time)

    def _before(self, time: float) -> ActuatorEstimate:
        """The last estimate at or before `time` (s)."""
        kept = list(self._estimates)
        if not kept:
            return ActuatorEstimate(None, "focus_controller has not said yet where the actuators stand")
        own = [estimate for calibration, estimate in kept if calibration == self._calibration]
        if not own:
            return ActuatorEstimate(None, "focus_controller does not use this calibration")
        fitting = (estimate for estimate in reversed(own) if estimate.state is None or estimate.state.time <= time)
        return next(fitting, ActuatorEstimate(None, "no estimate of the actuators from the time of this map"))

    def _settled(self, estimate: ActuatorEstimate, time: float) -> EffectiveSignals:
        state = estimate.state
        if state is None:
            return EffectiveSignals(None, estimate.unknown)
        if (state.play.shape[1], state.crept.shape[1]) != (len(self.law.play_radius), len(self.law.creep_time)):
            return EffectiveSignals(None, "the calibration is being replaced")
        return EffectiveSignals(self.law.effective(self.law.advance(state, time)), estimate.unknown)
