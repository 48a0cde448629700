"""Between messages and the plain arrays of the library."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dm_common.messages import doubles, hysteresis_model_from
from dm_controller.planning.mirror_model import InfluenceModel
from dm_controller.planning.planner import HysteresisFigures
from dm_controller.planning.target import FocusTarget

__all__ = ["doubles", "hysteresis_figures_of", "model_of", "target_of"]

#: A law is scaled so that effective signals span this over a full cycle; gains are in the influence function.
SPAN = 2.0
SPAN_TOLERANCE = 0.2


def target_of(request: Any) -> FocusTarget:
    """The target of a dm_msgs/FocusRequest. Raises TargetError."""
    return FocusTarget(request.curvature, request.conic_constant, tuple(request.zernike))


def model_of(calibration: Any) -> InfluenceModel:
    """The influence model of a dm_msgs/Calibration. Raises ValueError when its arrays do not fit together."""
    actuators, terms, points = calibration.actuators, calibration.terms, calibration.points

    def matrix(name: str, rows: int) -> NDArray[np.float64]:
        values = np.asarray(getattr(calibration, name), dtype=float)
        if values.size != rows * actuators:
            raise ValueError(f"calibration: {name} has {values.size} values, must be {rows} x {actuators}")
        return values.reshape(rows, actuators)

    return InfluenceModel(
        aperture_radius=calibration.aperture_radius,
        influence_zernike=matrix("influence_zernike", terms),
        zernike_offset=np.asarray(calibration.zernike_offset, dtype=float),
        sample_x=np.asarray(calibration.sample_x, dtype=float),
        sample_y=np.asarray(calibration.sample_y, dtype=float),
        sample_weight=np.asarray(calibration.sample_weight, dtype=float),
        influence_sag=matrix("influence_sag", points),
        sag_offset=np.asarray(calibration.sag_offset, dtype=float),
        held_out_rms=calibration.held_out_rms,
        held_out_max_zernike=calibration.held_out_max_zernike,
    )


def hysteresis_figures_of(calibration: Any) -> HysteresisFigures | None:
    """The memory of a dm_msgs/Calibration; None when none was identified.

    Raises:
        ValueError: a field that makes no sense, or a law that has no inverse, naming it.
    """
    hysteresis = calibration.hysteresis
    try:
        law = hysteresis_model_from(hysteresis)
    except ValueError as error:
        raise ValueError(f"hysteresis: {str(error).removeprefix('hysteresis: ')}") from error
    if law is None:
        return None
    slope = law.slope_min()
    if not slope > 0.0:
        raise ValueError(
            f"hysteresis: play_weight: effective signals fall with the signal somewhere (slope {slope:.3g}); must rise"
        )
    if law.actuators not in (0, calibration.actuators):
        raise ValueError(
            f"hysteresis: play_weight: laws of {law.actuators} actuators, must be of {calibration.actuators} or one"
        )
    spans = law.span()
    span = spans[np.abs(spans - SPAN).argmax()]
    if not abs(span - SPAN) <= SPAN_TOLERANCE:
        raise ValueError(
            f"hysteresis: play_weight: effective signals span {span:.3g}, must be {SPAN:g}: a law of another scale"
        )
    sigma = np.array(hysteresis.zernike_sigma, dtype=np.float64)
    if sigma.shape != (calibration.terms,) or not (np.isfinite(sigma) & (sigma >= 0.0)).all():
        raise ValueError(f"hysteresis: zernike_sigma: must be {calibration.terms} finite numbers, none negative")
    for name in ("held_out_max_zernike", "unknown_sigma"):
        value = getattr(hysteresis, name)
        if not (np.isfinite(value) and value >= 0.0):
            raise ValueError(f"hysteresis: {name} = {value:g}: must be finite and not negative")
    return HysteresisFigures(law, sigma, hysteresis.held_out_max_zernike, hysteresis.unknown_sigma)
