"""Pictures of commands, maps and residuals, with physical axes and a colour-blind-safe scale."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, RegularPolygon

from dm_common.optics.piston_tilt import remove_plane
from dm_tools.output import WAVELENGTH

#: Shares of the sweep shown as columns: its ends, its middle and in between.
COLUMNS = (0.0, 0.3, 0.5, 0.7, 1.0)


def draw_command(axes: Axes, signals: np.ndarray, positions: np.ndarray, aperture_radius: float) -> Any:
    """Actuator signals (N,) as hexagons at `positions` (N, 2) [m], with the working aperture."""
    distances = np.linalg.norm(positions[1:] - positions[0], axis=1)
    side = distances.min() * 1e3 / np.sqrt(3.0)
    scale, colours = Normalize(-1, 1), colormaps["cividis"]
    for number, ((x, y), signal) in enumerate(zip(positions * 1e3, signals, strict=True), start=1):
        axes.add_patch(RegularPolygon((x, y), 6, radius=side, facecolor=colours(scale(signal)), edgecolor="white"))
        brightness = "black" if signal > 0.1 else "white"
        axes.text(x, y, str(number), ha="center", va="center", fontsize=5, color=brightness)
    axes.add_patch(Circle((0, 0), aperture_radius * 1e3, fill=False, edgecolor="tab:red", linewidth=0.8))
    reach = np.abs(positions).max() * 1e3 + side
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    return ScalarMappable(scale, colours)


def draw_map(axes: Axes, values: np.ndarray, info: Any, limit: float, colours: str) -> Any:
    """A map (H, W), row 0 = top, in the mirror's coordinates [mm]; the scale is symmetric, -limit .. +limit."""
    pitch = info.pitch * 1e3
    left, top = -(info.centre_x + 0.5) * pitch, (info.centre_y + 0.5) * pitch
    extent = (left, left + info.width * pitch, top - info.height * pitch, top)
    image = axes.imshow(values, extent=extent, cmap=colours, vmin=-limit, vmax=limit, interpolation="nearest")
    axes.set(aspect="equal")
    return image


def save_sweep_figure(
    rows: Sequence[dict[str, Any]],
    path: Path,
    title: str,
    mirror: Any,
    without_hysteresis: Sequence[dict[str, Any]] = (),
) -> Path:
    """Command, measured map and residual of a sweep, and the residuals against curvature.

    `without_hysteresis` is the same sweep by an influence function alone, for comparison.
    """
    positions = np.column_stack([mirror.actuator_x, mirror.actuator_y])
    curvatures = np.array([row["curvature"] for row in rows])
    shown = [rows[round(share * (len(rows) - 1))] for share in COLUMNS]
    figure = Figure(figsize=(13, 11), layout="constrained")
    figure.suptitle(title)
    grid = figure.add_gridspec(4, len(shown), height_ratios=(1, 1, 1, 0.9))
    measured_sag = [remove_plane(row["sag"].astype(float)) for row in shown]
    sag_limit = max(np.nanmax(np.abs(sag)) for sag in measured_sag) * 1e6
    residual_limit = max(np.nanpercentile(np.abs(row["error"].residual), 99.5) for row in shown) * 1e9
    for column, (row, sag) in enumerate(zip(shown, measured_sag, strict=True)):
        axes = [figure.add_subplot(grid[line, column]) for line in range(3)]
        info = row["info"]
        axes[0].set_title(f"{row['curvature']:+g} 1/m", fontsize=10)
        command = draw_command(axes[0], row["prediction"].signals, positions, info.aperture_radius)
        measured = draw_map(axes[1], sag * 1e6, info, sag_limit, "viridis")
        residual = draw_map(axes[2], row["error"].residual * 1e9, info, residual_limit, "PuOr")
        axes[2].set_title(f"{row['error'].rms * 1e9:.1f} nm rms", fontsize=9)
        axes[2].set_xlabel("x, mm")
        for item in axes:
            item.tick_params(labelsize=7)
        if column == 0:
            for item, label in zip(axes, ("command", "measured, tilt removed", "residual"), strict=True):
                item.set_ylabel(f"{label}\ny, mm")
        if column == len(shown) - 1:
            figure.colorbar(command, ax=axes[0], label="signal")
            figure.colorbar(measured, ax=axes[1], label="sag, µm")
            figure.colorbar(residual, ax=axes[2], label="residual sag, nm")
    summary = figure.add_subplot(grid[3, :])
    summary.semilogy(curvatures, [r["error"].rms * 1e9 for r in rows], "o-", label="measured, rms sag")
    summary.semilogy(
        curvatures, [r["error"].max_zernike * 1e9 for r in rows], "s-", label="measured, largest coefficient"
    )
    summary.semilogy(curvatures, [r["prediction"].predicted_rms * 1e9 for r in rows], "^--", label="predicted, rms sag")
    if without_hysteresis:
        summary.semilogy(
            [row["curvature"] for row in without_hysteresis],
            [row["error"].max_zernike * 1e9 for row in without_hysteresis],
            "x:",
            color="tab:red",
            label="largest coefficient, influence function alone",
        )
    for divisor in (50, 500):
        limit_nm = 1e9 * WAVELENGTH / divisor
        summary.axhline(limit_nm, color="grey", linewidth=0.8, linestyle=":")
        summary.annotate(f"λ/{divisor}", (curvatures[0], limit_nm), fontsize=8, va="bottom")
    summary.set(xlabel="requested curvature, 1/m (concave positive)", ylabel="nm")
    summary.legend(fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    summary.margins(y=0.12)
    summary.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    return path
