"""The actuators as hexagons: signals in colour and figures, flags as signs, the chosen one outlined."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

from dm_calibration.report.colours import VERMILION
from dm_controller.console.drawing.svg import INK, picture
from dm_controller.console.view_models import Cell

#: User units per mm.
SCALE = 14.0


def command_map(cells: Sequence[Cell], chosen: int, aperture_radius_mm: float) -> str:
    """SVG of the cells; every hexagon carries its number as `data-actuator`."""
    side = _side(cells)
    reach = (max(max(abs(cell.x), abs(cell.y)) for cell in cells) + side) * SCALE + 6.0
    corners = [(side * math.sin(k * math.pi / 3), side * math.cos(k * math.pi / 3)) for k in range(6)]
    in_order = sorted(cells, key=lambda cell: cell.number == chosen)  # its outline must not be covered
    parts = [_hexagon(cell, corners, reach, cell.number == chosen) for cell in in_order]
    parts.append(
        f'<circle cx="{reach:.1f}" cy="{reach:.1f}" r="{aperture_radius_mm * SCALE:.1f}" fill="none" '
        f'stroke="{VERMILION}" stroke-width="1.5" stroke-dasharray="6 4" pointer-events="none"/>'
    )
    parts += [_words(cell, reach, side * SCALE) for cell in cells]
    flagged = [cell.words for cell in cells if cell.remarks]
    description = f"command map of {len(cells)} actuators; " + ("; ".join(flagged) if flagged else "no flags")
    return picture(2 * reach, 2 * reach, parts, description)


def _side(cells: Sequence[Cell]) -> float:
    """Side of the hexagons, mm, that fills the plane at the smallest distance of two actuators."""
    if len(cells) < 2:
        return 2.0
    gaps = (math.hypot(a.x - b.x, a.y - b.y) for k, a in enumerate(cells) for b in cells[:k])
    return min(gaps) / math.sqrt(3.0)


def _hexagon(cell: Cell, corners: Sequence[tuple[float, float]], reach: float, chosen: bool) -> str:
    x, y = reach + cell.x * SCALE, reach - cell.y * SCALE
    outline = " ".join(f"{x + dx * SCALE:.1f},{y + dy * SCALE:.1f}" for dx, dy in corners)
    stroke, width = (VERMILION, 4) if chosen else ("#ffffff", 1.5)
    return (
        f'<polygon data-actuator="{cell.number}" style="cursor:pointer" points="{outline}" fill="{cell.fill}" '
        f'stroke="{stroke}" stroke-width="{width}"><title>{escape(cell.words)}</title></polygon>'
    )


def _words(cell: Cell, reach: float, size: float) -> str:
    x, y = reach + cell.x * SCALE, reach - cell.y * SCALE
    value = "" if cell.signal is None else f"{cell.signal:+.2f}".replace("-", "−")
    mark = f" {cell.mark}" if cell.mark else ""
    return (
        f'<g text-anchor="middle" fill="{cell.ink}" pointer-events="none">'
        f'<text x="{x:.1f}" y="{y - 0.1 * size:.1f}" font-size="{0.46 * size:.1f}" font-weight="600">'
        f"{cell.number}{mark}</text>"
        f'<text x="{x:.1f}" y="{y + 0.42 * size:.1f}" font-size="{0.4 * size:.1f}">{value}</text></g>'
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
