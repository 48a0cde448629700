"""A surface as a heat map with axes in mm and a colour bar."""

from __future__ import annotations

import base64
import io

import numpy as np
from matplotlib import colormaps
from matplotlib.image import imsave
from numpy.typing import NDArray

from dm_tools.console.drawing.svg import FONT, INK, Frame, line, nice_ticks, text, tick_text
from dm_tools.console.surfaces import Surface

#: Safe for colour-blind readers, and readable in grey: for sag, and for differences about zero.
SAG_COLOURS, DIFFERENCE_COLOURS = "viridis", "PuOr"
WIDTH, HEIGHT = 326.0, 278.0
PLOT_RIGHT, BAR_LEFT, BAR_WIDTH = 254.0, 264.0, 14.0


def unit_for(extent: float) -> tuple[float, str]:
    """(factor, unit) in which lengths up to `extent` m read well."""
    return (1e6, "µm") if extent >= 1e-6 else (1e9, "nm")


def heat_map(surface: Surface, limit: float, colours: str, name: str) -> str:
    """SVG of `surface` on a symmetric scale -limit .. +limit (m).

    Args:
        colours: name of a Matplotlib colour map.
        name: what is shown, for the description.
    """
    limit = limit if np.isfinite(limit) and limit > 0.0 else 1e-9
    factor, unit = unit_for(limit)
    reach = surface.radius * 1e3 if surface.radius > 0 else 1.0
    axis = "mm" if surface.radius > 0 else "aperture radii"
    frame = Frame(
        WIDTH, HEIGHT, (-reach, reach), (-reach, reach), left=50.0, right=WIDTH - PLOT_RIGHT, bottom=42.0, top=32.0
    )
    left, top = frame.x(-reach), frame.y(reach)
    frame.add(
        f'<image x="{left:.1f}" y="{top:.1f}" width="{frame.x(reach) - left:.1f}" '
        f'height="{frame.y(-reach) - top:.1f}" preserveAspectRatio="none" href="{_png(surface.sag / limit, colours)}"/>'
    )
    frame.axes(f"x, {axis}", f"y, {axis}", grid=False)
    bar_top, bar_bottom = frame.y(reach), frame.y(-reach)
    gradient = np.repeat(np.linspace(1.0, -1.0, 128)[:, None], 2, axis=1)
    frame.add(
        f'<image x="{BAR_LEFT}" y="{bar_top:.1f}" width="{BAR_WIDTH}" height="{bar_bottom - bar_top:.1f}" '
        f'preserveAspectRatio="none" href="{_png(gradient, colours)}"/>',
        f'<rect x="{BAR_LEFT}" y="{bar_top:.1f}" width="{BAR_WIDTH}" height="{bar_bottom - bar_top:.1f}" '
        f'fill="none" stroke="{INK}"/>',
        text(BAR_LEFT + BAR_WIDTH / 2, bar_top - 10, f"sag, {unit}"),
    )
    for value in nice_ticks(-limit * factor, limit * factor):
        place = bar_bottom - (value / (limit * factor) + 1) / 2 * (bar_bottom - bar_top)
        right = BAR_LEFT + BAR_WIDTH
        frame.add(line(right, place, right + 4, place), text(right + 7, place + 4, tick_text(value), "start", FONT))
    return frame.picture(
        f"{name}: heat map over {axis}, peak to valley {surface.peak_to_valley * factor:.3g} {unit}, "
        f"rms {surface.rms * 1e9:.3g} nm"
    )


def _png(values: NDArray[np.float64], colours: str) -> str:
    """A data URI of the values -1 .. +1 in colours; NaN is transparent."""
    rgba = colormaps[colours](np.clip(0.5 + 0.5 * np.nan_to_num(values), 0.0, 1.0), bytes=True)
    rgba[..., 3] = np.where(np.isfinite(values), 255, 0)
    buffer = io.BytesIO()
    imsave(buffer, rgba, format="png")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
