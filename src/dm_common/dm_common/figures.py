"""Numbers as text: lengths in nanometres or as fractions of a wavelength, and counts."""

import math
from typing import Any


def rounded(value: float) -> str:
    """Two significant digits, or all digits before the decimal point if there are more: 1.3, 97, 153."""
    return f"{value:.0f}" if abs(value) >= 99.5 else f"{value:.2g}"


def in_nanometres(length: float) -> str:
    """A length (m) with two significant digits, such as 1.3 nm."""
    return f"{rounded(length * 1e9)} nm"


def distinct_from(length: float, other: float) -> str:
    """A length (m) with two digits, or as many as distinguish it from `other` (m), such as 2.04 nm."""
    text, other_text = in_nanometres(length), in_nanometres(other)
    for digits in (3, 4, 5):
        if text != other_text or length >= 1e-6:
            return text
        text, other_text = (f"{value * 1e9:.{digits}g} nm" for value in (length, other))
    return text if text != other_text else in_nanometres(length)


def in_wavelengths(length: float, wavelength: float) -> str:
    """A length (m) as a fraction of the wavelength, such as λ/50; "" above λ/5, where a whole number is too coarse."""
    return f"λ/{wavelength / length:.0f}" if 0.0 < 5.0 * length <= wavelength else ""


def with_wavelengths(text: str, length: float, wavelength: float) -> str:
    """The `text` of a `length` (m), followed in brackets by the length as a fraction of the wavelength, up to λ/5."""
    share = in_wavelengths(length, wavelength)
    return f"{text} ({share})" if share else text


def accuracy_text(repeatable: float, calibration: Any, curvature: float) -> str:
    """Text on the repeatability and the absolute accuracy of open-loop moves, and on the limit of the latter.

    Args:
        repeatable: 95 % bound on the largest coefficient error against the maps of the calibration, m; 0 = not known.
        calibration: its `wavelength`, `aperture_radius` (m), `instrument_error` (m) and `scale_error`.
        curvature: of the moves, 1/m; for a range, its end farther from 0. A relative error of the lateral scale gives
            twice that relative error in the curvature.
    """

    def length(metres: float) -> str:
        return with_wavelengths(in_nanometres(metres), metres, calibration.wavelength)

    if not (math.isfinite(repeatable) and repeatable > 0.0):
        return "repeatability not known"
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


def counted(count: int, one: str, several: str = "") -> str:
    """A number with its noun in the singular or plural (`several`, or `one` with an s): no map, 1 map, 5 maps."""
    return f"{count or 'no'} {one if count <= 1 else several or one + 's'}"


def with_point(text: str) -> str:
    """Convert a number as people write it, with a decimal comma or a typeset minus, to Python's notation."""
    return text.replace(",", ".").replace("−", "-")
