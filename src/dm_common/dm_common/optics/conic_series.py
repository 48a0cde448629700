"""A conic as a short power series in the radius, for all that is linear in sag to be worked out once per mirror.

    z = c r^2 / (1 + sqrt(1 - q)) = c r^2 sum_j C_j / (2 4^j) q^j,   q = (1 + K) (c r)^2,   C_j the Catalan numbers

(generating function of the Catalan numbers, [6], section 7.5). A mirror of
11 mm and 0.05 1/m has q = 3e-7, so four terms are exact to rounding.
"""

from __future__ import annotations

from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from dm_common.optics.conic import disc_coefficients

#: Powers of q that are kept.
ORDERS = 4
#: Largest |q| at the rim for which the series is used: what is left out is below 14/512 q^4, 3e-18 of the whole.
Q_MAX = 1e-4


def series(curvature: float, conic_constant: float, radius: float) -> tuple[float, float, float, float] | None:
    """The ORDERS amplitudes (m) of (r / radius)^2, ^4, ^6, ^8; None where the series is too short."""
    q = (1.0 + conic_constant) * (curvature * radius) ** 2
    if not abs(q) <= Q_MAX:
        return None
    reach = curvature * radius * radius
    return reach / 2, reach * q / 8, reach * q * q / 16, reach * q**3 * (5 / 128)


def series_sag(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, ORDERS) sag per amplitude at points of the unit disc."""
    return np.asarray((x**2 + y**2)[:, None] ** np.arange(1, ORDERS + 1))


@cache
def series_coefficients() -> NDArray[np.float64]:
    """(21, ORDERS) Born & Wolf coefficients per amplitude, by least squares over the full disc."""
    return np.column_stack([disc_coefficients(partial(_power, n)) for n in range(1, ORDERS + 1)])


def _power(order: int, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((x**2 + y**2) ** order)
