"""What all pictures share: an SVG frame with scaled axes, ticks and labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np

INK, FAINT = "#1f2933", "#c3ccd5"
FONT = 12


def nice_ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About `count` round numbers from `low` to `high`, which must be finite and different."""
    raw = (high - low) / max(count, 1)
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * next(factor for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= raw * 0.999)
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    return [float(number) for number in np.arange(first, last + 1) * step]


def tick_text(value: float) -> str:
    """A tick's number, short, with a real minus."""
    text = f"{value:.3g}" if abs(value) >= 1e-9 else "0"
    return text.replace("-", "−")


def text(x: float, y: float, words: str, anchor: str = "middle", size: float = FONT, extra: str = "") -> str:
    """A text element; `words` are escaped."""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size:g}" fill="{INK}" {extra}>'
        f"{escape(words)}</text>"
    )


def line(x1: float, y1: float, x2: float, y2: float, colour: str = INK, width: float = 1.0, dash: str = "") -> str:
    """A straight line."""
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour}" '
        f'stroke-width="{width:g}"{dashed}/>'
    )


@dataclass
class Frame:
    """A plot area in a picture of `width` x `height` user units, with data ranges.

    Attributes:
        left, top, right, bottom: margins.
        x_range, y_range: data at the edges, low and high.
    """

    width: float
    height: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    left: float = 58.0
    top: float = 12.0
    right: float = 14.0
    bottom: float = 42.0
    parts: list[str] = field(default_factory=list)

    def x(self, value: float) -> float:
        low, high = self.x_range
        return self.left + (value - low) / (high - low) * (self.width - self.left - self.right)

    def y(self, value: float) -> float:
        low, high = self.y_range
        return self.height - self.bottom - (value - low) / (high - low) * (self.height - self.top - self.bottom)

    def add(self, *parts: str) -> None:
        self.parts.extend(parts)

    def axes(self, x_label: str, y_label: str, x_ticks: Sequence[float] | None = None, grid: bool = True) -> None:
        """Border, ticks, numbers and labels; the unit is in the label."""
        bottom, right = self.height - self.bottom, self.width - self.right
        for value in x_ticks if x_ticks is not None else nice_ticks(*self.x_range):
            place = self.x(value)
            self.add(line(place, bottom, place, bottom + 4), text(place, bottom + 17, tick_text(value)))
        for value in nice_ticks(*self.y_range):
            place = self.y(value)
            if grid:
                self.add(line(self.left, place, right, place, FAINT, 0.7))
            self.add(
                line(self.left - 4, place, self.left, place), text(self.left - 7, place + 4, tick_text(value), "end")
            )
        self.add(
            f'<rect x="{self.left}" y="{self.top}" width="{right - self.left:.1f}" '
            f'height="{bottom - self.top:.1f}" fill="none" stroke="{INK}"/>',
            text((self.left + right) / 2, self.height - 5, x_label),
        )
        middle = (self.top + bottom) / 2
        self.add(text(14, middle, y_label, extra=f'transform="rotate(-90 14 {middle:.1f})"'))

    def polyline(self, x: Sequence[float], y: Sequence[float], colour: str, width: float = 2.0, dash: str = "") -> None:
        """A line through points of data."""
        points = " ".join(f"{self.x(a):.1f},{self.y(b):.1f}" for a, b in zip(x, y, strict=True))
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self.add(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{width:g}"{dashed}/>')

    def picture(self, description: str) -> str:
        """The whole picture; `description` is what a screen reader says."""
        return picture(self.width, self.height, self.parts, description)


def picture(width: float, height: float, parts: Sequence[str], description: str) -> str:
    """An SVG that scales with the page."""
    return (
        f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(description, quote=True)}" '
        f'style="width:100%;height:auto;display:block" font-family="inherit">{"".join(parts)}</svg>'
    )
