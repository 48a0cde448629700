"""Conversion between the messages of dm_msgs and the types of the calibration library."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from dm_msgs.msg import ActuatorHysteresis, Capabilities, MirrorInfo
from dm_msgs.msg import Calibration as CalibrationMsg
from std_msgs.msg import Header

from dm_calibration.calibration import CALIBRATED_ERROR_MAX, Calibration
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit
from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.quality import GRADE_NAMES
from dm_calibration.recalibration.updates import InUse
from dm_common import Floats
from dm_common.hysteresis.model import HysteresisModel, request_error
from dm_common.messages import doubles, taken, time_message

# Fields that have the same name in the message and in a calibration or its fit.
_NAMES = ("id", "mirror_serial", "wavelength", "aperture_radius", "instrument_error", "scale_error")
_FIGURES = ("actuators", "held_out_rms", "held_out_max_zernike")
_MODEL = ("influence_zernike", "zernike_offset", "influence_sag", "sag_offset")
#: Arrays of a hysteresis model that the message has under the same names.
_LAW = (
    *("play_radius", "play_weight", "fading_rate", "fading_weight"),
    *("creep_time", "creep_spectrum", "lag_spectrum", "crept", "creep_covariance"),
)


def driver_facts(message: MirrorInfo) -> dict[str, Any]:
    """The driver's wiring, electronics and voltages, on which maps depend besides the mirror; None = not known."""
    same = taken(message, "wiring", "electronics", "slew_rate_max")
    volts = {
        name: None if math.isnan(value) else value for name, value in taken(message, "volts_min", "volts_max").items()
    }
    return same | volts | {"channels": list(message.channels)}


def calibration_message(
    calibration: Calibration | None, file: Path | None, frame_id: str, calibrated_error_max: float
) -> CalibrationMsg:
    """The message for `calibration`; None = no calibration. Its quality depends on `calibrated_error_max`, m."""
    if calibration is None:
        return CalibrationMsg(header=Header(frame_id=frame_id))
    fit, points = calibration.fit, calibration.fit.points
    doubtful = calibration.doubts(calibrated_error_max)
    message = CalibrationMsg(
        header=Header(frame_id=frame_id, stamp=time_message(calibration.stamp_ns)),
        file=str(file or ""),
        **taken(calibration, *_NAMES),
        **taken(fit, *_FIGURES),
        **{name: doubles(getattr(fit, name)) for name in _MODEL},
        **{f"sample_{name}": doubles(getattr(points, name)) for name in ("x", "y", "weight")},
        maps_used=int(fit.used.sum()),
        quality=Capabilities.APPROXIMATE if doubtful else Capabilities.CALIBRATED,
        actuator_grade=_grades(fit),
        known_limitations=list(calibration.limitations),
        region_weights=doubles(calibration.region_weights),
    )
    if calibration.hysteresis is not None:
        message.hysteresis = hysteresis_message(calibration.hysteresis)
    return message


def put_updates(
    message: CalibrationMsg,
    kept: InUse,
    temperature: float,
    doubts: list[str],
    mirror_changed: bool,
    error_max: float = CALIBRATED_ERROR_MAX,
    age_s: float = 0.0,
) -> None:
    """Put the updates by later maps into the `message` of their calibration.

    Args:
        temperature: degC; NaN = not known.
        doubts: sentences that are added to the known limitations.
        mirror_changed: whether maps show a change of the mirror: the calibration then does not count as CALIBRATED.
        error_max: m, largest bound of a request, widened as it is now, with which it does.
        age_s: s since a map last agreed, or since the calibration; bounds count the drift to be expected in that time.
    """
    fit, drift = kept.filter.changed(kept.drift, temperature), kept.drift
    for name in _MODEL:
        setattr(message, name, doubles(getattr(fit, name)))
    errors = (
        kept.filter.warm_error(drift, temperature),
        kept.filter.stuck_error(drift),
        kept.filter.drift_error(drift, age_s),
    )
    for promise in (message, message.hysteresis):  # no bound falls below the disagreement of maps since one last agreed
        held_out = math.sqrt(drift.excess) * promise.held_out_max_zernike
        promise.held_out_max_zernike = math.hypot(max(held_out, drift.disagreement), *errors)
    message.revision = drift.revision
    message.checked = time_message(drift.checked_ns)
    message.creep_shown = drift.trust
    message.known_limitations = [*message.known_limitations, *doubts]
    message.actuator_grade = _grades(fit)
    promise = request_error(message, None if kept.calibration.hysteresis is None else message.hysteresis)
    if mirror_changed or drift.given_up or not promise <= error_max:
        message.quality = Capabilities.APPROXIMATE


def _grades(fit: InfluenceFit) -> list[str]:
    return [GRADE_NAMES[grade] for grade in fit.grades]


def _slopes(law: HysteresisModel) -> Floats:
    """Slopes in the layout of the message: per actuator and direction if the weights are per actuator."""
    slope, count = law.duhem_slope, np.size(law.duhem_weight)
    return np.broadcast_to(slope, (count, 2, slope.shape[-1])) if count > 1 and slope.size else slope


def hysteresis_message(hysteresis: HysteresisFit) -> ActuatorHysteresis:
    """The hysteresis model of a calibration."""
    law = hysteresis.law
    return ActuatorHysteresis(
        law=hysteresis.name,
        **{name: doubles(getattr(law, name)) for name in _LAW},
        powers=law.play_weight.shape[-1],
        duhem_slope=doubles(_slopes(law)),
        duhem_weight=doubles(np.atleast_1d(law.duhem_weight)),
        crept_at=time_message(round(1e9 * law.crept_at)),
        **taken(law, "creep_rate", "creep_slope"),
        **taken(hysteresis, "held_out_max_zernike", "unknown_sigma"),
    )
