"""Heat maps of surfaces, Zernike bars, the residual of a run, and hysteresis loops."""

import base64
import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Colormap, to_hex
from matplotlib.image import imsave

from dm_calibration.report.document import BLUE, GREY, ORANGE, VERMILION
from dm_common import Floats
from dm_tools.console.loops import Loop
from dm_tools.console.surfaces import Surface
from dm_tools.console.view_models import Bar

INK, FAINT = "#1f2933", "#c3ccd5"
CROSS = "path://M-10,-2H-2V-10H2V-2H10V2H2V10H-2V2H-10Z"
#: Colour maps for sag and for differences about zero: safe for colour-blind readers, and readable in grey.
SAG_COLOURS, DIFFERENCE_COLOURS = "viridis", "PuOr"
#: Free space around the heat map, px; the colour bar is on the right. style.py uses the same for the height.
LEFT, RIGHT, TOP, BOTTOM = 44, 62, 26, 40
BAR_GAP, BAR_WIDTH = 10, 14
#: JavaScript that draws a picture between two opposite corners: the first two and the last two values of the datum.
DRAW = """(params, api) => {
  const [x, y] = api.coord([api.value(0), api.value(1)]), [right, bottom] = api.coord([api.value(2), api.value(3)]);
  return {type: 'image', style: {image: '%s', x, y, width: right - x, height: bottom - y}};
}"""


class Drawing(NamedTuple):
    """A chart.

    Attributes:
        options: of ECharts; keys that begin with a colon hold JavaScript.
        description: what a screen reader says.
    """

    options: dict[str, Any]
    description: str


def chart(description: str, **options: Any) -> Drawing:
    """A drawing whose marks show their names when the mouse is over them."""
    hover = {"trigger": "item", "formatter": "{b}", "confine": True}
    return Drawing({"animation": False, "tooltip": hover, **options}, description)


def axis(name: str, low: float | None = None, high: float | None = None, **more: Any) -> dict[str, Any]:
    """A scaled axis from `low` to `high` (None = as the data require) with a line, ticks and its name beside it."""
    return {
        "type": "value",
        "name": name,
        "nameLocation": "middle",
        "nameTextStyle": {"color": INK},
        "min": low,
        "max": high,
        "axisLine": {"show": True, "onZero": False, "lineStyle": {"color": INK}},
        "axisTick": {"show": True},
        "axisLabel": {"color": INK, "hideOverlap": True},
        "splitLine": {"lineStyle": {"color": FAINT}},
    } | more


def heat_map(surface: Surface, limit: float, colours: str, name: str) -> Drawing:
    """Draw `surface` on a symmetric scale -limit .. +limit (m).

    It is sent as one picture: ten thousand coloured cells would keep a browser busy whenever the mirror moves.

    Args:
        colours: name of a Matplotlib colour map.
        name: what is shown, for the description.
    """
    limit = limit if np.isfinite(limit) and limit > 0.0 else 1e-9
    factor, unit = (1e6, "µm") if limit >= 1e-6 else (1e9, "nm")
    reach, length = (surface.radius * 1e3, "mm") if surface.radius > 0 else (1.0, "aperture radii")
    high = limit * factor
    share = np.linspace(0.0, 1.0, 33)
    palette = colormaps[colours]
    stops = [{"offset": k, "color": to_hex(palette(1.0 - k))} for k in share.tolist()]
    shades = {"type": "linear", "x": 0, "y": 0, "x2": 0, "y2": 1, "colorStops": stops}
    # No labels at the ends of the axes, which are not round numbers.
    plain = {"splitLine": {"show": False}, "axisLabel": {"color": INK, "showMinLabel": False, "showMaxLabel": False}}
    frame = {"show": True, "borderColor": INK, "top": TOP, "bottom": BOTTOM}
    return chart(
        f"{name}: heat map over {length}, peak to valley {surface.peak_to_valley * factor:.3g} {unit}, "
        f"rms {surface.rms * 1e9:.3g} nm",
        grid=[
            frame | {"left": LEFT, "right": RIGHT},
            frame | {"right": RIGHT - BAR_GAP - BAR_WIDTH, "width": BAR_WIDTH, "backgroundColor": shades},
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
            {
                "type": "custom",
                "silent": True,
                "data": [[-reach, reach, reach, -reach]],
                ":renderItem": DRAW % _image(surface.sag / limit, palette),
            }
        ],
    )


