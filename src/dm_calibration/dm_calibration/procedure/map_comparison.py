"""Check that a map may enter the same fit as the maps before it."""

import numpy as np

from dm_calibration.influence.maps import same_points
from dm_calibration.map_files.surface_map import PITCH_TOLERANCE
from dm_calibration.procedure.outcome import Outcome, Setup
from dm_common.errors import ErrorCode, MeasurementError
from dm_common.measurement import Measurement
from dm_common.mirror import APERTURE_TOLERANCE

#: Largest relative difference of wavelengths between maps.
WAVELENGTH_TOLERANCE = 1e-4


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


def _difference(measured: Measurement, outcome: Outcome, working_radius: float, tolerance: float) -> str:
    """How a map differs from those before; "" = not at all."""
    if measured.radius > 0.0 and abs(measured.radius - working_radius) > tolerance * working_radius:
        return (
            f"aperture radius {measured.radius * 1e3:.3f} mm, the mirror's is {working_radius * 1e3:.3f} mm "
            f"+-{tolerance:.1%}: never mix apertures in one fit, set the "
            "interferometer's aperture.radius to the mirror's"
        )
    if outcome.setup and (different := _other_setup(measured, outcome.setup)):
        return different
    first = outcome.records[0] if outcome.records else measured
    if measured.coefficients.shape != first.coefficients.shape:
        return f"{measured.coefficients.size} Zernike terms, in the maps before {first.coefficients.size}"
    if abs(measured.radius_px - first.radius_px) > tolerance * first.radius_px > 0.0:
        return (
            f"aperture radius {measured.radius_px:.1f} pixels, in the maps before {first.radius_px:.1f}: the map "
            "shows a part of the pupil, or another one"
        )
    return ""


def _other_setup(measured: Measurement, setup: Setup) -> str:
    """How a map differs in setup from those before; "" = not at all."""
    if not same_points(measured.points, setup.points):
        return "sampled at other points than the maps before: measure the whole run with one interferometer node"
    if abs(measured.wavelength - setup.wavelength) > WAVELENGTH_TOLERANCE * setup.wavelength:
        return (
            f"wavelength {measured.wavelength * 1e9:.3f} nm, in the maps before {setup.wavelength * 1e9:.3f} nm (0 = "
            "not known): never mix wavelengths in one fit, measure the whole run with one instrument"
        )
    mixed = "never mix instruments in one fit, measure the whole run with one"
    if measured.instrument != setup.instrument:
        return f"instrument {measured.instrument!r}, in the maps before {setup.instrument!r}: {mixed}"
    if measured.camera != setup.camera:
        here, before = ("{} x {}".format(*size) for size in (measured.camera, setup.camera))
        return f"camera of {here} pixels, in the maps before {before}: {mixed}"
    if not np.isclose(measured.pitch, setup.pitch, rtol=PITCH_TOLERANCE, atol=0.0):
        before = f"{setup.pitch * 1e6:.3f} um (0 = not known)"
        return f"pixel pitch {measured.pitch * 1e6:.3f} um, in the maps before {before}: {mixed}"
    if measured.orientation != setup.orientation:
        here, before = (
            "flip_x {}, flip_y {}, rotate_deg {:g}".format(*each) for each in (measured.orientation, setup.orientation)
        )
        return (
            f"orientation {here}, in the maps before {before}: do not change the interferometer's orientation.* in a "
            "run"
        )
    if measured.reference_surface != setup.reference_surface:
        here, before = (each or "none" for each in (measured.reference_surface, setup.reference_surface))
        return f"reference_surface {here}, in the maps before {before}: do not change it in a run"
    if measured.system_error_subtracted != setup.system_error_subtracted:
        return (
            f"system_error_subtracted = {measured.system_error_subtracted}, in the maps before "
            f"{setup.system_error_subtracted} (1 = the instrument had subtracted its own error): never mix them"
        )
    return ""
