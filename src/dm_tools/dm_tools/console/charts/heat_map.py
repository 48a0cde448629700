"""A surface as a heat map with axes in mm and a colour bar."""

import base64
import io
import json
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from matplotlib.image import imsave
from numpy.typing import NDArray

from dm_tools.console.charts.plots import INK, Drawing, axis, chart
from dm_tools.console.surfaces import Surface

#: Safe for colour-blind readers, and readable in grey: for sag, and for differences about zero.
SAG_COLOURS, DIFFERENCE_COLOURS = "viridis", "PuOr"
#: Free space about the map, px: the bar stands on the right. As style.py has it for the height.
LEFT, RIGHT, TOP, BOTTOM = 44, 62, 26, 40
BAR_GAP, BAR_WIDTH = 10, 14
#: Draws a picture from the corner (first two values of the datum) to the corner opposite (the other two).
DRAW = """(params, api) => {
  const [x, y] = api.coord([api.value(0), api.value(1)]), [right, bottom] = api.coord([api.value(2), api.value(3)]);
  return {type: 'image', style: {image: '%s', x, y, width: right - x, height: bottom - y}};
}"""
#: The same with a gradient from top to bottom.
DRAW_BAR = """(params, api) => {
  const [x, y] = api.coord([api.value(0), api.value(1)]), [right, bottom] = api.coord([api.value(2), api.value(3)]);
  const fill = {type: 'linear', x: 0, y: 0, x2: 0, y2: 1, colorStops: %s};
  return {type: 'rect', shape: {x, y, width: right - x, height: bottom - y}, style: {fill}};
}"""


def heat_map(surface: Surface, limit: float, colours: str, name: str) -> Drawing:
    """`surface` on a symmetric scale -limit .. +limit (m).

    A picture, because ten thousand coloured fields would keep a browser busy whenever the mirror moves.

    Args:
        colours: name of a Matplotlib colour map.
        name: what is shown, for the description.
    """
    limit = limit if np.isfinite(limit) and limit > 0.0 else 1e-9
    factor, unit = (1e6, "µm") if limit >= 1e-6 else (1e9, "nm")
    reach, length = (surface.radius * 1e3, "mm") if surface.radius > 0 else (1.0, "aperture radii")
    high = limit * factor
    share = np.linspace(0.0, 1.0, 33)
    stops = [{"offset": k, "color": to_hex(colormaps[colours](1.0 - k))} for k in share.tolist()]
    # No numbers at the ends, which are not round.
    plain = {"splitLine": {"show": False}, "axisLabel": {"color": INK, "showMinLabel": False, "showMaxLabel": False}}
    frame = {"show": True, "borderColor": INK, "top": TOP, "bottom": BOTTOM}
    return chart(
        f"{name}: heat map over {length}, peak to valley {surface.peak_to_valley * factor:.3g} {unit}, "
        f"rms {surface.rms * 1e9:.3g} nm",
        grid=[
            frame | {"left": LEFT, "right": RIGHT},
            frame | {"right": RIGHT - BAR_GAP - BAR_WIDTH, "width": BAR_WIDTH},
        ],
        xAxis=[
            axis(f"x, {length}", -reach, reach, nameGap=26, **plain),
            {"type": "value", "show": False, "min": 0, "max": 1, "gridIndex": 1},
        ],
        yAxis=[
            axis(f"y, {length}", -reach, reach, nameGap=28, **plain),
            axis(f"sag, {unit}", -high, high, position="right", nameLocation="end", nameGap=10, gridIndex=1, **plain),
        ],
        series=[
            _drawn(DRAW % _image(surface.sag / limit, colours), [-reach, reach, reach, -reach]),
            _drawn(DRAW_BAR % json.dumps(stops), [0, high, 1, -high]) | {"xAxisIndex": 1, "yAxisIndex": 1},
        ],
    )


def _drawn(code: str, corners: list[float]) -> dict[str, Any]:
    """What `code` draws between `corners`: left, top, right, bottom."""
    return {"type": "custom", "silent": True, "data": [corners], ":renderItem": code}


def _image(values: NDArray[np.float64], colours: str) -> str:
    """The values -1 .. +1 in colours, as the address of a picture; NaN is transparent."""
    rgba = colormaps[colours](np.clip(0.5 + 0.5 * np.nan_to_num(values), 0.0, 1.0), bytes=True)
    rgba[..., 3] = np.where(np.isfinite(values), 255, 0)
    buffer = io.BytesIO()
    imsave(buffer, rgba, format="png")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
