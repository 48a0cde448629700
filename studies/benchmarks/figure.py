"""The log-log plot of growth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

_ACTUATORS = {
    "solve_inside_ms": "solve inside the limits",
    "solve_saturated_ms": "saturated solve",
    "fit_ms": "influence function",
}
_PIXELS = {"map_fit_ms": "fit", "new_mask_fit_ms": "fit, new mask"}


def save_scaling(figures: dict[str, Any], path: Path) -> Path:
    """Draw `scaling` of a run: time against actuators and pixels, and memory."""
    entries, slopes = figures["scaling"], figures["slopes"]
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for key, size, axes, names in (("actuators", 1, left, _ACTUATORS), ("pixels", 2, middle, _PIXELS)):
        for name, label in names.items():
            _draw(axes, entries, key, size, name, f"{label}, slope {slopes[f'{key}_{name}']:.2f}")
        axes.set(xlabel=f"{key} of the mirror" if size == 1 else "pixels of the map", ylabel="time, ms")
        _draw(right, entries, key, size, "memory_mb", f"{key}, slope {slopes[f'{key}_memory_mb']:.2f}")
    right.set(xlabel="actuators or pixels", ylabel="memory, MB")
    for axes in (left, middle, right):
        axes.set(xscale="log", yscale="log")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _draw(axes: Axes, entries: list[dict[str, Any]], key: str, power: int, name: str, label: str) -> None:
    points = [(entry[key] ** power, entry[name]) for entry in entries if key in entry and name in entry]
    axes.plot(*zip(*points, strict=True), "o-", label=label)
