"""The actuators as hexagons: signals in colour and figures, flags as signs, the chosen one outlined."""

import json
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from matplotlib.colors import to_hex
from scipy.spatial import HalfspaceIntersection

from dm_calibration.report.document import VERMILION
from dm_common import Floats
from dm_tools.console.charts.plots import INK, Drawing, chart
from dm_tools.console.view_models import SIGNAL_COLOURS, Cell, ink_on

#: Distance from the middle to a side of a lone actuator's cell, mm.
ALONE = 2.0
#: Free space below the map for the scale of the signals, px; style.py adds the same to the height.
SCALE = 44
#: Colours of that scale, low to high; the browser blends them.
SHADES = [to_hex(colour) for colour in SIGNAL_COLOURS(np.linspace(0.0, 1.0, 33))]
#: Points of the circle of the aperture.
CIRCLE = 91
#: JavaScript that draws an actuator's cell: its outline, and its number and signal as large as they fit.
DRAW = """(params, api) => {
  const cell = %s[params.dataIndex], [x, y] = api.coord(cell.place), size = api.size([cell.size, 0])[0];
  const label = (content, dy, share, weight) => ({type: 'text', z2: cell.z2, x, y: y + dy * size,
    style: {text: content, fill: cell.ink, fontSize: share * size, fontWeight: weight,
    align: 'center', verticalAlign: 'middle'}});
  return {type: 'group', children: [
    {type: 'polygon', z2: cell.z2, shape: {points: cell.corners.map((corner) => api.coord(corner))},
      style: {fill: cell.fill, stroke: cell.edge, lineWidth: cell.width, lineJoin: 'round'}},
    label(cell.label, -0.28, 0.53, 600), label(cell.signal, 0.3, 0.46, 400)]};
}"""


def command_map(cells: Sequence[Cell], chosen: int, aperture_radius_mm: float, low: float, high: float) -> Drawing:
    """Draw the actuators' cells at their positions, with the scale of signals `low` .. `high`.

    The third value of each datum is the actuator's number.
    """
    shapes = outlines(tuple((cell.x, cell.y) for cell in cells))
    reach = 1.01 * max([aperture_radius_mm, *(float(np.abs(corners).max()) for corners, _size in shapes)])
    drawn = [
        {
            "place": (round(cell.x, 3), round(cell.y, 3)),
            "corners": corners.round(3).tolist(),
            "size": size,
            "fill": cell.fill,
            "ink": ink_on(cell.fill),
            "edge": VERMILION if cell.number == chosen else "#ffffff",
            "width": 4 if cell.number == chosen else 1.5,
            "z2": int(cell.number == chosen),  # its outline must not be covered: a chart that changes keeps the order
            "label": f"{cell.number} {cell.mark}".strip(),
            "signal": "" if cell.signal is None else f"{cell.signal:+.2f}".replace("-", "−"),
        }
        for cell, (corners, size) in zip(cells, shapes, strict=True)
    ]
    angle = np.linspace(0.0, 2.0 * np.pi, CIRCLE)
    circle = aperture_radius_mm * np.column_stack([np.cos(angle), np.sin(angle)])
    flagged = [cell.text for cell in cells if cell.remarks]
    hidden = {"type": "value", "show": False, "min": -reach, "max": reach}
    return chart(
        f"command map of {len(cells)} actuators; " + ("; ".join(flagged) if flagged else "no flags"),
        grid={"left": 0, "right": 0, "top": 0, "bottom": SCALE},
        xAxis=hidden,
        yAxis=hidden,
        visualMap={
            "min": low,
            "max": high,
            "text": [f"{high:+g}", f"signal {low:+g}"],
            "textStyle": {"color": INK},
            "orient": "horizontal",
            "left": "center",
            "bottom": 4,
            "itemWidth": 14,
            "itemHeight": 150,
            "inRange": {"color": SHADES},
            "seriesIndex": [],
            "hoverLink": False,
        },
        series=[
            {
                "type": "custom",
                ":renderItem": DRAW % json.dumps(drawn),
                "data": [{"value": [cell.x, cell.y, cell.number], "name": cell.text} for cell in cells],
            },
            {
                "type": "line",
                "data": circle.round(3).tolist(),
                "lineStyle": {"color": VERMILION, "type": "dashed", "width": 1.5},
                "symbol": "none",
                "silent": True,
            },
        ],
    )


@lru_cache(maxsize=8)
def outlines(places: tuple[tuple[float, float], ...]) -> list[tuple[Floats, float]]:
    """For each actuator the corners (K, 2) of its cell in order, and the distance from its centre to the nearest side.

    Each cell is a regular hexagon with one side facing the nearest other actuator, half way towards it. It is clipped
    where another actuator is nearer. On a hexagonal grid the cells are whole hexagons; elsewhere they never overlap.
    All lengths are in the unit of `places`.
    """
    points = np.array(places, dtype=np.float64).reshape(-1, 2)
    cells = []
    for point in points:
        to_others = points - point
        distance = np.hypot(*to_others.T)
        to_others, distance = to_others[distance > 0.0], distance[distance > 0.0]
        size, turned = ALONE, 0.0
        if distance.size:
            nearest = to_others[np.argmin(distance)]
            size, turned = float(distance.min()) / 2.0, float(np.arctan2(nearest[1], nearest[0]))
        angle = turned + np.arange(6) * np.pi / 3
        sides = np.column_stack([np.cos(angle), np.sin(angle), np.full(6, -size)])
        bisectors = np.column_stack([to_others / distance[:, None], -0.5 * distance])
        corners = HalfspaceIntersection(np.vstack([sides, bisectors]), np.zeros(2)).intersections
        corners = np.unique(corners.round(9), axis=0)
        cells.append((corners[np.argsort(np.arctan2(corners[:, 1], corners[:, 0]))] + point, size))
    return cells
