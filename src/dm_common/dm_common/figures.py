"""Figures in sentences."""

from __future__ import annotations


def rounded(value: float) -> str:
    """Two significant digits, more only where they stand before the point: 1.3, 97, 153."""
    return f"{value:.0f}" if abs(value) >= 99.5 else f"{value:.2g}"
