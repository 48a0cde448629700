"""Figures of the report: influence functions, residuals, regions, coefficients. Lengths in m; drawn in mm and nm."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from dm_calibration.calibration import Calibration
from dm_calibration.influence.maps import StepKind
from dm_calibration.influence.quality import GRADE_GOOD, GRADE_NAMES
from dm_calibration.report.document import BLUE, DIVERGING, GREEN, GREY, ORANGE, PURPLE, SKY_BLUE, VERMILION, YELLOW
from dm_common import Floats
from dm_common.optics.sample_regions import AREA_FRACTIONS
from dm_common.optics.sampling import on_disc
from dm_common.optics.zernike import PISTON_TILT, TERMS

NM, MM = 1e9, 1e3
#: Width of a small map, pixels.
PIXELS = 61
#: Number of small maps in a row.
COLUMNS = 7
KIND_COLOURS: dict[str, str] = dict(
    zip(
        [kind for kind in StepKind if kind is not StepKind.DEGAUSS],  # which has no map
        (GREY, BLUE, GREEN, ORANGE, SKY_BLUE, PURPLE, YELLOW),
        strict=True,
    )
)


def influence_sheet(calibration: Calibration) -> Figure:
    """One small map per actuator, all on one scale, with its grade."""
    fit = calibration.fit
    maps = on_disc(fit.influence_sag.T, fit.points, PIXELS) * NM
    radius = calibration.aperture_radius * MM
    rows = -(-len(maps) // COLUMNS)
    # All maps in one pair of axes: axes for each map would take ten times as long as all the rest.
    across, down = 2.2 * radius, 2.7 * radius
    columns, lines = across * np.arange(COLUMNS), -down * np.arange(rows)
    figure = Figure(figsize=(10.5, 1.45 * rows + 0.7), layout="constrained")
    axes = figure.add_subplot()
    scale = Normalize(-np.nanmax(np.abs(maps)), np.nanmax(np.abs(maps)))
    for number, sag in enumerate(maps):
        centre = np.array([columns[number % COLUMNS], lines[number // COLUMNS]])
        left, bottom, right, top = *(centre - radius), *(centre + radius)
        image = axes.imshow(sag, origin="lower", extent=(left, right, bottom, top), cmap=DIVERGING, norm=scale)
        axes.add_patch(Circle(tuple(centre), radius, fill=False, edgecolor=GREY, linewidth=0.6))
        # For an actuator outside the aperture only the direction is shown.
        place = np.array([calibration.actuator_x[number], calibration.actuator_y[number]]) * MM
        distance = max(float(np.hypot(*place)), 1e-12)
        outside = distance > radius
        x, y = centre + (place * radius / distance if outside else place)
        axes.plot(x, y, "x" if outside else "o", color="black", markersize=3, markerfacecolor="none")
        grade = fit.grades[number]
        emphasis: dict[str, Any] = {} if grade == GRADE_GOOD else {"color": VERMILION, "fontweight": "bold"}
        label = f"{number + 1}: {GRADE_NAMES[grade]}"
        axes.text(centre[0], top + 0.1 * radius, label, fontsize=8, ha="center", **emphasis)
    ticks = np.array([-0.5, 0.0, 0.5]) * radius
    labels = [f"{tick:.3g}" for tick in ticks]
    axes.set_xticks((columns[:, None] + ticks).ravel(), labels * COLUMNS, fontsize=6.5)
    axes.set_yticks((lines[:, None] + ticks).ravel(), labels * rows, fontsize=6.5)
    axes.set(xlim=(-1.1 * radius, columns[-1] + 1.1 * radius), ylim=(lines[-1] - 1.1 * radius, 1.6 * radius))
    axes.set(xlabel="x, mm", ylabel="y, mm")
    axes.spines[:].set_visible(False)
    figure.colorbar(image, ax=axes, shrink=0.4, label="sag per unit signal, nm")
    return figure


def response_figure(calibration: Calibration) -> Figure:
    """Response of each actuator with its standard error, and the layout with the grades."""
    fit = calibration.fit
    figure = Figure(figsize=(10.5, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    numbers = np.arange(1, fit.actuators + 1)
    good = fit.grades == GRADE_GOOD
    for chosen, colour, label in ((good, BLUE, "good"), (~good, VERMILION, "not good")):
        if chosen.any():
            left.bar(numbers[chosen], fit.response[chosen] * NM, color=colour, label=label)
    left.errorbar(numbers, fit.response * NM, fit.standard_error * NM, fmt="none", ecolor="black", elinewidth=0.8)
    left.set(xlabel="actuator", ylabel="rms sag of a unit signal, nm")
    left.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    left.legend(fontsize=8)
    left.grid(axis="y", alpha=0.3)
    x, y = calibration.actuator_x * MM, calibration.actuator_y * MM
    shown = right.scatter(x, y, c=fit.response * NM, s=170, cmap="cividis")
    right.scatter(x[~good], y[~good], s=300, facecolors="none", edgecolors=VERMILION, linewidths=2)
    middle = 0.5 * (fit.response.min() + fit.response.max())
    for number, response in enumerate(fit.response):
        colour = "white" if response < middle else "black"
        right.text(x[number], y[number], str(number + 1), fontsize=6.5, ha="center", va="center", color=colour)
    right.add_patch(Circle((0, 0), calibration.aperture_radius * MM, fill=False, edgecolor=GREY, linestyle="--"))
    right.set(aspect="equal", xlabel="x, mm", ylabel="y, mm")
    right.margins(0.12)
    figure.colorbar(shown, ax=right, label="response, nm")
    return figure


def residual_figure(calibration: Calibration) -> Figure:
    """Residual of each map over the run by its kind; maps that were dropped are marked."""
    maps, fit = calibration.maps, calibration.fit
    figure = Figure(figsize=(10.5, 3.4), layout="constrained")
    axes = figure.add_subplot()
    minutes = (maps.stamp_ns - maps.stamp_ns.min()) / 60e9
    for kind, colour in KIND_COLOURS.items():
        chosen = np.array([each == kind for each in maps.kind]) & fit.used
        if chosen.any():
            axes.plot(minutes[chosen], fit.map_residual[chosen] * NM, ".", color=colour, label=f"{kind} maps")
    if not fit.used.all():
        dropped = minutes[~fit.used]
        axes.plot(dropped, np.zeros(dropped.size), "x", color=VERMILION, markersize=8, clip_on=False, label="dropped")
    for value, style, name in ((fit.in_sample_rms, "-", "in-sample rms"), (fit.held_out_rms, "--", "held-out rms")):
        axes.axhline(value * NM, color="black", linewidth=0.9, linestyle=style, label=f"{name}: {value * NM:.2f} nm")
    axes.set(xlabel="time since the first map, min", ylabel="rms sag left by the fit, nm", ylim=(0, None))
    axes.legend(fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    axes.grid(alpha=0.3)
    return figure


def regions_figure(regional: Floats, labels: Sequence[str]) -> Figure:
    """Residual rms inside the ten concentric discs: each map of `regional` (M, 10), median and 90th percentile."""
    figure = Figure(figsize=(10.5, 3.4), layout="constrained")
    axes = figure.add_subplot()
    area = 100 * np.asarray(AREA_FRACTIONS)
    for kind in dict.fromkeys(labels):
        rows = regional[[label == kind for label in labels]]
        place = area + 4.0 * (np.arange(len(rows))[:, None] / max(len(rows) - 1, 1) - 0.5)
        axes.plot(place.ravel(), rows.ravel() * NM, ".", color=KIND_COLOURS[kind], markersize=2.5, alpha=0.4)
        axes.plot([], [], ".", color=KIND_COLOURS[kind], label=f"{kind} maps")
    axes.plot(area, np.median(regional, axis=0) * NM, "o-", color="black", label="median")
    axes.plot(area, np.quantile(regional, 0.9, axis=0) * NM, "s--", color="black", label="90th percentile")
    axes.set(xlabel="area of the region, % of the aperture", ylabel="rms residual, nm", ylim=(0, None))
    axes.legend(fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    axes.grid(alpha=0.3)
    return figure


def coefficients_figure(rms: Floats, hysteresis_sigma: Floats | None) -> Figure:
    """`rms` residual (K,) of each Zernike coefficient beyond tilt, and the error of held-out moves if known."""
    figure = Figure(figsize=(10.5, 3.4), layout="constrained")
    axes = figure.add_subplot()
    first = PISTON_TILT
    place = np.arange(first, len(rms))
    share = 0.8 if hysteresis_sigma is None else 0.4
    axes.bar(place - (0.8 - share) / 2, rms[first:] * NM, share, color=BLUE, label="maps of the fit (in-sample)")
    if hysteresis_sigma is not None:
        held_out = hysteresis_sigma[first:] * NM
        axes.bar(place + 0.2, held_out, share, color=ORANGE, label="held-out moves, noise of maps removed")
    names = [f"$Z_{{{term.n}}}^{{{term.m}}}$" + f"\n{term.kind}" * bool(term.kind) for term in TERMS[first:]]
    axes.set_xticks(place, names[: len(place)], fontsize=8)
    axes.set(xlabel="Zernike term (Born & Wolf, peak-normalised)", ylabel="rms error of the coefficient, nm")
    axes.legend(fontsize=8)
    axes.grid(axis="y", alpha=0.3)
    return figure
