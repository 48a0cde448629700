"""What is asked of the mirror: a conic of some curvature with Zernike terms on top."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from dm_msgs.msg import FocusRequest
from numpy.typing import NDArray

from dm_common.errors import ErrorCode, Refusal
from dm_common.messages import stamp_ns
from dm_common.optics.conic import conic_coefficients, conic_sag
from dm_common.optics.zernike import PISTON_TILT, TERMS, basis
from dm_common.values import Fields, real, reals, text


class TargetError(Refusal):
    """A surface that does not exist; the message names field, value and allowed range."""

    def __init__(self, message: str) -> None:
        super().__init__(ErrorCode.OUT_OF_RANGE, message)


MODES = (FocusRequest.MODE_AUTO, FocusRequest.MODE_DIRECT, FocusRequest.MODE_CONDITIONED)
#: What the fields of a target, and those of a request beside them, may be.
TARGET = Fields({"curvature": real(0.0), "conic_constant": real(0.0), "zernike": reals([], sizes=(0, len(TERMS)))})
REQUEST = Fields(
    {
        "mode": text("", choices=("", *MODES)),
        "time_budget": real(0.0, 0.0, 1e9, "s", zero="as configured"),
    }
)


@dataclass(frozen=True)
class FocusTarget:
    """A wanted surface.

    Attributes:
        curvature: of the surface at the vertex [1/m], positive = concave. Optical power = 2 x curvature.
        conic_constant: 0 = sphere, -1 = paraboloid (Eq. 2 in [1]).
        zernike: added sag [m], Born & Wolf terms in the order of [1] over the working aperture; empty = none.

    Raises:
        Refusal: NOT_FINITE, or INVALID_LENGTH of `zernike`.
    """

    curvature: float
    conic_constant: float = 0.0
    zernike: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        TARGET.check(self)

    def check_aperture(self, radius: float) -> None:
        """Raise TargetError when a conic of this curvature does not reach the edge of the aperture."""
        reach = (1.0 + self.conic_constant) * (self.curvature * radius) ** 2
        if reach >= 1.0:
            raise TargetError(
                f"curvature = {self.curvature:g} 1/m with conic_constant = {self.conic_constant:g}: no such surface "
                f"reaches the edge of the aperture (radius {radius * 1e3:g} mm); "
                f"(1 + conic_constant) (curvature x radius)^2 = {reach:g} must be below 1"
            )

    def coefficients(self, radius: float) -> NDArray[np.float64]:
        """(21,) Born & Wolf coefficients of the sag over an aperture of `radius` [m]."""
        self.check_aperture(radius)
        result = np.array(conic_coefficients(self.curvature, self.conic_constant, radius), dtype=float)
        if self.zernike:
            result += self.zernike
        return result

    def sag(self, x: NDArray[np.float64], y: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
        """Sag [m] at points of the unit disc of an aperture of `radius` [m]."""
        self.check_aperture(radius)
        result: NDArray[np.float64] = conic_sag(x * radius, y * radius, self.curvature, self.conic_constant)
        if self.zernike:
            result = result + basis(x, y) @ np.asarray(self.zernike)
        return result

    def deviation(self, other: FocusTarget, radius: float) -> float:
        """Largest difference of their coefficients beyond tilt, m, over an aperture of `radius` [m]."""
        difference = self.coefficients(radius) - other.coefficients(radius)
        return float(np.abs(difference[PISTON_TILT:]).max())

    def denied(self, error: float, allowed: float, reachable: tuple[float, float]) -> str:
        """That limits deny it, as a sentence.

        Args:
            error: largest coefficient error that they leave, m.
            allowed: how large it may be, m.
            reachable: the curvatures that they permit, 1/m; NaN = none.
        """
        low, high = reachable
        if math.isnan(low):
            text = "no curvature is reachable with these added Zernike terms"
        else:
            text = f"reachable: {low:+.4f} to {high:+.4f} 1/m ({2 * low:+.3f} to {2 * high:+.3f} dioptre)"
        return (
            f"curvature = {self.curvature:+.4f} 1/m: the limits of the actuators leave a coefficient error of "
            f"{error * 1e9:.1f} nm (allowed {allowed * 1e9:.1f} nm); {text}"
        )

    def with_curvature(self, curvature: float) -> FocusTarget:
        """The same target at another curvature."""
        return FocusTarget(curvature, self.conic_constant, self.zernike)


@dataclass(frozen=True)
class Request:
    """A wanted surface and the way to it; fields as in dm_msgs/FocusRequest.

    Attributes:
        curvature: 1/m.
        conic_constant: 0 = sphere.
        zernike: m, added sag, Born & Wolf; empty = none.
        mode: one of MODES; "" = AUTO.
        time_budget: s that AUTO may take; 0 = as configured.
        stamp_ns: when it was made; 0 = now.
        holder: who asks, where somebody holds the mirror; "" = nobody in particular.
        take_over: even if somebody else holds it.
    """

    curvature: float = 0.0
    conic_constant: float = 0.0
    zernike: tuple[float, ...] = ()
    mode: str = FocusRequest.MODE_AUTO
    time_budget: float = 0.0
    stamp_ns: int = 0
    holder: str = ""
    take_over: bool = False

    def target(self) -> FocusTarget:
        """The wanted surface. Raises Refusal naming a field that may not be as it is."""
        REQUEST.check(self)
        return FocusTarget(self.curvature, self.conic_constant, self.zernike)

    @classmethod
    def from_message(cls, message: FocusRequest) -> Request:
        return cls(
            message.curvature,
            message.conic_constant,
            tuple(message.zernike),
            message.mode,
            message.time_budget,
            stamp_ns(message.header.stamp),
            message.holder,
            message.take_over,
        )
