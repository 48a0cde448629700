"""Rate-independent hysteresis that fades with travel: a Duhem operator with a learned slope.

``dz/du = f(z)`` while the signal rises and ``f(-z)`` while it falls, f(0) = 1 [21]. Play operators never forget what
was not wiped out by a larger swing; this one forgets exponentially, as some ceramics do. f is a polynomial whose
coefficients are fitted, ``f(z) = 1 - a_1 z - a_2 z^2 - ...``; the law a mirror really has need not be one of them.
Actuators may have polynomials of their own, and others on falling than on rising moves.

The equation has no u in it, so a move of any length is one look-up in the table of ``F(z) = integral dz / f``.
"""

import numpy as np
from numpy.typing import NDArray

from dm_common import Floats

#: Largest |z| of a table.
REACH = 2.5
#: Longest straight way, from one end of the signals to the other.
FULL_SWING = 2.0
#: Slope at which a table ends: z comes no nearer to its limit.
SLOPE_MIN = 1e-3
KNOTS = 2001


class DuhemOperator:
    """The operator for any number of actuators at once.

    Args:
        slope: (A,) coefficients a_1, a_2, ... of f, or (N, 2, A) of each actuator, on rising and on falling moves.

    Raises:
        ValueError: coefficients that are not finite, or a state that no table holds.
    """

    def __init__(self, slope: Floats) -> None:
        self.slope = slope = np.asarray(slope, dtype=np.float64)
        if slope.ndim not in (1, 3) or not slope.size or not np.isfinite(slope).all():
            raise ValueError(f"duhem_slope = {slope.tolist()}: must be one or more finite numbers")
        self._own = slope.ndim == 3
        rows = np.arange(slope.size // slope.shape[-1])
        self._polynomial = np.vstack((np.ones(len(rows)), -slope.reshape(len(rows), -1).T, np.zeros(len(rows))))
        z = np.linspace(-REACH, REACH, KNOTS)
        f = np.polynomial.polynomial.polyval(z, self._polynomial)  # (rows, KNOTS)
        passable = np.maximum(f, SLOPE_MIN)
        steps = 0.5 * (1.0 / passable[:, 1:] + 1.0 / passable[:, :-1]) * np.diff(z)
        travel = np.hstack((np.zeros((len(rows), 1)), np.cumsum(steps, axis=1)))
        middle = KNOTS // 2
        travel -= travel[:, [middle]]
        # A rise ends where the slope does, or where a full swing leads; a fall at the opposite value.
        over = ((f < SLOPE_MIN) | (travel >= FULL_SWING))[:, middle + 1 :]
        end = middle + np.where(over.any(axis=1), over.argmax(axis=1), KNOTS)
        begin = KNOTS - 1 - (end.reshape(-1, 2)[:, ::-1].ravel() if self._own else end)
        met = (np.arange(KNOTS) >= begin[:, None]) & (np.arange(KNOTS) <= end[:, None])
        if end.max() >= KNOTS - 1 or end.min() < middle + 1 or f[met].min() <= 0.0:
            raise ValueError(f"duhem_slope = {slope.tolist()}: the state does not stay within +-{REACH:g}")
        # All tables in one, each moved out of the others' way, so that one look-up serves all actuators.
        self._apart = 2.0 * float(np.ptp(z))
        travel += 2.0 * np.abs(travel).max() * rows[:, None]
        self._end = travel[rows, end]
        self._z, self._travel = np.tile(z, len(rows)), travel.ravel()
        self._z_apart = (z + self._apart * rows[:, None]).ravel()

    def _rows(self, way: Floats) -> NDArray[np.intp] | int:
        """The table of each element of `way`: actuators are along the only axis, or the last but one."""
        if not self._own:
            return 0
        actuators = np.arange(len(self.slope))
        return np.asarray(2 * (actuators if way.ndim == 1 else actuators[:, None]) + (way < 0.0))

    def move(self, z: Floats, change: Floats) -> Floats:
        """The state after signals changed by `change` (N,) or (..., N, P) from `z` on, which may repeat."""
        way = np.where(change < 0.0, -1.0, 1.0)
        rows = self._rows(way)
        travelled = np.interp(way * z + self._apart * rows, self._z_apart, self._travel) + np.abs(change)
        return np.asarray(way * np.interp(np.minimum(travelled, self._end[rows]), self._travel, self._z))

    def rise(self, z: Floats, way: Floats) -> Floats:
        """dz/du at the state z, on a way that rises (`way` 1) or falls (-1); shapes as in :meth:`move`."""
        along = way * z
        rows = self._rows(np.broadcast_to(way, along.shape))
        total = self._polynomial[-1][rows]
        for coefficient in self._polynomial[-2::-1]:
            total = total * along + coefficient[rows]
        return np.asarray(total)
