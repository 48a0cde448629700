"""The message `focus_state`: what was made of a request."""

from __future__ import annotations

import array

import numpy as np
from dm_msgs.msg import FocusRequest, FocusState

from dm_controller.conversions import doubles
from dm_controller.decision import Decision
from dm_controller.prediction import Forecast


def state_of(request: FocusRequest) -> FocusState:
    """What was asked for."""
    return FocusState(
        curvature=request.curvature,
        power=2 * request.curvature,
        conic_constant=request.conic_constant,
        mode=request.mode,
    )


def fill_state(state: FocusState, calibration_id: str, decision: Decision, forecast: Forecast | None) -> None:
    """Tell what was decided and what is to be expected.

    Args:
        state: to be filled.
        calibration_id: of the calibration in use.
        decision: see there.
        forecast: knows of the actuators' memory where the calibration does not; None = there is none.
    """
    plan = decision.move.plan
    state.calibration_id = calibration_id
    state.signals = doubles(plan.signals)
    state.predicted_rms, state.predicted_rms_lower, state.predicted_rms_upper = plan.rms, plan.rms_lower, plan.rms_upper
    if forecast is not None:
        state.predicted_rms_lower = forecast.lower
        state.predicted_rms_upper = max(plan.rms_upper, forecast.upper)
    state.predicted_max_zernike = plan.max_zernike
    state.predicted_max_zernike_upper = plan.max_zernike_upper
    state.predicted_duration = decision.duration
    state.saturated = bool(plan.saturated.any())
    state.saturated_actuators = array.array("I", (np.flatnonzero(plan.saturated) + 1).astype("uint32").tobytes())
    state.curvature_min, state.curvature_max = decision.reachable
    state.history_known = decision.look.known
    state.mode = decision.mode
