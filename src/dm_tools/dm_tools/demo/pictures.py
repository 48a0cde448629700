"""Pictures of searches: a contact sheet and an animation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

#: Okabe-Ito, one per object.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: Images on which the animation rests at the end of each search.
HOLD = 12


def _draw_image(axes: Axes, image: Any, region: Sequence[float], colour: str) -> Any:
    """An image with its region of interest; returns (picture, frame)."""
    height, width = image.shape
    picture = axes.imshow(image, cmap="gray", vmin=0, vmax=220, interpolation="nearest")
    left, top, wide, high = region
    frame = Rectangle(
        (left * width, top * height), wide * width, high * height, fill=False, edgecolor=colour, linewidth=1.5
    )
    axes.add_patch(frame)
    axes.set(xticks=[], yticks=[])
    return picture, frame


def _sharpness_axes(axes: Axes, found: Sequence[Any]) -> None:
    shots = [shot for item in found for shot in item.shots]
    low, high = min(s.curvature for s in shots), max(s.curvature for s in shots)
    margin = 0.03 * (high - low)
    axes.set(xlim=(low - margin, high + margin), ylim=(0, 1.1 * max(s.sharpness for s in shots)))
    axes.set(xlabel="curvature of the mirror [1/m]", ylabel="sharpness")
    axes.locator_params(axis="x", nbins=5)
    axes.grid(alpha=0.3)


def save_contact_sheet(found: Sequence[Any], path: Path, title: str) -> Path:
    """The image at the end of each search, and the sharpness of all that led there.

    Args:
        found: objects with `distance`, `region`, `result`, `shots` and `final`, as `dm demo --camera` makes them.
        path: PNG file to write.
        title: of the sheet.
    """
    figure = plt.figure(figsize=(4.2 * len(found), 7.2), layout="constrained")
    figure.suptitle(title)
    grid = figure.add_gridspec(2, len(found))
    for number, (item, colour) in enumerate(zip(found, COLOURS, strict=False)):
        axes = figure.add_subplot(grid[0, number])
        _draw_image(axes, item.final.image, item.region, colour)
        axes.set_title(f"object at {item.distance:g} m: found {item.result.distance:.2f} m", color=colour)
    axes = figure.add_subplot(grid[1, :])
    _sharpness_axes(axes, found)
    for item, colour in zip(found, COLOURS, strict=False):
        curvatures = [shot.curvature for shot in item.shots]
        axes.plot(curvatures, [shot.sharpness for shot in item.shots], "o", color=colour, label=f"{item.distance:g} m")
        axes.axvline(item.result.curvature, color=colour, linewidth=0.8)
    axes.legend(title="object")
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def save_animation(found: Sequence[Any], path: Path, title: str, frames_per_second: int = 12) -> Path:
    """Every counted image of every search, one after the other, with the sharpness beside it, as a GIF.

    Args:
        found: as for `save_contact_sheet`.
        path: GIF file to write.
        title: of the animation.
        frames_per_second: of the animation.
    """
    figure: Figure = plt.figure(figsize=(8.4, 3.6), layout="constrained")
    figure.suptitle(title, fontsize=9)
    left, right = figure.subplots(1, 2)
    picture, frame = _draw_image(left, found[0].shots[0].image, found[0].region, COLOURS[0])
    _sharpness_axes(right, found)
    clouds = [right.plot([], [], "o", color=colour, markersize=3)[0] for colour in COLOURS[: len(found)]]
    cursor = right.axvline(0.0, color="black", linewidth=0.8)
    schedule = [(number, shown) for number, item in enumerate(found) for shown in range(len(item.shots) + HOLD)]

    def draw(at: tuple[int, int]) -> list[Any]:
        number, shown = at
        item, colour = found[number], COLOURS[number % len(COLOURS)]
        done = shown >= len(item.shots)
        shot = item.final if done else item.shots[shown]
        picture.set_data(shot.image)
        height, width = shot.image.shape
        frame.set(xy=(item.region[0] * width, item.region[1] * height), edgecolor=colour)
        past = item.shots[: shown + 1]
        clouds[number].set_data([s.curvature for s in past], [s.sharpness for s in past])
        cursor.set_xdata([shot.curvature, shot.curvature])
        text = f"found {item.result.distance:.2f} m" if done else f"searching, image {shown + 1}"
        left.set_title(f"object at {item.distance:g} m: {text}", color=colour, fontsize=9)
        return []

    draw(schedule[0])
    figure.canvas.draw()
    figure.set_layout_engine("none")  # else every frame is laid out anew
    animation = FuncAnimation(figure, draw, frames=schedule, init_func=list)
    animation.save(path, writer=PillowWriter(fps=frames_per_second), dpi=80)
    plt.close(figure)
    return path
