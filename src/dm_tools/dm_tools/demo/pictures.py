"""Pictures of the camera's demonstration: a contact sheet and an animation."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from dm_autofocus.sharpness import check_region, cut
from dm_tools.demo.camera_runs import Approach, Focused, Shot, Sweep

#: Okabe-Ito, one per object.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: Number of frames for which the animation rests at the end of each search.
HOLD = 14
#: Numbers of colours and of greys in the palette that all frames share.
PALETTE, GREYS = 32, 48


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


def _sharpness_axes(axes: Axes, found: Sequence[Focused]) -> None:
    shots = [shot for item in found for shot in item.shots]
    low, high = min(s.curvature for s in shots), max(s.curvature for s in shots)
    margin = 0.03 * (high - low)
    axes.set(xlim=(low - margin, high + margin), ylim=(0, 1.1 * max(s.sharpness for s in shots)))
    axes.set(xlabel="curvature of the mirror [1/m]", ylabel="sharpness")
    axes.locator_params(axis="x", nbins=5)
    axes.grid(alpha=0.3)


def save_contact_sheet(found: Sequence[Focused], path: Path, title: str) -> Path:
    """The image at the end of each search, and the sharpness of all that led there, as a PNG file."""
    figure = Figure(figsize=(4.2 * len(found), 7.2), layout="constrained")
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
    return path


def save_animation(
    found: Sequence[Focused], sweep: Sweep, approach: Approach, path: Path, title: str, frames_per_second: int = 7
) -> Path:
    """What the camera does, as a GIF: searches, a sweep in which the picture stands still, its depth, and tracking."""
    figure = Figure(figsize=(8.4, 3.8), dpi=80, layout="constrained")
    figure.suptitle(title, fontsize=8, color="gray")
    left, right = figure.subplots(1, 2)
    picture, frame = _draw_image(left, found[0].shots[0].image, found[0].region, COLOURS[0])
    _sharpness_axes(right, found)
    clouds = [right.plot([], [], "o", color=colour, markersize=3)[0] for colour in COLOURS[: len(found)]]
    cursor = right.axvline(0.0, color="black", linewidth=0.8)
    # A cross on the middle of the picture shows that it stands still.
    height, width = sweep.sharp.shape
    hidden: dict[str, Any] = {"color": "#F0E442", "linewidth": 0.8, "visible": False}
    cross = left.axhline(height / 2, **hidden), left.axvline(width / 2, **hidden)
    depth = right.inset_axes((0, 0, 1, 1))
    depth.set(visible=False, xticks=[], yticks=[])
    depth.imshow(sweep.depth, cmap="viridis_r", norm=LogNorm(4, 150), interpolation="nearest", aspect="auto")
    for item in found:
        middle = np.nanmedian(cut(sweep.depth, check_region(item.region)))
        across, along = item.region[0] + item.region[2] / 2, item.region[1] + item.region[3] / 2
        box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none"}
        depth.text(across * width, along * height, f"{middle:.1f} m", ha="center", bbox=box)

    def show(shot: Shot, text: str, colour: str, region: Sequence[float] | None = None) -> None:
        height, width = shot.image.shape
        picture.set_data(shot.image)
        frame.set_visible(region is not None)
        if region is not None:
            frame.set(xy=(region[0] * width, region[1] * height), edgecolor=colour)
        cursor.set_xdata([shot.curvature, shot.curvature])
        left.set_title(text, color=colour, fontsize=9)

    canvas = FigureCanvasAgg(figure)
    images: list[Image.Image] = []
    stays: list[int] = []  # for how many frames each image stays

    def take(frames: int = 1) -> None:
        canvas.draw()
        figure.set_layout_engine("none")  # else every frame is laid out anew
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
        stays.append(frames)

    for item, colour, cloud in zip(found, COLOURS, clouds, strict=False):
        few = f"1  Few images. {item.distance:g} m:"
        for number, shot in enumerate(item.shots, start=1):
            past = item.shots[:number]
            cloud.set_data([s.curvature for s in past], [s.sharpness for s in past])
            show(shot, f"{few} image {number}", colour, item.region)
            take()
        show(item.final, f"{few} found {item.result.distance:.2f} m, {len(item.shots)} images", colour, item.region)
        take(HOLD)
    for line in cross:
        line.set_visible(True)
    for shot in sweep.shots:
        show(shot, "2  The picture stands still while the focus sweeps", "black")
        take()
    for line in cross:
        line.set_visible(False)
    picture.set_data(sweep.sharp)
    depth.set(visible=True)
    right.set_axis_off()
    text = f"3  All sharp, and how far away: {len(sweep.shots)} images, {sweep.seconds:.1f} s"
    left.set_title(text, color="black", fontsize=9)
    take(2 * HOLD)
    depth.set(visible=False)
    right.set_axis_on()
    for shot, distance in zip(approach.shots, approach.distances, strict=True):
        show(shot, f"4  Tracking: the object comes nearer, {distance:.1f} m", COLOURS[0], found[0].region)
        take()
    if approach.shots:
        take(HOLD)
    # One palette for all frames: the colours of those on which the animation rests, and greys for the pictures.
    held_images = [image for image, frames in zip(images, stays, strict=True) if frames > 1]
    sheet = Image.fromarray(np.concatenate([np.asarray(image) for image in held_images]))
    palette = sheet.quantize(PALETTE, Image.Quantize.MAXCOVERAGE)
    greys = np.repeat(np.linspace(0, 255, GREYS).astype(int), 3)
    palette.putpalette([*(palette.getpalette() or ())[: 3 * PALETTE], *greys.tolist()])
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    durations = [1000 * frames // frames_per_second for frames in stays]
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0, optimize=True)
    return path
