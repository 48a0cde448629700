"""Figures in sentences."""

from __future__ import annotations


def rounded(value: float) -> str:
    """Two significant digits, more only where they stand before the point: 1.3, 97, 153."""
    return f"{value:.0f}" if abs(value) >= 99.5 else f"{value:.2g}"


def in_nanometres(length: float) -> str:
    """A length (m) with two significant digits, such as 1.3 nm."""
    return f"{rounded(length * 1e9)} nm"


def in_wavelengths(length: float, wavelength: float) -> str:
    """A length (m) as a fraction of the wavelength, such as λ/50, or as a multiple where it is longer, such as 2 λ."""
    if length > wavelength:
        return f"{rounded(length / wavelength)} λ"
    return f"λ/{wavelength / length:.0f}" if length > 0 else "0"
