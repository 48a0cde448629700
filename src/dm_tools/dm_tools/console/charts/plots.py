"""Zernike bars, the residual of a run, and hysteresis loops."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from dm_calibration.report.document import BLUE, GREY, ORANGE, VERMILION
from dm_tools.console.loops import Loop
from dm_tools.console.view_models import Bar

INK, FAINT = "#1f2933", "#c3ccd5"
CROSS = "path://M-10,-2H-2V-10H2V-2H10V2H2V10H-2V2H-10Z"


class Drawing(NamedTuple):
    """A chart.

    Attributes:
        options: of ECharts; keys that begin with a colon hold JavaScript.
        description: what a screen reader says.
    """

    options: dict[str, Any]
    description: str


def chart(description: str, **options: Any) -> Drawing:
    """A drawing whose marks give their names when the mouse is over them."""
    hover = {"trigger": "item", "formatter": "{b}", "confine": True}
    return Drawing({"animation": False, "tooltip": hover, **options}, description)


def axis(name: str, low: float | None = None, high: float | None = None, **more: Any) -> dict[str, Any]:
    """A scaled axis from `low` to `high` (None = as the data need) with a line, ticks and its name beside it."""
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
    """A hysteresis loop: modelled, measured, and where the actuator stands."""

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
    if loop.stands is not None:
        cross = {"type": "scatter", "name": "now", "symbol": CROSS, "symbolSize": 16, "itemStyle": {"color": INK}}
        series.append(cross | {"data": [list(loop.stands)], "z": 5})
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
