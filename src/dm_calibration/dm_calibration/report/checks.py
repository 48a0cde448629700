"""Text of the report: results of checks since the calibration, drift and its rate, and the term of validity."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_parameters import CRITERIA
from dm_calibration.recalibration.check_log import Check
from dm_calibration.report.content import NM, length, utc
from dm_calibration.report.document import BLUE, GREY, ORANGE, VERMILION, Picture, Section, Table

DAY_S = 86400.0
#: Fewest checks, and least time (s) between the first and the last, from which a trend is computed.
TREND_MIN, TREND_SPAN_S = 5, DAY_S
#: Most checks from which a trend is computed, evenly chosen: the slopes of all pairs take room with their square.
TREND_MAX = 500
#: Number of checks in the table, the latest ones.
SHOWN = 20


def valid_until(
    checks: Sequence[Check], promised: float, measured_s: float, values: Mapping[str, Any] = CRITERIA
) -> tuple[float, str]:
    """Time until which a calibration is valid, s since the epoch, and the reason; the next calibration is due then.

    The trend is the median of all slopes between two checks; it counts if its 90 % interval is above zero.

    Args:
        checks: oldest first.
        promised: 95 % bound on the largest coefficient error, m.
        measured_s: time of the last map of the calibration, s since the epoch.
        values: of the parameters named in CRITERIA.
    """
    agreed = [check.time for check in checks if check.accepted]
    stale = max([measured_s, *agreed]) + values["updates.stale_after"]
    if len(checks) < TREND_MIN or checks[-1].time - checks[0].time < TREND_SPAN_S:
        return stale, "too few checks to see a trend; each check that agrees extends it"
    from scipy.stats import theilslopes  # here: it takes as long to import as half of a report's other libraries

    chosen = checks[:: -len(checks) // TREND_MAX][::-1]  # the last one is among them
    time, error = (np.array([getattr(check, name) for check in chosen]) for name in ("time", "max_zernike"))
    slope, level, low, _high = theilslopes(error, time - time[0], 0.9)
    if low <= 0.0:
        return stale, "no growth of the error beyond chance; each check that agrees extends it"
    per_month = f"{30 * DAY_S * slope * NM:+.2f} nm in 30 days"
    reached = max(float(time[0] + max(promised - level, 0.0) / slope), float(time[-1]))
    if reached > stale:
        return (
            stale,
            f"the error grows by {per_month}, within the promise until then; each check that agrees extends it",
        )
    return reached, f"the error grows by {per_month} and reaches the promise then"


def checks_section(calibration: Calibration, checks: Sequence[Check], values: Mapping[str, Any] = CRITERIA) -> Section:
    """Table, chart, and sentences on agreement, drift and validity.

    Args:
        checks: at least one, oldest first.
        values: of the parameters named in CRITERIA.
    """
    last, measured, promised = checks[-1], calibration.stamp_ns * 1e-9, calibration.promise
    days = max(last.time - measured, 1.0) / DAY_S
    until, reason = valid_until(checks, promised, measured, values)
    outside = sum(check.accepted and check.max_zernike > promised for check in checks)
    sentences = [
        f"{len(checks)} maps were compared with this calibration, the last one {utc(round(last.time * 1e9))}; "
        f"{sum(not check.accepted for check in checks)} disagreed; of the others {outside} showed more than the "
        f"promise of {length(promised, calibration.wavelength)}: one in twenty may.",
        f"In {days:.1f} days gains have changed by up to {last.gain_drift:.2%} (actuator {last.actuator}), the figure "
        f"by {last.offset_drift * NM:.2f} nm rms; the calibration in use follows, until its updates are forgotten "
        "(./dm check --forget).",
        f"Valid until {utc(round(until * 1e9))}: {reason}.",
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
        "checks", "Checks since the calibration; dashed: what it promises.", _chart(checks, promised, measured)
    )
    return Section("Checks since then", sentences, [Table("The last checks", header, rows)], [picture])


def _chart(checks: Sequence[Check], promised: float, measured: float) -> Figure:
    figure = Figure(figsize=(7.5, 3.2), layout="constrained")
    axes = figure.subplots()
    days = np.array([(check.time - measured) / DAY_S for check in checks])
    agreed = np.array([bool(check.accepted) for check in checks])
    error = np.array([check.max_zernike for check in checks]) * NM
    axes.plot(days[agreed], error[agreed], "o", color=BLUE, label="largest coefficient error")
    axes.plot(days[~agreed], error[~agreed], "x", color=VERMILION, label="the same, map disagreed")
    axes.plot(days, [check.offset_drift * NM for check in checks], color=ORANGE, label="change of the figure, rms")
    axes.axhline(promised * NM, color=GREY, linestyle="--")
    axes.set(xlabel="days since the calibration", ylabel="nm", ylim=(0.0, None))
    axes.legend(fontsize="small")
    return figure
