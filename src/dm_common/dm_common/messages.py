"""Conversion between the messages of dm_msgs and the types that several nodes share."""

from __future__ import annotations

import math
from array import array
from typing import TYPE_CHECKING, Any

import numpy as np
from builtin_interfaces.msg import Time
from dm_msgs.msg import ActuatorEstimate as ActuatorEstimateMsg
from dm_msgs.msg import ActuatorHysteresis, ActuatorState, MirrorInfo
from dm_msgs.msg import Recipe as RecipeMsg
from dm_msgs.msg import RecipeBook as RecipeBookMsg

from dm_common import Floats
from dm_common.errors import ErrorCode, Refusal, size_text
from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.hysteresis.observer import ActuatorEstimate, HysteresisObserver
from dm_common.limits import Limits
from dm_common.mirror import Applied, Mirror
from dm_common.optics.zernike import BORN_WOLF
from dm_common.recipes import Recipe, RecipeBook

if TYPE_CHECKING:
    from dm_common.measurement import Measurement


def doubles(values: Floats) -> array[float]:
    """`values`, flattened row by row, as a buffer that a float64[] field accepts without checking each element."""
    return array("d", np.asarray(values, dtype=np.float64).tobytes())


def taken(source: Any, *names: str) -> dict[str, Any]:
    """The fields `names` of `source` as keyword arguments for a target with fields of the same names."""
    return {name: getattr(source, name) for name in names}


def answer_with(answer: Any, code: int, text: str) -> None:
    """Set error code and message in an answer, and in a FocusState inside it, if they have these fields."""
    for each in (answer, getattr(answer, "state", answer)):
        if hasattr(each, "error_code"):
            each.error_code, each.message = code, text


