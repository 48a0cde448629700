"""Between the messages of dm_msgs and the types of the calibration library."""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from dm_msgs.msg import ActuatorMemory, ActuatorState, MirrorInfo, ZernikeCoefficients
from dm_msgs.msg import Calibration as CalibrationMsg
from dm_msgs.msg import Recipe as RecipeMsg
from dm_msgs.msg import RecipeBook as RecipeBookMsg
from numpy.typing import NDArray

from dm_calibration.applied_history import Report
from dm_calibration.calibration import Calibration
from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.mirror import Mirror
from dm_calibration.memory.law import MemoryLaw
from dm_calibration.memory.memory_fit import MemoryFit
from dm_calibration.memory.recipes import Recipe, RecipeBook
from dm_calibration.memory.tracker import Applied
from dm_calibration.optics.sampling import SamplePoints
from dm_calibration.procedure import Measurement
from dm_calibration.update_storage import Updates

Floats = NDArray[np.float64]


def doubles(values: Floats) -> array[float]:
    """`values`, flattened row by row, as a buffer that a float64[] field takes without looking at each element."""
    buffer = array("d")
    buffer.frombytes(np.ascontiguousarray(values, dtype=np.float64).tobytes())
    return buffer


def time_message(stamp_ns: int) -> Time:
    """ns since the epoch of the clock as a message."""
    return Time(sec=int(stamp_ns // 10**9), nanosec=int(stamp_ns % 10**9))


def stamp_ns(message: Time) -> int:
    """A time message in ns."""
    return int(message.sec * 10**9 + message.nanosec)


def mirror_from(message: MirrorInfo) -> Mirror:
    """The mirror that the driver describes.

    Raises:
        ValueError: naming the field that makes no sense.
    """
    for name in ("actuator_x", "actuator_y"):
        if len(getattr(message, name)) != message.actuators:
            raise ValueError(f"mirror_info: {name} has {len(getattr(message, name))} values, not {message.actuators}")
    if len(message.neighbour_a) != len(message.neighbour_b):
        raise ValueError(f"mirror_info: {len(message.neighbour_a)} neighbour_a, {len(message.neighbour_b)} neighbour_b")
    return Mirror(
        name=message.name,
        serial=message.serial,
        x=np.array(message.actuator_x, dtype=np.float64),
        y=np.array(message.actuator_y, dtype=np.float64),
        working_radius=0.5 * message.working_aperture_diameter,
        signal_min=message.signal_min,
        signal_max=message.signal_max,
        neighbours=np.column_stack((message.neighbour_a, message.neighbour_b)).astype(np.int64).reshape(-1, 2),
        neighbour_difference_max=message.neighbour_difference_max,
    )


def driver_facts(message: MirrorInfo) -> dict[str, Any]:
    """What maps depend on beside the mirror itself: wiring, electronics and volts."""
    return {
        "wiring": message.wiring,
        "electronics": message.electronics,
        "volts_min": message.volts_min,
        "volts_max": message.volts_max,
        "slew_rate_max": message.slew_rate_max,
    }


def measurement_from(response: Any) -> Measurement:
    """The map in an answer of the service `measure`.

    Raises:
        ValueError: the answer holds no samples, or coefficients of another convention.
    """
    zernike, samples = response.zernike, response.samples
    if zernike.convention != ZernikeCoefficients.BORN_WOLF:
        raise ValueError(f"zernike.convention = {zernike.convention}: must be {ZernikeCoefficients.BORN_WOLF}")
    if not len(samples.sag) == len(samples.x) == len(samples.y) == len(samples.weight) > 0:
        raise ValueError(f"samples: {len(samples.sag)} sag values at {len(samples.x)} points")
    coefficients = np.array(zernike.coefficients, dtype=np.float64)
    sigma = np.array(zernike.sigma, dtype=np.float64)
    return Measurement(
        points=SamplePoints(np.array(samples.x), np.array(samples.y), np.array(samples.weight)),
        sag=np.array(samples.sag, dtype=np.float64),
        coefficients=coefficients,
        sigma=sigma if sigma.shape == coefficients.shape else np.full(coefficients.shape, np.nan),
        stamp_ns=stamp_ns(zernike.header.stamp),
        residual_rms=zernike.residual_rms,
        valid_fraction=zernike.valid_fraction,
        radius=zernike.radius,
        wavelength=zernike.wavelength,
        system_error_subtracted=response.info.system_error_subtracted,
        file=response.info.file,
        sha256=response.info.sha256,
        instrument=response.info.instrument,
        pitch=response.info.pitch,
        camera=(response.info.width, response.info.height),
        centre=(response.info.centre_x, response.info.centre_y),
        radius_px=response.info.aperture_radius_px,
    )


def calibration_message(
    calibration: Calibration | None, file: Path | None, frame_id: str, calibrated_error_max: float
) -> CalibrationMsg:
    """The message on `calibration`; None = no calibration.

    A calibration counts as CALIBRATED when its held-out coefficient error is at most `calibrated_error_max` (m) and no
    actuator is dead or was never moved, else as APPROXIMATE.
    """
    message = CalibrationMsg()
    message.header.frame_id = frame_id
    if calibration is None:
        return message
    fit, points = calibration.fit, calibration.fit.points
    usable = np.isin(fit.grades, (CalibrationMsg.GRADE_GOOD, CalibrationMsg.GRADE_WEAK)).all()
    good = fit.held_out_max_zernike <= calibrated_error_max and bool(usable)
    message.header.stamp = time_message(calibration.stamp_ns)
    message.id = calibration.id
    message.file = str(file or "")
    message.mirror_name = calibration.mirror_name
    message.mirror_serial = calibration.mirror_serial
    message.method = fit.method
    message.software_version = calibration.software_version
    message.wavelength = calibration.wavelength
    message.aperture_radius = calibration.aperture_radius
    message.actuators = fit.actuators
    message.convention = ZernikeCoefficients.BORN_WOLF
    message.terms = calibration.maps.terms
    message.influence_zernike = doubles(fit.influence_zernike)
    message.zernike_offset = doubles(fit.zernike_offset)
    message.points = points.x.size
    message.sample_x = doubles(points.x)
    message.sample_y = doubles(points.y)
    message.sample_weight = doubles(points.weight)
    message.influence_sag = doubles(fit.influence_sag)
    message.sag_offset = doubles(fit.sag_offset)
    message.signal_min = fit.signal_min
    message.signal_max = fit.signal_max
    message.maps_used = int(fit.used.sum())
    message.maps_dropped = calibration.maps_dropped
    message.in_sample_rms = fit.in_sample_rms
    message.held_out_rms = fit.held_out_rms
    message.held_out_max_zernike = fit.held_out_max_zernike
    message.condition_number = fit.condition_number
    message.quality = CalibrationMsg.CALIBRATED if good else CalibrationMsg.APPROXIMATE
    message.actuator_grade = array("B", fit.grades.astype(np.uint8).tobytes())
    message.known_limitations = list(calibration.limitations)
    message.region_weights = doubles(calibration.region_weights)
    if calibration.memory is not None:
        message.memory = memory_message(calibration.memory)
    message.recipes = recipe_book_message(calibration.recipes)
    return message


def put_updates(
    message: CalibrationMsg, updates: Updates, fit: InfluenceFit, doubts: list[str], mirror_changed: bool
) -> None:
    """What later maps have told, into the `message` of the calibration that they update.

    Args:
        fit: the influence function as it is now.
        doubts: sentences, added to the known limitations.
        mirror_changed: the calibration no longer counts as CALIBRATED.
    """
    for name in ("influence_zernike", "zernike_offset", "influence_sag", "sag_offset"):
        setattr(message, name, doubles(getattr(fit, name)))
    message.revision = updates.revision
    message.checked = time_message(updates.checked_ns)
    message.gain_drift = abs(updates.drift.largest_gain[0])
    message.offset_drift = updates.drift.offset_rms
    message.known_limitations = [*message.known_limitations, *doubts]
    if mirror_changed:
        message.quality = CalibrationMsg.APPROXIMATE


def report_from(message: ActuatorState) -> Report:
    """What the driver reports as applied, which must not be empty."""
    turned_at = np.array(message.turned_at, dtype=np.float64)
    applied = Applied(
        time=1e-9 * stamp_ns(message.header.stamp),
        signals=np.array(message.applied, dtype=np.float64),
        turns=message.turns,
        turned_at=turned_at if turned_at.size else None,
        degausses=message.degausses,
        history_known=message.history_known,
        moving=message.moving,
    )
    return Report(applied, message.moving, message.driver_state == ActuatorState.STATE_ACTIVE)


def memory_message(memory: MemoryFit) -> ActuatorMemory:
    """The memory of a calibration."""
    law = memory.law
    return ActuatorMemory(
        law=memory.name,
        play_radius=doubles(law.play_radius),
        powers=law.play_weight.shape[1],
        play_weight=doubles(law.play_weight),
        duhem_slope=doubles(law.duhem_slope),
        duhem_weight=law.duhem_weight,
        creep_rate=law.creep_rate,
        creep_time=doubles(law.creep_time),
        zernike_sigma=doubles(memory.zernike_sigma),
        held_out_max_zernike=memory.held_out_max_zernike,
        unknown_sigma=memory.unknown_sigma,
        maps=memory.maps,
    )


def memory_law_from(message: ActuatorMemory) -> MemoryLaw | None:
    """The law in a message; None when no memory was identified.

    Raises:
        ValueError: naming the field that makes no sense.
    """
    radius = np.array(message.play_radius, dtype=np.float64)
    if not radius.size:
        return None
    weight = np.array(message.play_weight, dtype=np.float64)
    if weight.size != radius.size * message.powers or not message.powers:
        raise ValueError(f"memory: play_weight has {weight.size} values, must be {radius.size} x {message.powers}")
    return MemoryLaw(
        radius,
        weight.reshape(radius.size, message.powers),
        np.array(message.duhem_slope, dtype=np.float64),
        message.duhem_weight,
        message.creep_rate,
        np.array(message.creep_time, dtype=np.float64),
    )


def recipe_book_message(book: RecipeBook) -> RecipeBookMsg:
    """Recipes as a message."""
    recipes = [
        RecipeMsg(
            curvature=recipe.curvature,
            conic_constant=recipe.conic_constant,
            effective=doubles(recipe.effective),
            signals=doubles(recipe.signals),
            max_zernike=recipe.max_zernike,
            rms=recipe.rms,
            maps=recipe.maps,
        )
        for recipe in book.recipes
    ]
    return RecipeBookMsg(
        stamp=time_message(book.stamp_ns),
        degauss_steps=book.degauss_steps,
        interpolation_error=book.interpolation_error,
        recipes=recipes,
    )


def recipe_book_from(message: RecipeBookMsg) -> RecipeBook:
    """Recipes of a message.

    Raises:
        RecipeError: they do not fit together.
    """
    recipes = [
        Recipe(
            recipe.curvature,
            recipe.conic_constant,
            np.array(recipe.effective, dtype=np.float64),
            np.array(recipe.signals, dtype=np.float64),
            recipe.max_zernike,
            recipe.rms,
            recipe.maps,
        )
        for recipe in message.recipes
    ]
    return RecipeBook(tuple(recipes), message.degauss_steps, message.interpolation_error, stamp_ns(message.stamp))
