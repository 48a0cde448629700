"""Conic surfaces about the axis, Eq. (2) in [1], and their Zernike coefficients."""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from dm_common import Floats
from dm_common.optics.zernike import DEFOCUS, TERM_RMS, basis

_RADIAL_NODES = 24
_ANGLES = 48


def conic_sag(x: ArrayLike, y: ArrayLike, curvature: float, conic_constant: float = 0.0) -> Floats:
    """Sag of a conic, m, Eq. (2); positive curvature is concave (the rim stands above the vertex).

    In this form, with the root in the denominator, the equation loses no digits for weak curvatures.

    Args:
        x, y: m, of any one shape, which the result has too.
        curvature: axial curvature, 1/m.
        conic_constant: 0 = sphere, -1 = paraboloid.

    Raises:
        ValueError: a number that is not finite, or a point beyond the equator, where the conic has no sag.
    """
    r2 = np.asarray(x, dtype=float) ** 2 + np.asarray(y, dtype=float) ** 2
    root = 1 - (1 + conic_constant) * curvature**2 * r2
    if not np.isfinite(root).all():
        raise ValueError(f"curvature = {curvature} 1/m, conic_constant = {conic_constant}: must be finite")
    if (root < 0).any():
        raise ValueError(
            f"curvature = {curvature:g} 1/m, conic_constant = {conic_constant:g}: the surface does not reach out to "
            f"{np.sqrt(r2.max()):g} m; (1 + conic_constant) curvature^2 r^2 must be at most 1, is {1 - root.min():g}"
        )
    return np.asarray(curvature * r2 / (1 + np.sqrt(root)))


def conic_coefficients(curvature: float, conic_constant: float, radius: float) -> Floats:
    """(21,) Born & Wolf coefficients, m, of a conic over an aperture of `radius` m, by least squares over the disc.

    The terms are orthogonal on the disc, so each coefficient is a projection; the integrals are Gauss-Legendre in r^2
    and equidistant in angle, exact for the polynomials involved. The other arguments are those of `conic_sag`.

    Raises:
        ValueError: radius not positive, or the conic does not reach out to it.
    """
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius = {radius} m: must be positive")
    return disc_coefficients(lambda x, y: conic_sag(radius * x, radius * y, curvature, conic_constant))


def disc_coefficients(sag: Callable[[Floats, Floats], Floats]) -> Floats:
    """(..., 21) Born & Wolf coefficients of `sag`, a function of x, y (Q,) on the unit disc that returns (..., Q)."""
    x, y, projection = _quadrature()
    return sag(x, y) @ projection


@cache
def _quadrature() -> tuple[Floats, Floats, Floats]:
    """Points of the unit disc, x and y (Q,), and the matrix (Q, 21) that turns sag there into coefficients."""
    nodes, weights = np.polynomial.legendre.leggauss(_RADIAL_NODES)
    r = np.sqrt((nodes + 1) / 2)
    angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    x, y = np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()
    area = np.repeat(weights / (2 * _ANGLES), _ANGLES)
    return x, y, area[:, np.newaxis] * basis(x, y) / TERM_RMS**2


def pitch_of_sphere(
    coefficients: ArrayLike, radius_px: float, pitch: float, radius_of_curvature: float
) -> tuple[float, float]:
    """The lateral resolution (m per pixel) of a map that shows a sphere of known radius.

    The defocus of a sphere is proportional to the square of the aperture radius, so heights give lengths.

    Args:
        coefficients: (21,) m, of a map of the sphere.
        radius_px: of the aperture, pixels.
        pitch: lateral resolution in use, m per pixel; 0 = not known.
        radius_of_curvature: m; positive = concave.

    Returns:
        The resolution, and its relative error per nm of error in the defocus.

    Raises:
        ValueError: no sphere, defocus of the other sign, or more than ten per cent off the pitch in use.
    """
    seen = float(np.asarray(coefficients)[DEFOCUS])
    if radius_of_curvature == 0.0 or not seen * radius_of_curvature > 0.0:
        raise ValueError(
            f"radius of curvature = {radius_of_curvature:g} m: must have the sign of the map's defocus, "
            f"{seen * 1e9:+.1f} nm, and the map must show one"
        )
    found = 2.0 * np.sqrt(seen * radius_of_curvature) / radius_px
    for _ in range(3):  # a sphere is a little steeper than the paraboloid of its curvature
        expected = conic_coefficients(1.0 / radius_of_curvature, 0.0, found * radius_px)[DEFOCUS]
        found *= np.sqrt(seen / expected)
    if pitch > 0.0 and not abs(found / pitch - 1.0) < 0.1:
        raise ValueError(
            f"the map would have {found * 1e6:.3f} um per pixel, the pitch in use is {pitch * 1e6:.3f} um: not a "
            f"sphere of {radius_of_curvature:g} m"
        )
    return float(found), 0.5e-9 / abs(seen)


def reachable_range(reached: Callable[[float], bool], middle: float, stroke: float, step: float) -> tuple[float, float]:
    """Smallest and largest curvature (1/m) that a mirror reaches; (nan, nan) if neither 0 nor `middle` is reached.

    Args:
        reached: whether the mirror reaches a curvature; by convexity, the reachable ones form one interval.
        middle: curvature at mid range, where the search starts if 0 is not reached (a mirror that is only pulled).
        stroke: largest change of curvature by all actuators together, 1/m.
        step: accuracy of the ends, 1/m.
    """
    start = next(filter(reached, (0.0, middle)), math.nan)

    def edge(far: float) -> float:
        near = start
        while abs(far - near) > step:
            between = 0.5 * (near + far)
            near, far = (between, far) if reached(between) else (near, between)
        return near

    return edge(start - stroke), edge(start + stroke)


def curvatures_text(low: float, high: float, digits: int = 4) -> str:
    """A range of curvatures (1/m), followed in brackets by the optical power, see :func:`range_text`."""
    return f"{range_text(low, high, '1/m', digits)} ({range_text(2 * low, 2 * high, 'dioptre', 3)})"


def range_text(low: float, high: float, unit: str, digits: int = 4) -> str:
    """A range of allowed values, such as -0.0512 to +0.0499 1/m: rounded inwards, so that both ends are allowed.

    A range that is too narrow for this many `digits`, or not finite, is only formatted.
    """
    if math.isfinite(low) and math.isfinite(high):
        scale = 10.0**digits
        least, most = math.ceil(low * scale - 1e-6) / scale, math.floor(high * scale + 1e-6) / scale
        if least <= most:
            low, high = least, most
    return f"{low:+.{digits}f} to {high:+.{digits}f} {unit}"
