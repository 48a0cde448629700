"""Conversion between the messages of the focus controller's node and the types it works with."""

import array
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from dm_msgs.msg import ActuatorEstimate, Capabilities, FocusRequest, FocusState, MirrorInfo

from dm_common.errors import HISTORY_UNKNOWN, ErrorCode
from dm_common.messages import doubles, estimate_message, time_message
from dm_common.mirror import actuators_text
from dm_common.optics.conic import curvatures_text
from dm_common.ros.lifecycle import OK, WARN, Health
from dm_common.values import fill_with_nan
from dm_controller.focus_controller import FocusController
from dm_controller.focus_types import Moment, Order
from dm_controller.forecast import HysteresisShare
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.planner import Move
from dm_controller.planning.target import FocusTarget

#: What to do about an unknown history.
REMEDY = "a degauss over the full range (action degauss, `./dm degauss`) makes it known"


def state_message(order: Order, values: Mapping[str, Any], share: HysteresisShare | None) -> FocusState:
    """The message on the outcome of an order, with the full prediction.

    `share` is the contribution of hysteresis where the calibration has no model of it; None = not known.
    """
    request, move, active, refusal = order.request, order.move, order.active, order.refusal
    state = fill_with_nan(FocusState()) if move is None else FocusState()
    state.curvature, state.power = request.curvature, 2 * request.curvature
    state.conic_constant, state.zernike = request.conic_constant, request.zernike
    state.mode, state.applied = request.mode, order.applied
    state.header.stamp, state.request_stamp = time_message(order.began.ns), request.header.stamp
    if move is not None and active is not None:
        plan = move.plan
        drift, drift_rms = (0.0, 0.0) if order.creep_held else move.drift
        largest = plan.max_zernike_upper + drift
        state.calibration_id = active.calibration.id
        state.signals = doubles(plan.signals)
        state.predicted_rms = plan.rms
        state.predicted_rms_lower, state.predicted_rms_upper = plan.rms_lower, plan.rms_upper + drift_rms
        if share is not None:
            state.predicted_rms_lower, upper = share.interval(request.curvature, plan.rms)
            state.predicted_rms_upper = max(state.predicted_rms_upper, upper)
        state.predicted_max_zernike = plan.max_zernike
        state.predicted_max_zernike_upper = largest
        state.predicted_duration = move.duration
        state.saturated = bool(plan.saturated.any())
        state.saturated_actuators = array.array("I", (np.flatnonzero(plan.saturated) + 1).astype("uint32").tobytes())
        state.curvature_min, state.curvature_max = active.reachable_range(move.target, values["reachable_tolerance"])
        state.history_known = move.known
        state.mode = move.mode
        state.creep_held = order.creep_held
        first = "the mirror is degaussed first; " if order.pending else ""
        text = (
            f"{first}{request.curvature:+.4f} 1/m is reached in about {move.duration:.2g} s, accurate to "
            f"{largest * 1e9:.1f} nm (largest coefficient, 95 %)"
        )
        source = "creep, which nothing corrects" if drift > 0.5 * largest else plan.most
        most = f"most of that for {source}" if source else ""
        state.message = "; ".join(filter(None, (text, most, remarks(active, order.unknown, values, order.began.ns))))
    if refusal is not None:
        state.error_code, state.message, state.creep_held = refusal.error_code, str(refusal), False
    return state


def actuator_estimate_message(controller: FocusController) -> ActuatorEstimate:
    """The message on the state of the actuators."""
    message, active = estimate_message(controller.observer), controller.active
    if active is not None:
        message.calibration_id, message.revision = active.calibration.id, active.calibration.revision
    return message


def remarks(active: ActiveCalibration, unknown: str, values: Mapping[str, Any], now_ns: int) -> str:
    """What makes predictions worse than they could be, as sentences; "" = nothing."""
    history = f"the history of the actuators is not known ({unknown}): {REMEDY}" if unknown else ""
    stale = active.stale(now_ns, values["calibration_age_max"])
    return "; ".join(filter(None, (history if active.planner.hysteresis is not None else "", stale)))


def nowhere(active: ActiveCalibration, tolerance: float) -> str:
    """A sentence if no sphere is reachable within `tolerance` (m); "" = some are."""
    flat = FocusTarget(0.0)
    reachable = active.reachable_range(flat, tolerance)
    return flat.denied(active.worst_case.command(flat)[1], tolerance, reachable) if math.isnan(reachable[0]) else ""


def trouble(controller: FocusController, values: Mapping[str, Any], now: Moment) -> str:
    """The reason why requests are refused, or predictions worse than they could be; "" = all is well."""
    if (refusal := controller.unavailable(now)) is not None:
        return str(refusal)
    assert controller.active is not None
    remark = remarks(controller.active, controller.observer.unknown, values, now.ns)
    return "; ".join(filter(None, (nowhere(controller.active, values["reachable_tolerance"]), remark)))


