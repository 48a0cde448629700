"""What is asked of the mirror: a conic of some curvature with Zernike terms on top."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from dm_msgs.msg import FocusRequest

from dm_common import Floats
from dm_common.errors import ErrorCode, Refusal, beside
from dm_common.optics.conic import conic_coefficients, conic_sag, curvatures_text
from dm_common.optics.zernike import PISTON_TILT, TERMS, basis
from dm_common.values import Fields, real, reals, text


class TargetError(Refusal):
    """A surface that does not exist; the message names field, value and allowed range."""

    def __init__(self, message: str) -> None:
        super().__init__(ErrorCode.OUT_OF_RANGE, message)


MODES = (FocusRequest.MODE_AUTO, FocusRequest.MODE_DIRECT, FocusRequest.MODE_CONDITIONED)
#: Limits far beyond any mirror, which keep all that is computed from them finite.
_TARGET = {
    "curvature": real(0.0, -1e6, 1e6, "1/m"),
    "conic_constant": real(0.0, -1e9, 1e9),
    "zernike": reals([], -1.0, 1.0, "m", sizes=(0, len(TERMS))),
}
#: Allowed values of the fields of a target: in a request, and in the target itself.
REQUEST = Fields(
    {
        "mode": text("", choices=("", *MODES)),
        "time_budget": real(0.0, 0.0, 1e9, "s", zero="as configured"),
        "holder": text(""),
        **_TARGET,
    }
)
TARGET = Fields(_TARGET)


@dataclass(frozen=True, eq=False)
class Shape:
    """A surface, or a difference of two, as calibrations describe it.

    Attributes:
        coefficients: (K,) Born & Wolf, m.
        sag: (P,) at the calibration's sampling points, m, finite.
    """

    coefficients: Floats
    sag: Floats

    def __add__(self, other: Shape) -> Shape:
        return Shape(self.coefficients + other.coefficients, self.sag + other.sag)

    def __sub__(self, other: Shape) -> Shape:
        return Shape(self.coefficients - other.coefficients, self.sag - other.sag)

    def __neg__(self) -> Shape:
        return Shape(-self.coefficients, -self.sag)

    @property
    def max_zernike(self) -> float:
        """Largest coefficient beyond tilt, m."""
        return float(np.abs(self.coefficients[PISTON_TILT:]).max())


@dataclass(frozen=True)
class FocusTarget:
    """A wanted surface.

    Attributes:
        curvature: of the surface at the vertex [1/m], positive = concave. Optical power = 2 x curvature.
        conic_constant: 0 = sphere, -1 = paraboloid (Eq. 2 in [1]).
        zernike: added sag [m], Born & Wolf terms in the order of [1] over the working aperture; empty = none.

    Values from outside have to be checked against `TARGET` or `REQUEST` first.
    """

    curvature: float
    conic_constant: float = 0.0
    zernike: tuple[float, ...] = ()

    def check_aperture(self, radius: float) -> None:
        """Raise TargetError when a conic of this curvature does not reach the edge of the aperture."""
        reach = (1.0 + self.conic_constant) * (self.curvature * radius) ** 2
        if reach >= 1.0:
            raise TargetError(
                f"curvature = {self.curvature:g} 1/m with conic_constant = {self.conic_constant:g}: no such surface "
                f"reaches the edge of the aperture (radius {radius * 1e3:g} mm); "
                f"(1 + conic_constant) (curvature x radius)^2 = {reach:g} must be below 1"
            )

    def coefficients(self, radius: float) -> Floats:
        """(21,) Born & Wolf coefficients of the sag over an aperture of `radius` [m]."""
        self.check_aperture(radius)
        result = np.array(conic_coefficients(self.curvature, self.conic_constant, radius), dtype=float)
        if self.zernike:
            result += self.zernike
        return result

    def sag(self, x: Floats, y: Floats, radius: float) -> Floats:
        """Sag [m] at points of the unit disc of an aperture of `radius` [m]."""
        self.check_aperture(radius)
        result: Floats = conic_sag(x * radius, y * radius, self.curvature, self.conic_constant)
        if self.zernike:
            result = result + basis(x, y) @ np.asarray(self.zernike)
        return result

    def deviation(self, other: FocusTarget, radius: float) -> float:
        """Largest difference of their coefficients beyond tilt, m, over an aperture of `radius` [m]."""
        difference = self.coefficients(radius) - other.coefficients(radius)
        return float(np.abs(difference[PISTON_TILT:]).max())

    def denied(self, error: float, allowed: float, reachable: tuple[float, float]) -> str:
        """Say that limits do not allow the target, as a sentence.

        They leave a largest coefficient error of `error`, m, and permit the curvatures `reachable`, 1/m; NaN = none.
        """
        low, high = reachable
        if math.isnan(low):
            text = "no curvature is reachable" + (
                " with these added Zernike terms"
                if any(self.zernike)
                else ": the initial figure takes more than the limits permit, or than the actuators can form; check "
                "limits.signal_min, limits.signal_max and limits.neighbour_difference of pdm_driver, or allow a larger "
                "error (reachable_tolerance of focus_controller)"
            )
        else:
            text = f"reachable: {curvatures_text(low, high)}"
        return (
            f"curvature = {beside('+.4f', self.curvature, low, high)} 1/m: the limits of the actuators leave a "
            f"coefficient error of {beside('.1f', error * 1e9, allowed * 1e9)} nm (allowed {allowed * 1e9:.1f} nm); "
            f"{text}"
        )

    def with_curvature(self, curvature: float) -> FocusTarget:
        """The same target at another curvature."""
        return FocusTarget(curvature, self.conic_constant, self.zernike)
