"""Zernike bars, the residual of a run, and hysteresis loops."""

from __future__ import annotations

from collections.abc import Sequence

from dm_calibration.report.colours import BLUE, GREY, ORANGE, VERMILION
from dm_tools.console.drawing.svg import FAINT, FONT, INK, Frame, line, text
from dm_tools.console.loops import Loop
from dm_tools.console.view_models import Bar


def zernike_chart(bars: Sequence[Bar], title: str) -> str:
    """SVG of coefficients as bars with their 95 % intervals; an open diamond marks the prediction."""
    reach = max([abs(bar.value_nm) + bar.reach_nm for bar in bars] + [abs(b.predicted_nm or 0.0) for b in bars] + [0.1])
    frame = Frame(480.0, 340.0, (0.0, float(len(bars))), (-1.1 * reach, 1.1 * reach), bottom=70.0)
    frame.axes("", f"{title}, nm", x_ticks=())
    frame.add(line(frame.left, frame.y(0.0), frame.width - frame.right, frame.y(0.0)))
    for place, bar in enumerate(bars):
        left, right, middle = frame.x(place + 0.2), frame.x(place + 0.8), frame.x(place + 0.5)
        top, bottom = sorted((frame.y(bar.value_nm), frame.y(0.0)))
        frame.add(
            f'<rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{max(bottom - top, 0.5):.1f}" '
            f'fill="{BLUE}"><title>{bar.name}: {bar.value_nm:.2f} ± {bar.reach_nm:.2f} nm</title></rect>'
        )
        low, high = frame.y(bar.value_nm - bar.reach_nm), frame.y(bar.value_nm + bar.reach_nm)
        frame.add(line(middle, low, middle, high, INK, 1.5))
        for end in (low, high):
            frame.add(line(middle - 4, end, middle + 4, end, INK, 1.5))
        if bar.predicted_nm is not None:
            at = frame.y(bar.predicted_nm)
            frame.add(
                f'<path d="M{middle:.1f} {at - 6:.1f}l6 6l-6 6l-6 -6z" fill="white" stroke="{VERMILION}" '
                f'stroke-width="2"/>'
            )
        foot = frame.height - frame.bottom + 8
        frame.add(text(middle + 4, foot, bar.name, "end", 11, f'transform="rotate(-60 {middle + 4:.1f} {foot:.1f})"'))
    largest = max(bars, key=lambda bar: abs(bar.value_nm))
    return frame.picture(f"{title} beyond tilt, largest {largest.name}: {largest.value_nm:.2f} nm")


def residual_chart(residuals_nm: Sequence[float]) -> str:
    """SVG of the residual of every map of a run so far."""
    high = 1.15 * max([*residuals_nm, 1.0])
    frame = Frame(420.0, 170.0, (0.5, max(len(residuals_nm), 10) + 0.5), (0.0, high))
    frame.axes("map", "21-term residual, nm")
    for number, value in enumerate(residuals_nm, start=1):
        frame.add(f'<circle cx="{frame.x(number):.1f}" cy="{frame.y(value):.1f}" r="3" fill="{BLUE}"/>')
    return frame.picture(f"residual of {len(residuals_nm)} maps, the last {residuals_nm[-1]:.1f} nm rms")


def loop_chart(loop: Loop) -> str:
    """SVG of a hysteresis loop: modelled, measured, and where the actuator stands."""
    values = [*loop.rising, *loop.falling, *loop.measured]
    low, high = min(values), max(values)
    margin = 0.06 * max(high - low, 1e-3)
    frame = Frame(420.0, 320.0, (loop.signals[0] * 1.05, loop.signals[-1] * 1.05), (low - margin, high + margin))
    frame.axes("signal", "effective signal")
    if loop.signals[0] < 0.0 < loop.signals[-1]:
        frame.add(line(frame.x(0.0), frame.top, frame.x(0.0), frame.height - frame.bottom, FAINT))
    frame.polyline(loop.signals, loop.rising, VERMILION)
    frame.polyline(loop.signals, loop.falling, BLUE, dash="7 3")
    if loop.modelled_path:
        frame.polyline(loop.path, loop.modelled_path, GREY, 1.5)
    for signal, value in zip(loop.path, loop.measured, strict=False):
        frame.add(
            f'<circle cx="{frame.x(signal):.1f}" cy="{frame.y(value):.1f}" r="4.5" fill="{ORANGE}" stroke="{INK}"/>'
        )
    if loop.stands is not None:
        x, y = frame.x(loop.stands[0]), frame.y(loop.stands[1])
        frame.add(f'<path d="M{x - 7:.1f} {y:.1f}h14M{x:.1f} {y - 7:.1f}v14" stroke="{INK}" stroke-width="2.5"/>')
    legend = [(VERMILION, "rising"), (BLUE, "falling, dashed")]
    legend += [(ORANGE, "measured"), (GREY, "model of that way")] if loop.measured else []
    for row, (colour, words) in enumerate(legend):
        y = frame.top + 16 + 16 * row
        frame.add(
            line(frame.left + 8, y - 4, frame.left + 26, y - 4, colour, 3),
            text(frame.left + 32, y, words, "start", FONT),
        )
    return frame.picture(f"hysteresis loop of actuator {loop.actuator}: {loop.words}")
