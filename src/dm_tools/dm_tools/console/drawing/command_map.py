"""The actuators as hexagons: signals in colour and figures, flags as signs, the chosen one outlined."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from dm_calibration.report.colours import VERMILION
from dm_tools.console.drawing.hexagons import Floats, outlines, sizes
from dm_tools.console.drawing.svg import INK, picture
from dm_tools.console.view_models import Cell

#: Width and height of the picture, user units, and what is left free around it.
WIDTH, MARGIN = 440.0, 6.0


def command_map(cells: Sequence[Cell], chosen: int, aperture_radius_mm: float) -> str:
    """SVG of the cells where the actuators stand; every cell carries its number as `data-actuator`."""
    places = tuple((cell.x, cell.y) for cell in cells)
    shapes = outlines(places)
    reach = max(aperture_radius_mm, max(float(np.abs(shape).max()) for shape in shapes))
    scale = (WIDTH / 2 - MARGIN) / reach

    def drawn(shape: Floats) -> Floats:
        return WIDTH / 2 + scale * shape * (1.0, -1.0)

    in_order = sorted(range(len(cells)), key=lambda k: cells[k].number == chosen)  # its outline must not be covered
    parts = [_hexagon(cells[k], drawn(shapes[k]), cells[k].number == chosen) for k in in_order]
    parts.append(
        f'<circle cx="{WIDTH / 2}" cy="{WIDTH / 2}" r="{aperture_radius_mm * scale:.1f}" fill="none" '
        f'stroke="{VERMILION}" stroke-width="1.5" stroke-dasharray="6 4" pointer-events="none"/>'
    )
    for cell, place, size in zip(cells, places, sizes(shapes, places), strict=True):
        parts.append(_words(cell, drawn(np.array(place)), scale * size))
    flagged = [cell.words for cell in cells if cell.remarks]
    description = f"command map of {len(cells)} actuators; " + ("; ".join(flagged) if flagged else "no flags")
    return picture(WIDTH, WIDTH, parts, description)


def _hexagon(cell: Cell, corners: Floats, chosen: bool) -> str:
    outline = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
    stroke, width = (VERMILION, 4) if chosen else ("#ffffff", 1.5)
    return (
        f'<polygon data-actuator="{cell.number}" style="cursor:pointer" points="{outline}" fill="{cell.fill}" '
        f'stroke="{stroke}" stroke-width="{width}"><title>{escape(cell.words)}</title></polygon>'
    )


def _words(cell: Cell, place: Floats, size: float) -> str:
    """Number, sign and signal; `size` is the distance to the nearest side."""
    x, y = place
    value = "" if cell.signal is None else f"{cell.signal:+.2f}".replace("-", "−")
    mark = f" {cell.mark}" if cell.mark else ""
    return (
        f'<g text-anchor="middle" fill="{cell.ink}" pointer-events="none">'
        f'<text x="{x:.1f}" y="{y - 0.11 * size:.1f}" font-size="{0.53 * size:.1f}" font-weight="600">'
        f"{cell.number}{mark}</text>"
        f'<text x="{x:.1f}" y="{y + 0.48 * size:.1f}" font-size="{0.46 * size:.1f}">{value}</text></g>'
    )


def signal_scale(low: float, high: float, colours: Sequence[str]) -> str:
    """SVG of the colour scale of the signals, with its limits."""
    step = 400.0 / len(colours)
    parts = [
        f'<rect x="{40 + k * step:.1f}" y="2" width="{step + 0.5:.1f}" height="14" fill="{colour}"/>'
        for k, colour in enumerate(colours)
    ]
    for x, words in ((40, f"{low:+.1f}"), (240, f"{(low + high) / 2:.1f} signal"), (440, f"{high:+.1f}")):
        parts.append(f'<text x="{x}" y="32" text-anchor="middle" font-size="14" fill="{INK}">{words}</text>')
    return picture(480.0, 38.0, parts, f"colour scale of the signals, {low:+.1f} to {high:+.1f}")
