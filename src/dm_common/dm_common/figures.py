"""Figures in sentences."""

import math
from typing import Any


def rounded(value: float) -> str:
    """Two significant digits, more only where they stand before the point: 1.3, 97, 153."""
    return f"{value:.0f}" if abs(value) >= 99.5 else f"{value:.2g}"


def in_nanometres(length: float) -> str:
    """A length (m) with two significant digits, such as 1.3 nm."""
    return f"{rounded(length * 1e9)} nm"


def told_from(length: float, other: float) -> str:
    """A length (m) with as many digits as tell it from one that it is compared with, two at least, such as 2.04 nm."""
    text, beside = in_nanometres(length), in_nanometres(other)
    for digits in (3, 4, 5):
        if text != beside or length >= 1e-6:
            return text
        text, beside = (f"{value * 1e9:.{digits}g} nm" for value in (length, other))
    return text if text != beside else in_nanometres(length)


def in_wavelengths(length: float, wavelength: float) -> str:
    """A length (m) as a fraction of the wavelength, such as λ/50; "" above λ/5, which a whole number tells badly."""
    return f"λ/{wavelength / length:.0f}" if 0.0 < 5.0 * length <= wavelength else ""


def with_wavelengths(text: str, length: float, wavelength: float) -> str:
    """A text that gives a length (m), and after it in brackets what that is by the wavelength, where that tells it."""
    share = in_wavelengths(length, wavelength)
    return f"{text} ({share})" if share else text


def two_fold(repeatable: float, calibration: Any, curvature: float) -> str:
    """What a bound on open-loop moves comes to: how well they repeat, and how well they are right, by what limits it.

    Args:
        repeatable: 95 % bound on the largest coefficient error against the maps of the calibration, m; 0 = not known.
        calibration: its `wavelength`, `aperture_radius` (m), `instrument_error` (m) and `scale_error`.
        curvature: for which this holds, 1/m; for a range its farther end. An error of the lateral scale counts twice
            in the curvature.
    """

    def length(metres: float) -> str:
        return with_wavelengths(in_nanometres(metres), metres, calibration.wavelength)

    if not (math.isfinite(repeatable) and repeatable > 0.0):
        return "repeatable to what is not known"
    text = f"repeatable to {length(repeatable)}"
    parameters = {"instrument_error": calibration.instrument_error, "scale_error": calibration.scale_error}
    unknown = [name for name, value in parameters.items() if not value > 0.0]
    if unknown:
        return f"{text}; absolute not known ({' and '.join(unknown)} of the interferometer not given)"
    defocus = abs(curvature) * calibration.aperture_radius**2 / 4.0
    parts = {
        "the calibration": repeatable,
        "the instrument's own error": calibration.instrument_error,
        "the lateral scale": 2.0 * calibration.scale_error * defocus,
    }
    limit = max(parts, key=lambda part: parts[part])
    return f"{text}, absolute to {length(math.hypot(*parts.values()))}, limited by {limit}"


def with_point(text: str) -> str:
    """A number as people write it, with a decimal comma or a typeset minus, as Python reads it."""
    return text.replace(",", ".").replace("−", "-")
