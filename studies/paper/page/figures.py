"""Figs. 4 and 5 and the choice of epsilon: regions over the actuators, regional errors, weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from dm_calibration.influence.region_weighting import RegionWeighting
from dm_calibration.report.document import BLUE, GREEN, GREY, ORANGE, PURPLE, VERMILION
from dm_common.geometry import pitch
from dm_common.mirror import Mirror
from dm_common.optics.sample_regions import AREA_FRACTIONS
from dm_common.optics.zernike import PISTON_TILT, TERMS
from studies.paper.regions import RegionStatistics
from studies.paper.sampling_study import SamplingStudy

NM = 1e9


def regions_figure(mirror: Mirror, plate_diameter: float) -> Figure:
    """Fig. 4: the ten concentric apertures over the actuator layout; lengths in m."""
    figure = Figure(figsize=(7.6, 6.2), layout="constrained")
    axes = figure.add_subplot()
    radius, spacing = mirror.working_radius * 1e3, pitch(mirror.x, mirror.y) * 1e3
    shades = ListedColormap(colormaps["cividis"](np.linspace(0.0, 1.0, len(AREA_FRACTIONS))))
    for number, share in reversed(list(enumerate(AREA_FRACTIONS))):
        axes.add_patch(Circle((0, 0), radius * np.sqrt(share), facecolor=shades(number), edgecolor="white"))
    edges = np.concatenate(([0.0], 100 * np.asarray(AREA_FRACTIONS)))
    # The colour bar is beside the aperture, where no label can touch an actuator.
    figure.colorbar(
        ScalarMappable(BoundaryNorm(edges, shades.N), shades),
        ax=axes,
        ticks=edges[1:],
        label="region: disc up to this share of the area, %",
        shrink=0.8,
    )
    axes.add_patch(Circle((0, 0), plate_diameter * 500, fill=False, edgecolor="black", linewidth=1.2))
    spot = 0.2 * spacing
    for number, (x, y) in enumerate(zip(mirror.x * 1e3, mirror.y * 1e3, strict=True), start=1):
        axes.add_patch(Circle((x, y), spot, facecolor="white", edgecolor="black", linewidth=0.8))
        axes.text(x, y, str(number), fontsize=6.5, ha="center", va="center")
    reach = plate_diameter * 500 * 1.04
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="x, mm", ylabel="y, mm")
    axes.set_title(
        f"regions of 10 … 100 % of the working aperture ({2 * radius:g} mm) over the {len(mirror.x)} actuators;\n"
        f"outer circle: edge of the {plate_diameter * 1e3:g} mm plate",
        fontsize=9,
    )
    return figure


def regional_errors_figure(panels: Mapping[str, tuple[RegionStatistics, RegionStatistics]]) -> Figure:
    """Fig. 5: one row of panels (a) and (b) for each bench, by the bench's name."""
    figure = Figure(figsize=(11, 4.2 * len(panels)), layout="constrained")
    rows = figure.subplots(len(panels), 2, squeeze=False)
    for line, (bench, pair) in zip(rows, panels.items(), strict=True):
        for axes, panel, title in zip(line, pair, ("(a) p01–p58", "(b) pz01–pz11"), strict=True):
            _regional_errors(axes, panel)
            axes.set_title(f"{title}, {bench}", fontsize=10)
    return figure


def _regional_errors(axes: Axes, panel: RegionStatistics) -> None:
    area = 100 * panel.area_fractions
    shades = colormaps["viridis"]
    for number, (label, errors) in enumerate(zip(panel.labels, panel.rms * NM, strict=True)):
        place = number / max(len(panel.labels) - 1, 1)
        sideways = area + 3.0 * (place - 0.5)
        if panel.averaged[number]:
            axes.plot(sideways, errors, ".", color=shades(place), markersize=4, alpha=0.7)
        else:
            marker = "x" if panel.averaged[:number].all() else "+"
            axes.plot(sideways, errors, marker, color=VERMILION, markersize=6, label=f"{label}, not in the mean")
    spread = np.sqrt(panel.variance) * NM
    axes.fill_between(
        area, panel.mean * NM - spread, panel.mean * NM + spread, color=BLUE, alpha=0.12, label="± one standard dev."
    )
    axes.plot(area, panel.mean * NM, "o-", color=BLUE, label="mean")
    axes.set(xlabel="area of the region, % of the aperture", ylabel="rms surface control error, nm", ylim=(0, None))
    axes.legend(fontsize=8, loc="upper right")
    axes.grid(alpha=0.3)


