"""Figs. 6 to 9: controlled surfaces, and their errors by Zernike term and order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from dm_calibration.report.document import BLUE, GREEN, ORANGE, PURPLE, VERMILION
from dm_common.optics.zernike import PISTON_TILT, TERMS
from studies.paper.control import LOOP_HYSTERESIS, OPEN_HYSTERESIS, Series
from studies.paper.page.figures import NM
from studies.paper.reported import CLAIM_PARTS, WAVELENGTH

#: Smaller errors are drawn at this value, m: far below the noise of any interferometer.
FLOOR = 1e-11


def surfaces_figure(series: Mapping[str, Series], radius: float, title: str) -> Figure:
    """Figs. 6 and 7: measured surfaces of the first series, and below them the errors of each, by the bench's name.

    Args:
        radius: of the aperture, m.
    """
    first = next(iter(series.values()))
    count = len(first.shots)
    figure = Figure(figsize=(1.32 * count + 1.6, 1.75 * (len(series) + 1) + 0.5), layout="constrained")
    figure.suptitle(title, fontsize=11)
    rows = figure.subplots(len(series) + 1, count, squeeze=False, sharex=True, sharey=True)
    images: list[Any] = []
    limit = max(float(np.nanmax(np.abs(shot.sag))) for shot in first.shots) * 1e6
    for axes, shot in zip(rows[0], first.shots, strict=True):
        images.append(_map(axes, shot.sag * 1e6, radius, limit, "viridis"))
        axes.set_title(f"{shot.target.curvature:+.3f} 1/m\nfrom {shot.start}", fontsize=7.5)
    figure.colorbar(images[-1], ax=rows[0].tolist(), label="sag, µm", shrink=0.9, pad=0.01)
    rows[0, 0].set_ylabel("measured\ny, mm", fontsize=8)
    for line, (bench, each) in zip(rows[1:], series.items(), strict=True):
        limit = max(float(np.nanpercentile(np.abs(shot.residual), 99.5)) for shot in each.shots) * NM
        for axes, shot in zip(line, each.shots, strict=True):
            images.append(_map(axes, shot.residual * NM, radius, limit, "PuOr"))
            axes.set_title(f"{shot.rms * NM:.1f} nm rms", fontsize=7.5)
        figure.colorbar(images[-1], ax=line.tolist(), label="error, nm", shrink=0.9, pad=0.01)
        line[0].set_ylabel(f"error, {bench}\ny, mm", fontsize=8)
    for axes in rows[-1]:
        axes.set_xlabel("x, mm", fontsize=8)
    return figure


def _map(axes: Axes, values: np.ndarray, radius: float, limit: float, colours: str) -> Any:
    edge = radius * 1e3
    axes.tick_params(labelsize=6)
    axes.set(xticks=[-10, 0, 10], yticks=[-10, 0, 10])
    return axes.imshow(values, extent=(-edge, edge, -edge, edge), cmap=colours, vmin=-limit, vmax=limit)


def coefficients_figure(series: Mapping[str, Series], title: str) -> Figure:
    """Figs. 8 and 9: |true coefficient error| of every term beyond tilt, one panel for each series by name."""
    figure = Figure(figsize=(14, 4.4), layout="constrained")
    figure.suptitle(title, fontsize=11)
    panels = figure.subplots(1, len(series), sharey=True, squeeze=False)[0]
    curvatures = [shot.target.curvature for shot in next(iter(series.values())).shots]
    scale, colours = Normalize(min(curvatures), max(curvatures)), colormaps["cividis"]
    names = [f"{'c' if term.kind == 'cos' else 's' if term.kind == 'sin' else ''}{term.n},{term.m}" for term in TERMS]
    place = np.arange(len(TERMS) - PISTON_TILT)
    for axes, (name, each) in zip(panels, series.items(), strict=True):
        for shot in each.shots:
            error = np.maximum(np.abs(shot.true_zernike[PISTON_TILT:]), FLOOR) * NM
            axes.semilogy(place, error, "o", markersize=3.5, color=colours(scale(shot.target.curvature)))
        lines(axes)
        for edge in np.flatnonzero(np.diff([term.n for term in TERMS[PISTON_TILT:]])) + 0.5:
            axes.axvline(edge, color="black", linewidth=0.5, alpha=0.4)
        axes.set_xticks(place, names[PISTON_TILT:], rotation=90, fontsize=7)
        axes.set(title=name, xlabel="term n,m; lines part the orders 2 to 5")
        axes.title.set_fontsize(9)
        axes.xaxis.label.set_fontsize(8)
        axes.grid(axis="y", alpha=0.3)
    panels[0].set_ylabel("|coefficient error|, nm")
    figure.colorbar(ScalarMappable(scale, colours), ax=panels.tolist(), label="curvature, 1/m", pad=0.01)
    return figure


def lines(axes: Axes) -> None:
    """The paper's two marks, parts of the wavelength, named in the right margin."""
    for parts in CLAIM_PARTS:
        level = WAVELENGTH / parts * NM
        axes.axhline(level, color=VERMILION, linewidth=0.9, linestyle="--")
        axes.text(
            1.005, level, f"λ/{parts}", transform=axes.get_yaxis_transform(), fontsize=7, color=VERMILION, va="center"
        )


def sweep_figure(series: Mapping[str, Sequence[Series]]) -> Figure:
    """Largest true coefficient error against curvature: one panel for each bench by name, one line for each series."""
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    panels = figure.subplots(1, len(series), sharey=True, squeeze=False)[0]
    styles = {"stored": ":", "measured": "-", "closed loop": "--", OPEN_HYSTERESIS: (0, (1, 3)), LOOP_HYSTERESIS: "-."}
    colours: dict[str, str] = {}
    for axes, (bench, rows) in zip(panels, series.items(), strict=True):
        for each in rows:
            colour = colours.setdefault(each.method, (BLUE, ORANGE, GREEN, PURPLE)[len(colours) % 4])
            curvature = [shot.target.curvature for shot in each.shots]
            axes.semilogy(
                curvature,
                each.true_max_zernike * NM,
                linestyle=styles[each.reading],
                color=colour,
                marker="o",
                markersize=3,
                linewidth=1.1,
                label=f"{each.method}, {each.reading}",
            )
        lines(axes)
        axes.set(xlabel="curvature, 1/m (concave positive)", title=bench)
        axes.title.set_fontsize(10)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("largest coefficient error, nm")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=7.5, ncols=5, handlelength=3.5, loc="outside lower center")
    return figure
