"""What the focus controller tells: the message `focus_state`, and its health."""

from __future__ import annotations

import array
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from dm_msgs.msg import FocusRequest, FocusState

from dm_common.errors import Refusal
from dm_common.messages import doubles
from dm_common.ros import diagnostics
from dm_controller.conditioning import Waiting
from dm_controller.decision import Decision
from dm_controller.prediction import Forecast


class Outcome(NamedTuple):
    """What came of a request.

    Attributes:
        decision: None = refused before there was one.
        stamp: of the command that went out; None = none did.
        waiting: for the mirror to be conditioned.
        refusal: None = not refused.
    """

    decision: Decision | None = None
    stamp: Any = None
    waiting: Waiting | None = None
    refusal: Refusal | None = None


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


def health(
    trouble: Refusal | str, check_driver: Callable[[], None], values: Mapping[str, object]
) -> diagnostics.Health:
    """The node's health.

    Args:
        trouble: why there is no calibration, or remarks on it in words, "" = none.
        check_driver: raises Refusal when the driver takes no commands.
        values: figures.
    """
    try:
        if isinstance(trouble, Refusal):
            raise trouble
        check_driver()
    except Refusal as refusal:
        return diagnostics.Health(diagnostics.WARN, str(refusal), values)
    return diagnostics.Health(diagnostics.WARN if trouble else diagnostics.OK, trouble or "ready", values)