def weights_figure(weightings: Mapping[str, RegionWeighting], median_weights: Mapping[str, np.ndarray]) -> Figure:
    """Weights of Eq. (8) by region, and the held-out error against epsilon, for each bench by name."""
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    area = 100 * np.asarray(AREA_FRACTIONS)
    for (name, weighting), colour in zip(weightings.items(), (BLUE, ORANGE, GREEN), strict=False):
        left.plot(area, median_weights[name], "o-", color=colour, label=f"{name}, ε = median of r")
        left.plot(area, weighting.weights, "s--", color=colour, label=f"{name}, ε by cross-validation")
        right.semilogx(weighting.candidates * NM**2, weighting.score * NM, "o-", color=colour, label=name)
        right.axhline(weighting.score_unweighted * NM, color=colour, linestyle=":", linewidth=1)
        right.plot(weighting.epsilon * NM**2, weighting.score.min() * NM, "*", color=colour, markersize=14)
    left.set(xlabel="area of the region, % of the aperture", ylabel="weight w of Eq. (8)", ylim=(0, 1.08))
    right.set(xlabel="ε, nm²", ylabel="held-out regional error, nm")
    right.set_title("star: ε chosen; dotted: no weights", fontsize=9)
    for axes in (left, right):
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3)
    return figure


def sampling_figure(study: SamplingStudy) -> Figure:
    """Bias of each coefficient beyond tilt, and ringing at the rim, for each way of sampling."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 1))
    first = PISTON_TILT
    names = [f"{'c' if term.kind == 'cos' else 's' if term.kind == 'sin' else ''}{term.n},{term.m}" for term in TERMS]
    place = np.arange(len(TERMS) - first)
    for number, (way, colour) in enumerate(zip(study.results.values(), (GREY, VERMILION, BLUE, ORANGE), strict=True)):
        if way.bias[first:].max() > 1e-3 / NM:
            left.semilogy(place, way.bias[first:] * NM, "o-", color=colour, markersize=4, linewidth=0.8, label=way.name)
        right.bar(number, way.rim_ringing_rms * NM, color=colour)
        right.bar(number, way.rim_error_rms * NM, fill=False, edgecolor=colour)
    left.set_xticks(place, names[first:], rotation=90, fontsize=7)
    left.set(xlabel="term n,m (c cosine, s sine)", ylabel="bias, nm")
    left.legend(fontsize=8)
    left.grid(axis="y", alpha=0.3)
    short = [name.replace("edge-clustered, ", "").replace("-", "-\n", 1) for name in study.results]
    right.set_xticks(range(len(short)), short, fontsize=7)
    right.set_ylabel("on the rim, rms, nm")
    right.set_title("filled: ringing; outline: surface less terms", fontsize=8)
    return figure


def predictions_figure(
    surfaces: Sequence[str], err_pct: Mapping[str, np.ndarray], paper_pct: Mapping[str, np.ndarray], limit_pct: float
) -> Figure:
    """Table 3 as a picture: |RelErr| of each test surface and model (S,), %, beside the paper's."""
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    axes = figure.add_subplot()
    place = np.arange(len(surfaces))
    series = [(f"here, {name}", values) for name, values in err_pct.items()]
    series += [(f"the paper, {name}", values) for name, values in paper_pct.items()]
    colours = [BLUE, VERMILION, GREEN, PURPLE, ORANGE, GREY, "black"]
    step = 0.8 / max(len(series) - 1, 1)
    for number, (name, values) in enumerate(series):
        marker = "o" if name.startswith("here") else "D"
        fill = "full" if name.startswith("here") else "none"
        axes.plot(
            place - 0.4 + number * step,
            np.maximum(np.abs(values), 0.05),
            marker,
            fillstyle=fill,
            color=colours[number % len(colours)],
            label=name,
        )
    axes.axhline(limit_pct, color="black", linewidth=0.8, linestyle=":")
    axes.annotate(f"{limit_pct:g} %", (-0.45, limit_pct), fontsize=8, va="bottom")
    axes.set(yscale="log", xticks=place, xticklabels=surfaces, ylabel="|RelErr|, %")
    for edge in place[:-1] + 0.5:
        axes.axvline(edge, color="black", linewidth=0.4, alpha=0.3)
    axes.legend(fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.1))
    axes.grid(axis="y", alpha=0.3)
    return figure