def _bound(controller: FocusController, order: Order, move: Move, now: Moment) -> tuple[float, float]:
    """Predicted largest coefficient error of the present shape, that of `order`, and its 95 % bound, m."""
    was, active, observer = order.active, controller.active, controller.observer
    assert was is not None  # else it had been refused
    plan, planner = move.plan, was.planner
    largest, spread = plan.max_zernike, plan.max_zernike_upper - plan.max_zernike
    if active is not None and active.calibration.id == was.calibration.id:
        # Maps taken since may have shown another figure, or that the calibration has larger errors than it stated.
        planner = active.planner
        after, before = (used.mirror.predict(move.target, move.effective).max_zernike for used in (active, was))
        worse = planner.error_bound(True) ** 2 - was.planner.error_bound(True) ** 2
        largest, spread = max(0.0, largest + after - before), math.hypot(spread, math.sqrt(max(0.0, worse)))
    drift = 0.0 if order.creep_held else move.drift[0]
    if drift and observer.state is not None and observer.law.same_as(was.planner.law):
        drift = planner.drift(observer.state, now.time, move.effective)
    # A shape written again after a lost link is on another branch of the hysteresis than it was planned for.
    return largest, largest + planner.error_bound(not observer.unknown or not move.known, spread) + drift


def health(controller: FocusController, values: Mapping[str, Any], now: Moment, missing: str = "") -> Health:
    """The health of the node with the parameters `values`; `missing` says what is missing beside it, as a sentence.

    While the requested shape is held, it includes its curvature (1/m), its age (s), its predicted largest coefficient
    error and the 95 % bound on that error (m).
    """
    figures: dict[str, object] = {
        "requests": controller.requests,
        "refused": controller.refused,
        "history": controller.observer.unknown or "known",
        "held": controller.hold.active,
        "corrections": controller.hold.corrections,
    }
    order = controller.monitor.shape
    if order is not None and order.move is not None:
        predicted, bound = _bound(controller, order, order.move, now)
        figures |= {
            "curvature": order.move.target.curvature,
            "age": f"{now.time - order.began.time:.1f}",
            "conditioned": order.move.mode == FocusRequest.MODE_CONDITIONED,
            "predicted": predicted,
            "bound": bound,
        }
    text = "; ".join(filter(None, (trouble(controller, values, now), missing)))
    return Health(WARN if text else OK, text or "ready", figures)


def capabilities_message(
    controller: FocusController, mirror: MirrorInfo | None, values: Mapping[str, Any], now: Moment
) -> Capabilities:
    """What the mirror can do; a driver whose last report is too old at `now` counts as silent."""
    active, unknown, tolerance = controller.active, controller.observer.unknown, values["reachable_tolerance"]
    message = Capabilities(residual_tolerance=tolerance, latency=controller.monitor.latency)
    message.header.stamp = time_message(now.ns)
    if mirror is not None and mirror.slew_rate_max > 0.0:
        # From the first write to the settled shape over the full range.
        message.settling = (mirror.signal_max - mirror.signal_min) / mirror.slew_rate_max
    if active is not None:
        message.calibration_id, message.aperture_radius = active.calibration.id, active.calibration.aperture_radius
    if (refusal := controller.unavailable(now)) is not None:
        message.quality, message.error_code = Capabilities.UNCALIBRATED, refusal.error_code
        message.message = str(refusal)
        return message
    assert active is not None
    low, high = active.reachable_range(FocusTarget(0.0), tolerance)
    if empty := nowhere(active, tolerance):
        message.error_code = ErrorCode.UNREACHABLE
    sentences = [empty or curvatures_text(low, high)]
    if unknown and active.planner.hysteresis is not None:
        sentences.append(f"{HISTORY_UNKNOWN}{unknown}")
    if dead := actuators_text(k for k, grade in enumerate(active.calibration.actuator_grade, 1) if grade == "dead"):
        sentences.append(f"without {dead}")
    if stale := active.stale(now.ns, values["calibration_age_max"]):
        sentences.append(stale)
    message.quality = active.calibration.quality
    message.curvature_min, message.curvature_max = low, high
    message.power_min, message.power_max = 2 * low, 2 * high
    message.error_bound = active.planner.error_bound(not unknown)
    message.error_bound_conditioned = active.conditioned_error
    message.condition_time = controller.conditioning.duration(
        active.degauss_steps(values["condition.degauss_steps"]), active
    )
    message.message = "; ".join(sentences)
    return message
