"""Whether a map can be compared with the maps before it in a run."""

from __future__ import annotations

import numpy as np

from dm_calibration.influence.maps import same_points
from dm_calibration.procedure.outcome import Outcome
from dm_common.errors import ErrorCode, MeasurementError
from dm_common.measurement import Measurement

#: Pixels of an instrument agree so well from map to map, relatively; files keep the pitch in single precision.
PITCH_TOLERANCE = 1e-4


def check_comparable(
    measured: Measurement,
    outcome: Outcome,
    working_radius: float,
    aperture_tolerance: float,
    wavelength_tolerance: float,
) -> None:
    """Refuse a map of another aperture, wavelength, instrument or evaluation than those in `outcome`.

    Args:
        working_radius: of the mirror, m.
        aperture_tolerance, wavelength_tolerance: relative.

    Raises:
        MeasurementError: naming what differs, its value, and what the others have.
    """
    if measured.radius > 0.0 and abs(measured.radius - working_radius) > aperture_tolerance * working_radius:
        raise MeasurementError(
            ErrorCode.MAP_REJECTED,
            f"aperture radius {measured.radius * 1e3:.3f} mm, the mirror's is {working_radius * 1e3:.3f} mm "
            f"+-{aperture_tolerance:.1%}: never mix apertures in one fit, set the "
            "interferometer's aperture.radius to the mirror's",
        )
    if outcome.points is None:
        return
    if not same_points(measured.points, outcome.points):
        raise MeasurementError(
            ErrorCode.MAP_REJECTED,
            "sampled at other points than the maps before: leave the interferometer's sample_count alone in a run",
        )
    if abs(measured.wavelength - outcome.wavelength) > wavelength_tolerance * outcome.wavelength:
        raise MeasurementError(
            ErrorCode.MAP_REJECTED,
            f"wavelength {measured.wavelength * 1e9:.3f} nm, before it was {outcome.wavelength * 1e9:.3f} nm "
            "(0 = not told): never mix wavelengths in one fit, measure the whole run with one instrument",
        )
    if different := _other_instrument(measured, outcome):
        raise MeasurementError(
            ErrorCode.MAP_REJECTED, f"{different}: never mix instruments in one fit, measure the whole run with one"
        )
    if measured.system_error_subtracted != outcome.system_error_subtracted:
        raise MeasurementError(
            ErrorCode.MAP_REJECTED, "system error subtracted differs from the maps before: never mix them"
        )
    if outcome.records and measured.coefficients.shape != outcome.records[0].coefficients.shape:
        raise MeasurementError(
            ErrorCode.MAP_REJECTED, f"{measured.coefficients.size} Zernike terms, the maps before had others"
        )


def _other_instrument(measured: Measurement, outcome: Outcome) -> str:
    """What tells that another instrument took the map, in words; "" = nothing."""
    if measured.instrument != outcome.instrument:
        return f"instrument {measured.instrument!r}, before it was {outcome.instrument!r}"
    if measured.camera != outcome.camera:
        here, before = ("{} x {}".format(*size) for size in (measured.camera, outcome.camera))
        return f"camera of {here} pixels, before it was {before}"
    if not np.isclose(measured.pitch, outcome.pitch, rtol=PITCH_TOLERANCE, atol=0.0):
        return f"pixel pitch {measured.pitch * 1e6:.3f} um, before it was {outcome.pitch * 1e6:.3f} um (0 = not told)"
    return ""
