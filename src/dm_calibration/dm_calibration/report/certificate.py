"""The first pages of the report: what the calibration promises, of which mirror, until when, and who says so; and what
checks have shown since: what drifts, how fast, and when to calibrate next."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import theilslopes

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_parameters import PARAMETERS
from dm_calibration.influence.quality import GRADE_GOOD, GRADE_NAMES
from dm_calibration.influence.surfaces import solve_shape
from dm_calibration.recalibration.check_log import Check
from dm_calibration.report import figures
from dm_calibration.report.content import NM, length, utc
from dm_calibration.report.document import BLUE, GREY, ORANGE, VERMILION, Picture, Section, Table
from dm_common.atomic_write import write_whole
from dm_common.figures import two_fold
from dm_common.geometry import neighbour_pairs
from dm_common.hysteresis.law_shape import certain_limits
from dm_common.limits import Limits
from dm_common.mirror import Mirror
from dm_common.optics.conic import conic_coefficients, conic_sag
from dm_common.optics.zernike import PISTON_TILT

#: Who calibrates with what, asked for once: by `./dm report --operator NAME --instrument NAME`.
PEOPLE = Path("~/.ros/dm_report.json")
#: A curvature is in the range while no coefficient is further off than this, m; it is found to this, 1/m.
TOLERANCE, STEP = 20e-9, 1e-4
DAY_S = 86400.0
#: Fewest checks, and least time between the first and the last, that show a trend.
TREND_MIN, TREND_SPAN_S = 5, DAY_S
#: Checks in the table: the last ones.
SHOWN = 20
DEFAULTS = {parameter.name: parameter.default for parameter in PARAMETERS}


def people(file: Path = PEOPLE) -> dict[str, str]:
    """Names of `operator` and `instrument`, as far as they were given."""
    try:
        content = json.loads(file.expanduser().read_text())
    except (OSError, ValueError):
        return {}
    return {str(name): str(value) for name, value in content.items()} if isinstance(content, dict) else {}


def keep_people(names: Mapping[str, str], file: Path = PEOPLE) -> None:
    """Keep the names that are given for this report and those to come; "" = none, and not asked for again.

    Raises:
        OSError: the file cannot be written.
    """
    if names:
        write_whole(file.expanduser(), json.dumps(people(file) | dict(names)).encode())


def promise(calibration: Calibration) -> float:
    """m, 95 % bound on the largest coefficient error of an open-loop move, from maps that had no part in the fit."""
    found = calibration.hysteresis
    return float(found.held_out_max_zernike if found is not None else calibration.fit.held_out_max_zernike)


def doubts(calibration: Calibration) -> list[str]:
    """The reasons why a calibration is approximate only; empty = it is not."""
    reasons = []
    for grade, name in enumerate(GRADE_NAMES):
        numbers = np.flatnonzero(calibration.fit.grades == grade) + 1
        if grade != GRADE_GOOD and numbers.size:
            reasons.append(f"actuators {', '.join(map(str, numbers))} are {name}")
    if calibration.hysteresis is None:
        reasons.append("hysteresis was not identified")
    if promise(calibration) > DEFAULTS["calibrated_error_max"]:
        reasons.append(f"the promise is above {length(DEFAULTS['calibrated_error_max'], 0.0)}")
    return reasons


def curvatures(calibration: Calibration) -> tuple[float, float]:
    """Smallest and largest curvature (1/m) of a sphere that the signals of the maps reach whatever the actuators went
    through before; (nan, nan) = not even 0.
    """
    fit, maps, radius = calibration.fit, calibration.maps, calibration.aperture_radius
    x, y = calibration.actuator_x, calibration.actuator_y
    pairs = neighbour_pairs(x, y)
    apart = float(np.abs(maps.applied[:, pairs[:, 0]] - maps.applied[:, pairs[:, 1]]).max(initial=1e-6))
    limits = Limits(fit.signal_min, fit.signal_max, pairs, apart)
    if calibration.hysteresis is not None:
        limits = certain_limits(calibration.hysteresis.law, limits)
    mirror = Mirror(calibration.mirror_name, calibration.mirror_serial, x, y, radius, limits)

    def reached(curvature: float) -> bool:
        signals, _left = solve_shape(conic_sag(radius * fit.points.x, radius * fit.points.y, curvature), fit, mirror)
        error = fit.influence_zernike @ signals + fit.zernike_offset - conic_coefficients(curvature, 0.0, radius)
        return bool(np.abs(error[PISTON_TILT:]).max() <= TOLERANCE) and limits.allow_neighbours(signals)

    def edge(far: float) -> float:
        near = 0.0
        while abs(far - near) > STEP:
            middle = 0.5 * (near + far)
            near, far = (middle, far) if reached(middle) else (near, middle)
        return near

    if not reached(0.0):
        return (np.nan, np.nan)
    stroke = 4.0 * (limits.high - limits.low) * float(np.abs(fit.influence_zernike[PISTON_TILT]).sum()) / radius**2
    return edge(-stroke), edge(stroke)


def certificate(calibration: Calibration, names: Mapping[str, str], checks: Sequence[Check] = ()) -> Section:
    """Verdict, range, promise, term and names.

    Args:
        names: of `operator` and `instrument`.
        checks: since then, oldest first.
    """
    reasons, bound = doubts(calibration), length(promise(calibration), calibration.wavelength)
    low, high = curvatures(calibration)
    until, _reason = next_calibration(checks, promise(calibration), calibration.created_ns * 1e-9)
    verdict = f"approximate: {'; '.join(reasons)}" if reasons else "calibrated"
    reach = f"{low:+.3f} to {high:+.3f} 1/m ({2 * low:+.3f} to {2 * high:+.3f} dioptre)"
    farthest = max((low, high), key=abs) if np.isfinite(low) else 0.0
    rows = [
        ("verdict", verdict),
        ("mirror", f"{calibration.mirror_name}, serial {calibration.mirror_serial}"),
        ("range of curvatures", reach if np.isfinite(low) else "flat is out of reach"),
        ("promise", f"{bound}, 95 % bound on the largest coefficient error of an open-loop move"),
        ("repeatable, absolute", two_fold(promise(calibration), calibration, farthest)),
        ("instrument's errors taken off", calibration.reference_surface or "none"),
        ("measured", utc(calibration.stamp_ns)),
        ("valid until", f"{utc(round(until * 1e9))}, longer when ./dm check agrees"),
        ("operator", names.get("operator") or "not given (./dm report --operator)"),
        ("instrument", names.get("instrument") or "not given (./dm report --instrument)"),
        ("calibration", calibration.id),
    ]
    sentence = (
        f"This mirror is {'approximately ' if reasons else ''}calibrated: without a sensor in the loop, 95 % of its "
        f"moves to a sphere in the range below are promised to end within {bound} of it in every Zernike coefficient "
        "beyond tilt."
    )
    picture = Picture(
        "responses",
        "Responses with their standard errors, and where the actuators stand; dashed: calibrated aperture.",
        figures.response_figure(calibration),
    )
    return Section("Certificate", [sentence], [Table("Certificate", ("item", "value"), rows, textual=True)], [picture])


def next_calibration(checks: Sequence[Check], promised: float, created_s: float) -> tuple[float, str]:
    """When to calibrate next, s since the epoch, and why.

    The trend is the median of all slopes between two checks; it counts where its 90 % interval is above zero.

    Args:
        checks: oldest first.
        promised: 95 % bound on the largest coefficient error, m.
        created_s: when the calibration was made.
    """
    agreed = [check.time for check in checks if check.accepted]
    stale = max([created_s, *agreed]) + DEFAULTS["updates.stale_after"]
    if len(checks) < TREND_MIN or checks[-1].time - checks[0].time < TREND_SPAN_S:
        return stale, "too few checks to see a trend; a check that agrees puts it off"
    time, error = (np.array([getattr(check, name) for check in checks]) for name in ("time", "max_zernike"))
    slope, level, low, _high = theilslopes(error, time - time[0], 0.9)
    per_month = f"{30 * DAY_S * slope * NM:+.2f} nm in 30 days"
    if low <= 0.0:
        return stale, f"no growth of the error beyond chance ({per_month}); a check that agrees puts it off"
    reached = float(time[0] + max(promised - level, 0.0) / slope)
    return min(stale, max(reached, float(time[-1]))), f"the error grows by {per_month} and reaches the promise then"


def checks_section(calibration: Calibration, checks: Sequence[Check]) -> Section:
    """Table, chart and a sentence on each question.

    Args:
        checks: at least one, oldest first.
    """
    last, created, promised = checks[-1], calibration.created_ns * 1e-9, promise(calibration)
    days = max(last.time - created, 1.0) / DAY_S
    when, reason = next_calibration(checks, promised, created)
    outside = sum(check.max_zernike > promised for check in checks)
    sentences = [
        f"{len(checks)} maps were compared with this calibration, the last one {utc(round(last.time * 1e9))}; "
        f"{sum(not check.accepted for check in checks)} disagreed, {outside} showed more than the promise of "
        f"{length(promised, calibration.wavelength)}: one in twenty may.",
        f"In {days:.1f} days gains have changed by up to {last.gain_drift:.2%} (actuator {last.actuator}), the figure "
        f"by {last.offset_drift * NM:.2f} nm rms; the calibration in use follows.",
        f"Calibrate next by {utc(round(when * 1e9))}: {reason}.",
    ]
    rows = [
        (
            utc(round(check.time * 1e9)),
            "yes" if check.accepted else "no",
            f"{check.max_zernike * NM:.2f}",
            f"{check.surprise:.1f}",
            f"{check.gain_drift:.2%} ({check.actuator})",
            f"{check.offset_drift * NM:.2f}",
        )
        for check in checks[-SHOWN:]
    ]
    header = ("map", "agreed", "largest coefficient, nm", "surprise", "gains (actuator)", "figure, nm rms")
    picture = Picture(
        "checks", "Checks since the calibration; dashed: what it promises.", _chart(checks, promised, created)
    )
    return Section("Checks since then", sentences, [Table("The last checks", header, rows)], [picture])


def _chart(checks: Sequence[Check], promised: float, created: float) -> Figure:
    figure = Figure(figsize=(7.5, 3.2), layout="constrained")
    axes = figure.subplots()
    days = np.array([(check.time - created) / DAY_S for check in checks])
    agreed = np.array([bool(check.accepted) for check in checks])
    error = np.array([check.max_zernike for check in checks]) * NM
    axes.plot(days[agreed], error[agreed], "o", color=BLUE, label="largest coefficient error")
    axes.plot(days[~agreed], error[~agreed], "x", color=VERMILION, label="the same, map disagreed")
    axes.plot(days, [check.offset_drift * NM for check in checks], color=ORANGE, label="change of the figure, rms")
    axes.axhline(promised * NM, color=GREY, linestyle="--")
    axes.set(xlabel="days since the calibration", ylabel="nm", ylim=(0.0, None))
    axes.legend(fontsize="small")
    return figure