def _image(values: Floats, palette: Colormap) -> str:
    """The values -1 .. +1 in colours, as the data URL of a PNG picture; NaN is transparent."""
    rgba = palette(np.clip(0.5 + 0.5 * np.nan_to_num(values), 0.0, 1.0), bytes=True)
    rgba[..., 3] = np.where(np.isfinite(values), 255, 0)
    buffer = io.BytesIO()
    imsave(buffer, rgba, format="png")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def zernike_chart(bars: Sequence[Bar], title: str) -> Drawing:
    """Coefficients as bars with their 95 % intervals; an open diamond marks the prediction."""
    values = [
        {"value": round(bar.value_nm, 4), "name": f"{bar.name}: {bar.value_nm:.2f} ± {bar.reach_nm:.2f} nm"}
        for bar in bars
    ]
    # A box plot whose box has no height: an interval with caps about the value.
    ends = [
        [round(value, 4) for value in (bar.value_nm - bar.reach_nm, *[bar.value_nm] * 3, bar.value_nm + bar.reach_nm)]
        for bar in bars
    ]
    predicted = ["-" if bar.predicted_nm is None else round(bar.predicted_nm, 4) for bar in bars]
    diamond = {"color": "#ffffff", "borderColor": VERMILION, "borderWidth": 2}
    largest = max(bars, key=lambda bar: abs(bar.value_nm))
    terms = axis("", type="category", data=[bar.name for bar in bars], splitLine={"show": False})
    terms["axisLabel"] = {"color": INK, "rotate": 90, "interval": 0, "fontSize": 10}
    return chart(
        f"{title} beyond tilt, largest {largest.name}: {largest.value_nm:.2f} nm",
        grid={"left": 60, "right": 12, "top": 12, "bottom": 150},
        xAxis=terms,
        yAxis=axis(f"{title}, nm", nameGap=42),
        series=[
            {"type": "bar", "data": values, "itemStyle": {"color": BLUE}, "barCategoryGap": "40%"},
            {"type": "boxplot", "data": ends, "itemStyle": {"borderColor": INK}, "boxWidth": [4, 8], "silent": True},
            {"type": "scatter", "symbol": "diamond", "symbolSize": 12, "data": predicted, "itemStyle": diamond},
        ],
    )


def residual_chart(residuals_nm: Sequence[float]) -> Drawing:
    """The residual of every map of a run so far."""
    points = [
        {"value": [number, round(value, 3)], "name": f"map {number}: {value:.1f} nm"}
        for number, value in enumerate(residuals_nm, start=1)
    ]
    return chart(
        f"residual of {len(residuals_nm)} maps, the last {residuals_nm[-1]:.1f} nm rms",
        grid={"left": 56, "right": 14, "top": 12, "bottom": 42},
        xAxis=axis("map", 0, max(len(residuals_nm), 10), nameGap=26),
        yAxis=axis("21-term residual, nm", 0, nameGap=38),
        series=[{"type": "scatter", "symbolSize": 6, "data": points, "itemStyle": {"color": BLUE}}],
    )


def loop_chart(loop: Loop) -> Drawing:
    """A hysteresis loop: modelled, measured, and the present state of the actuator."""

    def points(x: Sequence[float], y: Sequence[float]) -> list[list[float]]:
        return [[round(a, 5), round(b, 5)] for a, b in zip(x, y, strict=False)]

    def line(name: str, x: Sequence[float], y: Sequence[float], colour: str, kind: str = "solid") -> dict[str, Any]:
        style = {"color": colour, "type": kind, "width": 2}
        return {"type": "line", "name": name, "data": points(x, y), "lineStyle": style, "symbol": "none"}

    series: list[dict[str, Any]] = [
        line("rising", loop.signals, loop.rising, VERMILION),
        line("falling", loop.signals, loop.falling, BLUE, "dashed"),
    ]
    if loop.measured:
        edged = {"color": ORANGE, "borderColor": INK}
        series += [
            line("model of the measured way", loop.path, loop.modelled_path, GREY, "dotted"),
            {"type": "scatter", "name": "measured", "data": points(loop.path, loop.measured), "itemStyle": edged},
        ]
    if loop.position is not None:
        cross = {"type": "scatter", "name": "now", "symbol": CROSS, "symbolSize": 16, "itemStyle": {"color": INK}}
        series.append(cross | {"data": [list(loop.position)], "z": 5})
    return chart(
        f"hysteresis loop of actuator {loop.actuator}: {loop.text}",
        color=[VERMILION, BLUE, *([GREY, ORANGE] if loop.measured else []), INK],
        grid={"left": 60, "right": 16, "top": 56, "bottom": 44},
        legend={"top": 0, "textStyle": {"color": INK}, "selectedMode": False},
        tooltip={"formatter": "{a}: {c}", "confine": True},
        xAxis=axis("signal", loop.signals[0], loop.signals[-1], nameGap=28),
        yAxis=axis("effective signal", nameGap=40, scale=True),
        series=series,
    )
