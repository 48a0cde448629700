"""Check that a map may enter the same fit, or comparison, as the maps before it."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from dm_calibration.influence.maps import same_points
from dm_calibration.map_files.surface_map import SAME_LENGTH
from dm_calibration.procedure.outcome import Outcome
from dm_common.errors import ErrorCode, MeasurementError
from dm_common.measurement import Measurement
from dm_common.mirror import APERTURE_TOLERANCE

#: How messages name the properties that maps of one fit must share: a value, whose the other is, and the other.
_PROPERTIES = {
    "wavelength": "wavelength {:.3f} nm, {} {:.3f} nm (0 = not known)",
    "instrument": "instrument {!r}, {} {!r}",
    "camera": "camera of {0[0]} x {0[1]} pixels, {1} {2[0]} x {2[1]}",
    "pitch": "pixel pitch {:.3f} um, {} {:.3f} um (0 = not known)",
    "orientation": "orientation (flip_x, flip_y, rotate_deg) {}, {} {}",
    "reference_surface": "reference_surface {}, {} {}",
    "system_error_subtracted": "system_error_subtracted = {}, {} {} (1 = the instrument had subtracted its own error)",
}
#: Units of those that are lengths, m; such values may differ by rounding.
_UNITS = {"wavelength": 1e-9, "pitch": 1e-6}


def check_comparable(
    measured: Measurement, outcome: Outcome, working_radius: float, aperture_tolerance: float = APERTURE_TOLERANCE
) -> None:
    """Refuse a map of another aperture, wavelength, instrument or evaluation than those in `outcome`.

    Args:
        working_radius: of the mirror, m.
        aperture_tolerance: relative.

    Raises:
        MeasurementError: the message names the property that differs, its value, and that of the other maps.
    """
    if different := _difference(measured, outcome, working_radius, aperture_tolerance):
        raise MeasurementError(ErrorCode.MAP_REJECTED, different)


def check_not_earlier(measured: Measurement, outcome: Outcome) -> None:
    """Refuse a map that is dated before the last one of `outcome`: creep cannot be identified then.

    Raises:
        MeasurementError: the message names how far its time is behind.
    """
    back = 1e-9 * (outcome.records[-1].stamp_ns - measured.stamp_ns) if outcome.records else 0.0
    if back > 0.0:
        raise MeasurementError(
            ErrorCode.MAP_REJECTED,
            f"its stamp is {back:.3f} s before that of the map before it: must not be earlier; was the clock set back? "
            "Set it right before the goal is sent again, else the run is set aside",
        )


def other_aperture(measured: Measurement, radius: float, tolerance: float, whose: str) -> str:
    """How the aperture of a map differs from the `radius` (m) of the mirror or calibration; "" = not, or not known.

    Args:
        tolerance: relative.
        whose: the words before the value of the other radius.
    """
    if not measured.radius or abs(measured.radius - radius) <= tolerance * radius:
        return ""
    return f"aperture radius {measured.radius * 1e3:.3f} mm, {whose} {radius * 1e3:.3f} mm +-{tolerance:.1%}"


def other_setup(measured: Measurement, other: Any, names: Iterable[str], whose: str) -> str:
    """The first of the properties `names` in which a map differs from `other`, with both values; "" = none.

    Args:
        other: has these properties too: the setup of a run, or a calibration.
        whose: the words before the value of `other`.
    """
    for name in names:
        here, there = getattr(measured, name), getattr(other, name)
        same = here == there
        if unit := _UNITS.get(name):
            same, here, there = np.isclose(here, there, rtol=SAME_LENGTH, atol=0.0), here / unit, there / unit
        if not same:
            return _PROPERTIES[name].format("none" if here == "" else here, whose, "none" if there == "" else there)
    return ""


def _difference(measured: Measurement, outcome: Outcome, working_radius: float, tolerance: float) -> str:
    """How a map differs from those before; "" = not at all."""
    if different := other_aperture(measured, working_radius, tolerance, "the mirror's is"):
        return f"{different}: never mix apertures in one fit, set the interferometer's aperture.radius to the mirror's"
    if (setup := outcome.setup) is not None:
        if not same_points(measured.points, setup.points):
            return "sampled at other points than the maps before: measure the whole run with one interferometer node"
        if different := other_setup(measured, setup, _PROPERTIES, "in the maps before"):
            return f"{different}: never mix them in one fit, measure the whole run with one instrument and its settings"
    first = outcome.records[0] if outcome.records else measured
    if measured.coefficients.shape != first.coefficients.shape:
        return f"{measured.coefficients.size} Zernike terms, in the maps before {first.coefficients.size}"
    if abs(measured.radius_px - first.radius_px) > tolerance * first.radius_px > 0.0:
        return (
            f"aperture radius {measured.radius_px:.1f} pixels, in the maps before {first.radius_px:.1f}: the map "
            "shows a part of the pupil, or another one"
        )
    return ""
