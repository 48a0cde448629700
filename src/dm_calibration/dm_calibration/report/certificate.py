"""The first two pages of the report: the certificate (promise, term of validity, names), and a picture of every
actuator.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_parameters import CRITERIA
from dm_calibration.recalibration.check_log import Check
from dm_calibration.report import figures
from dm_calibration.report.checks import valid_until
from dm_calibration.report.content import length, utc
from dm_calibration.report.document import Picture, Section, Table
from dm_common.atomic_write import write_whole
from dm_common.bounded import BoundedProgramme
from dm_common.figures import accuracy_text
from dm_common.geometry import neighbour_pairs
from dm_common.hysteresis.law_shape import worst_case_limits
from dm_common.limits import Limits
from dm_common.optics.conic import conic_coefficients, curvatures_text, reachable_range
from dm_common.optics.zernike import PISTON_TILT

#: File with the names of operator and instrument, set once by `./dm report --operator NAME --instrument NAME`.
PEOPLE = Path("~/.ros/dm_report.json")
#: Largest predicted coefficient error for a curvature in the range, m; resolution of the ends of the range, 1/m.
TOLERANCE, STEP = 20e-9, 1e-4
#: Number of spheres over the range from which the median predicted error is found.
SPHERES = 11
#: Relative weight of the signals in the fit of a shape: makes it unique if there are more actuators than terms.
RIDGE = 1e-9


def people(file: Path = PEOPLE) -> dict[str, str]:
    """Names of `operator` and `instrument`, as far as they are known."""
    try:
        content = json.loads(file.expanduser().read_text())
    except (OSError, ValueError):
        return {}
    return {str(name): str(value) for name, value in content.items()} if isinstance(content, dict) else {}


def keep_people(names: Mapping[str, str], file: Path = PEOPLE) -> None:
    """Keep the given names for this report and later ones; "" = no name, for which no question is asked again.

    Raises:
        OSError: the file cannot be written.
    """
    if names:
        write_whole(file.expanduser(), json.dumps(people(file) | dict(names)).encode())


def spheres(calibration: Calibration) -> tuple[float, float, float]:
    """Smallest and largest curvature (1/m) of a sphere that the signals of the maps reach for any history of the
    actuators, and the median over such spheres of the largest predicted coefficient error (m).

    (nan, nan, nan) if neither 0 nor the curvature at mid range is reached.
    """
    fit, maps, radius = calibration.fit, calibration.maps, calibration.aperture_radius
    pairs = neighbour_pairs(calibration.actuator_x, calibration.actuator_y)
    apart = float(np.abs(maps.applied[:, pairs[:, 0]] - maps.applied[:, pairs[:, 1]]).max(initial=1e-6))
    limits = Limits(fit.signal_min, fit.signal_max, pairs, apart)
    if calibration.hysteresis is not None:
        limits = worst_case_limits(calibration.hysteresis.law, limits)
    terms, offset = fit.influence_zernike[PISTON_TILT:], fit.zernike_offset[PISTON_TILT:]
    programme = BoundedProgramme(terms, limits, RIDGE * float(np.square(terms).sum()))

    def error(curvature: float) -> float:
        wanted = conic_coefficients(curvature, 0.0, radius)[PISTON_TILT:] - offset
        return float(np.abs(terms @ programme.solve(wanted) - wanted).max())

    middle = 4.0 / radius**2 * float(offset[0] + limits.middle * terms[0].sum())
    stroke = 4.0 / radius**2 * (limits.high - limits.low) * float(np.abs(terms[0]).sum())
    low, high = reachable_range(lambda curvature: error(curvature) <= TOLERANCE, middle, stroke, STEP)
    over = np.linspace(low, high, SPHERES) if np.isfinite(low) else ()
    return low, high, float(np.median([error(curvature) for curvature in over] or np.nan))


def certificate(
    calibration: Calibration,
    names: Mapping[str, str],
    checks: Sequence[Check] = (),
    values: Mapping[str, Any] = CRITERIA,
    since: Sequence[str] = (),
) -> Section:
    """Verdict, range, promise, validity and names.

    Args:
        names: of `operator` and `instrument`.
        checks: made since the calibration, oldest first.
        values: of the parameters named in CRITERIA.
        since: sentences on why, by later checks, the calibration no longer holds, or only in part.
    """
    reasons = [*calibration.doubts(values["calibrated_error_max"]), *(sentence.rstrip(".") for sentence in since)]
    bound = length(calibration.promise, calibration.wavelength)
    low, high, predicted = spheres(calibration)
    until, reason = valid_until(checks, calibration.promise, calibration.stamp_ns * 1e-9, values)
    verdict = f"approximate: {'; '.join(reasons)}" if reasons else "calibrated"
    reach, prediction, farthest = "neither flat nor mid range is within reach", "not known", 0.0
    if np.isfinite(low):
        reach, farthest = curvatures_text(low, high, 3), max((low, high), key=abs)
        within = "0.01 nm" if predicted < 1e-11 else length(predicted, calibration.wavelength)
        usual = f"largest coefficient error within {within} for half the spheres in the range"
        prediction = f"{usual}, up to {TOLERANCE * 1e9:.0f} nm at the ends"
    promise = (
        f"{bound}, 95 % bound on the largest coefficient error of an open-loop move, in addition to the predicted error"
    )
    rows = [
        ("verdict", verdict),
        ("mirror", f"{calibration.mirror_name}, serial {calibration.mirror_serial}"),
        ("range of curvatures", reach),
        ("promise", f"{promise} and to creep that no map has shown: each move states its own bound"),
        ("predicted", prediction),
        ("repeatable, absolute", accuracy_text(calibration.promise, calibration, farthest)),
        ("instrument's errors subtracted", calibration.reference_surface or "none"),
        ("measured", utc(calibration.stamp_ns)),
        ("valid until", f"{utc(round(until * 1e9))}: {reason}"),
        ("operator", names.get("operator") or "not given (./dm report --operator)"),
        ("instrument", names.get("instrument") or "not given (./dm report --instrument)"),
        ("calibration", calibration.id),
    ]
    sentence = (
        f"This mirror is {'approximately ' if reasons else ''}calibrated: without a sensor in the loop, 95 % of its "
        f"moves to a sphere in the range below are promised to end within {bound} of what is predicted in every "
        "Zernike coefficient beyond tilt."
    )
    if since:
        sentence += " This holds as measured; ./dm status says what holds since then."
    picture = Picture(
        "responses",
        "Responses with their standard errors, and where the actuators stand; dashed: calibrated aperture.",
        figures.response_figure(calibration),
    )
    table = Table("Certificate", ("item", "value"), rows, textual=True)
    return Section("Certificate", [sentence], [table], [picture], sheet=True)


def every_actuator(calibration: Calibration) -> Section:
    """A picture of each actuator."""
    picture = Picture(
        "influence", "Influence functions of all actuators on one scale.", figures.influence_sheet(calibration)
    )
    text = (
        f"Sag per unit {'effective ' if calibration.hysteresis is not None else ''}signal of each actuator, piston and "
        "tilt removed. Small circle: the actuator; cross: it stands outside the calibrated aperture, in that direction."
    )
    return Section("Every actuator", [text], pictures=[picture], sheet=True)
