"""The message `capabilities`: what the mirror can do now."""

from __future__ import annotations

from typing import Any

from dm_msgs.msg import Capabilities

from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.target import FocusTarget


def capabilities_message(
    use: ActiveCalibration, tolerance: float, unknown: str, stale: str, condition_time: float
) -> Capabilities:
    """Capabilities of a calibrated mirror, without the header.

    Args:
        use: calibration and mirror.
        tolerance: m, largest coefficient error at which a curvature counts as reachable.
        unknown: why the actuators' history is not known, in words; "" = it is.
        stale: why the calibration should be renewed, in words; "" = it need not.
        condition_time: s.
    """
    low, high = use.reachable_range(FocusTarget(0.0), tolerance)
    sentences = [f"{low:+.4f} to {high:+.4f} 1/m ({2 * low:+.3f} to {2 * high:+.3f} dioptre)"]
    if unknown and use.loop.hysteresis is not None:
        sentences.append(f"wider error bound: {unknown}")
    if stale:
        sentences.append(stale)
    return Capabilities(
        calibration_id=use.calibration.id,
        quality=use.calibration.quality,
        curvature_min=low,
        curvature_max=high,
        power_min=2 * low,
        power_max=2 * high,
        residual_tolerance=tolerance,
        aperture_radius=use.calibration.aperture_radius,
        error_bound=use.error_bound(not unknown),
        error_bound_conditioned=use.conditioned_error,
        condition_time=condition_time,
        message="; ".join(sentences),
    )


def settling_time(mirror_info: Any) -> float:
    """Time in s from the first write to the settled shape over the full range; 0 = not known."""
    span = mirror_info.signal_max - mirror_info.signal_min
    return float(span / mirror_info.slew_rate_max) if mirror_info.slew_rate_max > 0 else 0.0