def time_message(stamp_ns: int) -> Time:
    """ns since the epoch of the clock as a message."""
    return Time(sec=int(stamp_ns // 10**9), nanosec=int(stamp_ns % 10**9))


def stamp_ns(message: Time) -> int:
    """A time message in ns."""
    return int(message.sec * 10**9 + message.nanosec)


def seconds(message: Time) -> float:
    """A time message in s."""
    return 1e-9 * stamp_ns(message)


def mirror_from(message: MirrorInfo) -> Mirror:
    """The mirror that the driver describes.

    Raises:
        ValueError: a field is invalid; the message names it.
    """
    for name in ("actuator_x", "actuator_y"):
        if (size := len(getattr(message, name))) != message.actuators:
            raise ValueError(f"mirror_info: {size_text(name, size)}: must have {message.actuators}")
    if (size := len(message.neighbour_a)) != (other := len(message.neighbour_b)):
        raise ValueError(f"mirror_info: {size_text('neighbour_a', size)}, neighbour_b {other}: must have as many")
    pairs = np.column_stack((message.neighbour_a, message.neighbour_b)).astype(np.intp)
    return Mirror(
        name=message.name,
        serial=message.serial,
        x=np.array(message.actuator_x, dtype=np.float64),
        y=np.array(message.actuator_y, dtype=np.float64),
        working_radius=0.5 * message.working_aperture_diameter,
        limits=Limits(message.signal_min, message.signal_max, pairs, message.neighbour_difference_max),
    )


def mirror_info_of(mirror: Mirror, **more: Any) -> MirrorInfo:
    """The message `mirror_info` that describes `mirror`, with `more` of its fields."""
    limits = mirror.limits
    first, second = (array("I", column.tolist()) for column in limits.pairs.T)
    known: dict[str, Any] = {
        **taken(mirror, "name", "serial", "actuators"),
        "actuator_x": doubles(mirror.x),
        "actuator_y": doubles(mirror.y),
        "neighbour_a": first,
        "neighbour_b": second,
        "working_aperture_diameter": 2.0 * mirror.working_radius,
        "signal_min": limits.low,
        "signal_max": limits.high,
        "neighbour_difference_max": limits.neighbour_difference,
    }
    return MirrorInfo(**known | more)


#: Fields of Measurement that dm_msgs/SurfaceMapInfo and dm_msgs/ZernikeCoefficients have under the same names.
OF_FILE = ("reference_surface", "instrument_error", "scale_error", "instrument", "pitch", "system_error_subtracted")
OF_FIT = ("residual_rms", "radius", "wavelength")


def measurement_from(response: Any) -> Measurement:
    """The map in an answer of the service `measure`.

    Raises:
        ValueError: the answer holds no samples, or coefficients of another convention.
    """
    # Imported here, since only nodes that measure need it.
    from dm_common.measurement import Measurement
    from dm_common.optics.sampling import SamplePoints

    zernike, samples, info = response.zernike, response.samples, response.info
    if zernike.convention not in ("", BORN_WOLF):
        raise ValueError(f"zernike.convention = {zernike.convention!r}: must be {BORN_WOLF}")
    if not len(samples.sag) == len(samples.x) == len(samples.y) == len(samples.weight) > 0:
        sizes = ", ".join(f"{len(getattr(samples, name))} {name}" for name in ("sag", "x", "y", "weight"))
        raise ValueError(f"samples: has {sizes}: must have as many of each, at least one")
    coefficients = np.array(zernike.coefficients, dtype=np.float64)
    sigma = np.array(zernike.sigma, dtype=np.float64)
    return Measurement(
        points=SamplePoints(np.array(samples.x), np.array(samples.y), np.array(samples.weight)),
        sag=np.array(samples.sag, dtype=np.float64),
        coefficients=coefficients,
        sigma=sigma if sigma.shape == coefficients.shape else np.full(coefficients.shape, np.nan),
        stamp_ns=stamp_ns(zernike.header.stamp),
        **taken(zernike, *OF_FIT),
        **taken(info, "file", "sha256", "valid_fraction", *OF_FILE),
        camera=(info.width, info.height),
        centre=(info.centre_x, info.centre_y),
        followed=(info.followed_x, info.followed_y),
        radius_px=info.aperture_radius_px,
        orientation=(info.flip_x, info.flip_y, info.rotate_deg),
    )


def driver_refusal(report: ActuatorState | None) -> Refusal | None:
    """The refusal by a driver that takes no commands, by its last report, or by none; None = it takes them."""
    if report is None:
        return Refusal(ErrorCode.DRIVER_UNAVAILABLE, "no actuator_state from pdm_driver yet: is the driver running?")
    if report.driver_state == ActuatorState.STATE_ACTIVE:
        return None
    reason = f": {report.message}" if report.message else ""
    if report.driver_state == ActuatorState.STATE_LINK_LOST:
        return Refusal(ErrorCode.ELECTRONICS_UNREACHABLE, f"pdm_driver has lost the link to the electronics{reason}")
    if report.driver_state == ActuatorState.STATE_SAFING and report.error_code != ErrorCode.DRIVER_INACTIVE:
        return Refusal(ErrorCode.DRIVER_INACTIVE, f"pdm_driver is not active{reason}")
    return Refusal(ErrorCode.DRIVER_INACTIVE, report.message or "pdm_driver is not active: activate it first")


def unused_as_requested(report: ActuatorState) -> ActuatorState:
    """For actuators without a channel, which cannot move, set the applied signals to those requested."""
    unused = np.bitwise_and(np.asarray(report.flags, dtype=np.uint8), ActuatorState.FLAG_UNUSED) > 0
    if unused.any() and len(report.requested) == len(report.applied) == len(unused):
        report.applied = doubles(np.where(unused, report.requested, report.applied))
    return report


def applied_from(message: ActuatorState, heard: float = -math.inf) -> Applied:
    """The driver's report in a message that was received at `heard` (s)."""
    signals = np.array(message.applied, dtype=np.float64)
    turned_at = np.array(message.turned_at, dtype=np.float64)
    return Applied(
        time=seconds(message.header.stamp),
        signals=signals,
        turned_at=turned_at if turned_at.shape == signals.shape else None,
        **taken(message, "turns", "degausses", "history_known", "moving", "sequence"),
        requested=np.array(message.requested, dtype=np.float64),
        active=message.driver_state == ActuatorState.STATE_ACTIVE,
        linked=message.driver_state != ActuatorState.STATE_LINK_LOST,
        heard=heard,
    )


def _shaped(name: str, values: array[float], *shape: int, own: bool = False) -> Floats:
    """A field of the hysteresis model in this shape (-1 = any length); empty = the model has none.

    Args:
        own: whether the field may hold one array for each actuator.
    """
    field = np.array(values, dtype=np.float64)
    if not field.size:
        return field
    try:
        return field.reshape(-1, *shape) if own and field.size > math.prod(shape) else field.reshape(shape)
    except ValueError:
        wanted = " x ".join("any" if length < 0 else str(length) for length in shape) + (" (for each)" if own else "")
        raise ValueError(f"hysteresis: {size_text(name, field.size)}: must be {wanted}") from None


def hysteresis_model_from(message: ActuatorHysteresis) -> HysteresisModel | None:
    """The hysteresis model in a message; None when none was identified.

    Raises:
        ValueError: a field is invalid; the message names it.
    """
    radius = np.array(message.play_radius, dtype=np.float64)
    if not radius.size:
        return None
    weight = _shaped("play_weight", message.play_weight, radius.size, message.powers, own=True)
    if not weight.size:
        raise ValueError(f"hysteresis: play_weight has 0 values: must be {radius.size} x {message.powers} (for each)")
    duhem_weight = np.array(message.duhem_weight, dtype=np.float64)
    slope_of = (duhem_weight.size, 2, -1) if duhem_weight.size > 1 else (-1,)
    own, rate = weight.shape[:-2], np.array(message.fading_rate, dtype=np.float64)
    creep_time = np.array(message.creep_time, dtype=np.float64)
    return HysteresisModel(
        radius,
        weight,
        _shaped("duhem_slope", message.duhem_slope, *slope_of),
        duhem_weight if duhem_weight.size > 1 else float(duhem_weight.sum()),
        message.creep_rate,
        creep_time,
        _shaped("creep_spectrum", message.creep_spectrum, creep_time.size, own=True),
        1e-9 * stamp_ns(message.crept_at),
        np.array(message.crept, dtype=np.float64),
        _shaped("creep_covariance", message.creep_covariance, 2, 1 + creep_time.size, 1 + creep_time.size),
        _shaped("lag_spectrum", message.lag_spectrum, *own, -1),
        message.creep_slope,
        rate,
        _shaped("fading_weight", message.fading_weight, *own, rate.size, -1) if rate.size else np.zeros((0, 0)),
    )


#: Fields of HysteresisState that a dm_msgs/ActuatorEstimate has under the same names.
_STATE = ("signals", "position", "play", "fading", "crept", "crept_sigma", "lagged")


def estimate_message(observer: HysteresisObserver) -> ActuatorEstimateMsg:
    """The estimate of an observer as a message; without arrays before the driver's first report."""
    state, unknown = observer.state, observer.unknown
    message = ActuatorEstimateMsg(history_known=not unknown, message=unknown)
    if state is not None:
        message.header.stamp = time_message(round(state.time * 1e9))
        message.effective = doubles(observer.law.effective(state))
        for name in _STATE:
            setattr(message, name, doubles(getattr(state, name)))
    return message


def estimate_from(message: ActuatorEstimateMsg) -> ActuatorEstimate:
    """The estimate of the actuators in a message.

    Raises:
        ValueError: its arrays do not fit together.
    """
    if not (count := len(message.signals)):
        return ActuatorEstimate(None, message.message)
    values = {name: np.array(getattr(message, name), dtype=np.float64) for name in _STATE}
    for name in ("play", "fading", "crept", "lagged"):
        values[name] = values[name].reshape(count, -1)
    for name, size in (("position", count), ("crept_sigma", values["crept"].shape[1])):
        values[name] = values[name].reshape(size)
    return ActuatorEstimate(HysteresisState(seconds(message.header.stamp), **values), message.message)


#: Fields of Recipe that a dm_msgs/Recipe has under the same names.
_ARRAYS = ("effective", "signals", "zernike", "by_model")
_NUMBERS = ("curvature", "conic_constant", "max_zernike", "rms", "maps")


def recipe_book_message(book: RecipeBook, calibration_id: str) -> RecipeBookMsg:
    """Recipes of a calibration as a message."""
    recipes = [
        RecipeMsg(
            stamp=time_message(recipe.stamp_ns),
            **taken(recipe, *_NUMBERS),
            **{name: doubles(np.array(getattr(recipe, name))) for name in _ARRAYS},
        )
        for recipe in book.recipes
    ]
    return RecipeBookMsg(
        calibration_id=calibration_id,
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
            effective=np.array(recipe.effective, dtype=np.float64),
            signals=np.array(recipe.signals, dtype=np.float64),
            zernike=tuple(recipe.zernike),
            by_model=np.array(recipe.by_model, dtype=np.float64),
            stamp_ns=stamp_ns(recipe.stamp),
            **taken(recipe, *_NUMBERS),
        )
        for recipe in message.recipes
    ]
    return RecipeBook(tuple(recipes), message.degauss_steps, message.interpolation_error)
