"""Rate-independent hysteresis that fades with travel: a Duhem operator with a learned slope.

``dz/du = f(z)`` while the signal rises and ``f(-z)`` while it falls, f(0) = 1 [21]. Play operators never forget what
was not wiped out by a larger swing; this one forgets exponentially, as some ceramics do. f is a polynomial whose
coefficients are fitted, ``f(z) = 1 - a_1 z - a_2 z^2 - ...``; the law a mirror really has need not be one of them.

The equation has no u in it, so a move of any length is one look-up in the table of ``F(z) = integral dz / f``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Largest |z| of a table.
REACH = 2.5
#: Longest straight way, from one end of the signals to the other.
FULL_SWING = 2.0
#: Slope at which the table ends: z comes no nearer to its limit.
SLOPE_MIN = 1e-3
KNOTS = 2001


class DuhemOperator:
    """The operator for any number of actuators at once.

    Args:
        slope: (A,) coefficients a_1, a_2, ... of f.

    Raises:
        ValueError: coefficients that are not finite, or a state that no table holds.
    """

    def __init__(self, slope: Floats) -> None:
        slope = np.asarray(slope, dtype=np.float64)
        if slope.ndim != 1 or not slope.size or not np.isfinite(slope).all():
            raise ValueError(f"duhem_slope = {slope.tolist()}: must be one or more finite numbers")
        z = np.linspace(-REACH, REACH, KNOTS)
        f = 1.0 - np.polynomial.polynomial.polyval(z, np.concatenate(([0.0], slope)))
        # A rise ends where the slope does, or where a full swing leads; a fall at the opposite value.
        middle = KNOTS // 2
        stopped = np.flatnonzero(f[middle:] < SLOPE_MIN)
        end = middle + (int(stopped[0]) if stopped.size else KNOTS - middle) - 1
        steps = 0.5 * (1.0 / f[middle + 1 : end + 1] + 1.0 / f[middle:end]) * np.diff(z[middle : end + 1])
        end = middle + int(np.searchsorted(np.cumsum(steps), FULL_SWING))
        begin = KNOTS - 1 - end
        self._z, f = z[begin : end + 1], f[begin : end + 1]
        if end == KNOTS - 1 or len(f) < 3 or f.min() <= 0.0:
            raise ValueError(f"duhem_slope = {slope.tolist()}: the state does not stay within +-{REACH:g}")
        steps = 0.5 * (1.0 / f[1:] + 1.0 / f[:-1]) * np.diff(self._z)
        travel = np.concatenate(([0.0], np.cumsum(steps)))
        self._travel = travel - np.interp(0.0, self._z, travel)
        self.slope = slope
        self.slope_range = float(f.min()), float(f.max())

    def move(self, z: Floats, change: Floats) -> Floats:
        """The state z (N,) after signals changed by `change` (N,) on a straight way."""
        way = np.where(change < 0.0, -1.0, 1.0)
        travelled = np.interp(way * z, self._z, self._travel) + np.abs(change)
        return np.asarray(way * np.interp(travelled, self._travel, self._z))
