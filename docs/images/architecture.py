"""Draw architecture.svg: the nodes and what they exchange, and below them the packages and who imports whom.

./dm exec python docs/images/architecture.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

COLOURS = {"node": "#d7e6f5", "hardware": "#e9e4dc", "user": "#f6ecd0", "package": "#eef2ee"}

#: Centre (x, y), width, text, kind.
BOXES = {
    "vision": (1.2, 6.6, 2.0, "vision program\ndm_client", "user"),
    "camera": (1.2, 5.0, 2.0, "camera", "hardware"),
    "autofocus": (4.6, 5.0, 2.2, "autofocus\ndm_autofocus", "node"),
    "controller": (7.8, 6.6, 2.2, "focus_controller\ndm_controller", "node"),
    "driver": (12.1, 6.6, 2.2, "pdm_driver\ndm_driver", "node"),
    "mirror": (15.8, 6.6, 2.2, "drive unit, mirror", "hardware"),
    "instrument": (15.8, 5.0, 2.2, "interferometer", "hardware"),
    "interferometer": (12.1, 5.0, 2.2, "interferometer\ndm_calibration", "node"),
    "calibration": (7.8, 5.0, 2.2, "calibration\ndm_calibration", "node"),
}
#: From, to, text beside the arrow, its distance from the middle of the arrow.
ARROWS = (
    ("vision", "controller", "focus_request, set_focus, move_focus", (0.0, 0.14)),
    ("camera", "autofocus", "image_raw", (0.0, 0.14)),
    ("autofocus", "controller", "focus_request", (-0.9, 0.1)),
    ("controller", "driver", "actuator_command", (0.0, 0.14)),
    ("driver", "mirror", "frames", (0.0, 0.14)),
    ("mirror", "instrument", "surface", (0.42, 0.0)),
    ("instrument", "interferometer", "map file", (0.0, 0.14)),
    ("interferometer", "calibration", "zernike", (0.0, 0.14)),
    ("calibration", "controller", "calibration", (0.62, 0.0)),
)
#: Packages as left and right edge, lowest and highest row, text: each may import what stands below it.
PACKAGES = (
    (0, 5, 0, 0, "dm_msgs: interfaces"),
    (0, 5, 1, 1, "dm_common: executor, parameters · optics · hysteresis model and inverse · limits, errors"),
    (0, 1, 2, 3, "dm_driver\ndrive units, protocols,\nsafety limiter"),
    (1, 2, 2, 3, "dm_simulation\nmirror, electronics,\ninterferometer, camera"),
    (2, 3, 2, 3, "dm_calibration\nmap files, fits, hysteresis\nidentification, store, report"),
    (3, 4, 2, 3, "dm_controller\ntarget, plan, creep hold,\nclosed loop"),
    (4, 5, 2, 2, "dm_client"),
    (4, 5, 3, 3, "dm_autofocus"),
    (0, 5, 4, 4, "dm_bringup: launch files, configurations, registry of nodes"),
    (0, 5, 5, 5, "dm_tools: command dm, console, recordings, security policies"),
    (0, 5, 6, 6, "not installed: studies/ (comparison, benchmarks, generated pages), tests/ (fault injection)"),
)
#: Width of a column and height of a row of packages.
COLUMN, ROW = 3.34, 0.68


def box(axes: Axes, x: float, y: float, width: float, height: float, text: str, colour: str) -> None:
    shape = FancyBboxPatch((x - width / 2, y - height / 2), width, height, boxstyle="round,pad=0.02,rounding_size=0.08")
    shape.set(facecolor=colour, edgecolor="#44505c", linewidth=0.9)
    axes.add_patch(shape)
    axes.text(x, y, text, ha="center", va="center", fontsize=9)


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": "#44505c", "linewidth": 1.1})


def edge(name: str, towards: str) -> tuple[float, float]:
    """Where an arrow from one box to another touches the first."""
    x, y, width = BOXES[name][:3]
    other_x, other_y = BOXES[towards][:2]
    if other_y == y:
        return x + (width / 2 + 0.04) * (1 if other_x > x else -1), y
    return x + (0.5 if other_x > x + 1 else -0.5 if other_x < x - 1 else 0.0), y + 0.37 * (1 if other_y > y else -1)


def draw(file: Path) -> None:
    matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "dm", "font.family": "sans-serif"})
    figure, axes = plt.subplots(figsize=(13.2, 7.6))
    axes.set(xlim=(0, 17.1), ylim=(-1.3, 7.5))
    axes.axis("off")
    axes.text(0.2, 7.3, "Nodes and what they exchange", fontsize=11, weight="bold")
    for x, y, width, text, kind in BOXES.values():
        box(axes, x, y, width, 0.7, text, COLOURS[kind])
    for start, end, text, (right, up) in ARROWS:
        a, b = edge(start, end), edge(end, start)
        arrow(axes, a, b)
        axes.text((a[0] + b[0]) / 2 + right, (a[1] + b[1]) / 2 + up, text, ha="center", va="center", fontsize=8)
    arrow(axes, (10.95, 6.4), (8.95, 6.4))
    axes.text(9.95, 6.26, "actuator_state", ha="center", va="center", fontsize=8)
    arrow(axes, (11.4, 6.2), (8.95, 5.25))
    note = "virtual_bench (dm_simulation) takes the place of all grey boxes: the same bytes, the same files."
    axes.text(0.2, 4.3, note, fontsize=9)
    axes.text(0.2, 3.65, "Packages: each imports only what stands below it", fontsize=11, weight="bold")
    for left, right, low, high, text in PACKAGES:
        x, y = 0.2 + COLUMN * (left + right) / 2, -0.9 + ROW * (low + high) / 2
        box(axes, x, y, COLUMN * (right - left) - 0.14, ROW * (high - low) + 0.5, text, COLOURS["package"])
    figure.savefig(file, bbox_inches="tight", metadata={"Date": None} if file.suffix == ".svg" else None)
    plt.close(figure)


if __name__ == "__main__":
    draw(Path(__file__).with_suffix(".svg"))
