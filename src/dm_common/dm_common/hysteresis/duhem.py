"""Rate-independent hysteresis that fades with travel: Duhem operators, one with a learned slope and linear ones.

``dz/du = f(z)`` while the signal rises and ``f(-z)`` while it falls, f(0) = 1 [21]. A play operator keeps its memory
until a larger swing wipes it out; this operator forgets exponentially with travel, as some ceramics do. f is a
polynomial with fitted coefficients, ``f(z) = 1 - a_1 z - a_2 z^2 - ...``, which only approximates a mirror's law. Each
actuator may have its own polynomials, and different ones for rising and falling moves.

f does not depend on u, so a move of any length is one look-up in the table of ``F(z) = integral dz / f``.

Linear operators follow powers of the signal, each at its own rate: ``dz = u^p du - rate z |du|``. Their weighted sums
are Coleman-Hodgdon laws [38] with arbitrary polynomials. They represent domain walls that follow a curve of the signal
[36], which a slope that depends on z alone cannot.
"""

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import NDArray

from dm_common import Floats

#: Range of a table, |z| <= REACH, and its number of points KNOTS (below).
REACH = 2.5
#: Longest straight move, from one end of the signal range to the other.
FULL_SWING = 2.0
#: Slope f(z) at which a table ends: z is then taken to have reached its limit.
SLOPE_MIN = 1e-3
KNOTS = 2001
#: No operators.
NONE, NO_DRIVE = np.zeros(0), np.zeros((0, 0))


class DuhemOperator:
    """The operator for any number of actuators at once.

    Args:
        slope: (A,) coefficients a_1, a_2, ... of f, or (N, 2, A): for each actuator, for rising and for falling moves.

    Raises:
        ValueError: coefficients that are not finite, or a state that leaves the range of the table.
    """

    def __init__(self, slope: Floats) -> None:
        self.slope = slope = np.asarray(slope, dtype=np.float64)
        if slope.ndim not in (1, 3) or not slope.size or not np.isfinite(slope).all():
            raise ValueError(f"duhem_slope = {slope.tolist()}: must be one or more finite numbers")
        self._own = slope.ndim == 3
        rows = np.arange(slope.size // slope.shape[-1])
        self._polynomial = np.vstack((np.ones(len(rows)), -slope.reshape(len(rows), -1).T))
        z = np.linspace(-REACH, REACH, KNOTS)
        f = polyval(z, self._polynomial)  # (rows, KNOTS)
        passable = np.maximum(f, SLOPE_MIN)
        steps = 0.5 * (1.0 / passable[:, 1:] + 1.0 / passable[:, :-1]) * np.diff(z)
        travel = np.hstack((np.zeros((len(rows), 1)), np.cumsum(steps, axis=1)))
        middle = KNOTS // 2
        travel -= travel[:, [middle]]
        # A rise ends where f falls below SLOPE_MIN, or after a full swing; a fall ends at the opposite value.
        over = ((f < SLOPE_MIN) | (travel >= FULL_SWING))[:, middle + 1 :]
        end = middle + np.where(over.any(axis=1), over.argmax(axis=1), KNOTS)
        begin = KNOTS - 1 - (end.reshape(-1, 2)[:, ::-1].ravel() if self._own else end)
        met = (np.arange(KNOTS) >= begin[:, None]) & (np.arange(KNOTS) <= end[:, None])
        if end.max() >= KNOTS - 1 or end.min() < middle + 1 or f[met].min() <= 0.0:
            raise ValueError(f"duhem_slope = {slope.tolist()}: the state does not stay within +-{REACH:g}")
        # All tables in one, offset so that they do not overlap: one look-up then serves all actuators.
        self._apart = 2.0 * float(np.ptp(z))
        travel += 2.0 * np.abs(travel).max() * rows[:, None]
        self._end = travel[rows, end]
        self._z, self._travel = np.tile(z, len(rows)), travel.ravel()
        self._z_apart = (z + self._apart * rows[:, None]).ravel()

    def _rows(self, way: Floats) -> NDArray[np.intp] | int:
        """Index of the table for each element of `way`; actuators are along the only axis, or the last but one."""
        if not self._own:
            return 0
        actuators = np.arange(len(self.slope))
        return np.asarray(2 * (actuators if way.ndim == 1 else actuators[:, None]) + (way < 0.0))

    def move(self, z: Floats, change: Floats) -> Floats:
        """The state after signals changed by `change`, (N,) or (..., N, P), starting from `z`, which is broadcast."""
        way = np.where(change < 0.0, -1.0, 1.0)
        rows = self._rows(way)
        travelled = np.interp(way * z + self._apart * rows, self._z_apart, self._travel) + np.abs(change)
        return np.asarray(way * np.interp(np.minimum(travelled, self._end[rows]), self._travel, self._z))

    def rise(self, z: Floats, way: Floats) -> Floats:
        """dz/du at the state z on a rising (`way` 1) or falling (-1) move; shapes as in :meth:`move`."""
        along = way * z
        return horner(self._polynomial[:, self._rows(np.broadcast_to(way, along.shape))], along)


def horner(coefficients: Floats, x: Floats) -> Floats:
    """Polynomials with `coefficients` (D + 1, ...) by rising power, at x (...): faster than NumPy's for few x."""
    total = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return np.asarray(total)


class FadingHysteresis:
    """Contribution of Duhem operators to a law.

    States are (N, Z): first the operator with the learned slope, if there is one, then the linear ones, rate by rate.

    Args:
        slope, weight: of the operator with the learned slope (empty = none), and () or (N,) weight of its value.
        rates: (K,) of the linear ones, positive.
        drive: (K, P) or (N, K, P) weights of the linear operators that follow the powers 0 .. P - 1 of the signal.

    Raises:
        ValueError: as :class:`DuhemOperator`.
    """

    def __init__(
        self, slope: Floats = NONE, weight: float | Floats = 1.0, rates: Floats = NONE, drive: Floats = NO_DRIVE
    ) -> None:
        self._learned = DuhemOperator(slope) if slope.size else None
        self._learned_weight = np.reshape(weight, (-1, 1))
        self._rates, self._drive = rates, drive if drive.ndim == 3 else drive[None]
        # way a(u) + b(u), polynomials of the signal, is a particular solution; the deviation of z from it decays.
        count, powers = drive.shape[-2:]
        self._solutions = np.zeros((2, count, powers, powers))
        for power in range(powers):
            self._solutions[0, :, power, power] = 1.0 / rates
            if power:
                self._solutions[:, :, power] -= power / rates[:, None] * self._solutions[::-1, :, power - 1]
        # Solutions weighted by `drive`, for each rate; then summed over the rates, by rising power; slope of this sum.
        self._sums = np.einsum("nkp,wkpq->wnkq", self._drive, self._solutions)
        self._curves = np.moveaxis(self._sums.sum(axis=2), 2, 1)[..., None]
        self._slopes = polyder(self._curves, axis=1) if powers else self._curves

    @property
    def size(self) -> int:
        """Z, the number of states of an actuator."""
        return int(self._learned is not None) + self._drive[0].size

    def _linear(self, states: Floats) -> Floats:
        """The states (N, Z) of the linear operators as (N, K, P)."""
        return states[:, int(self._learned is not None) :].reshape(len(states), *self._drive.shape[1:])

    def move(self, states: Floats, signals: Floats, there: Floats) -> Floats:
        """States (N, Z) after straight moves from `signals` (N,), in the states `states` (N, Z), to `there` (N,)."""
        change = there - signals
        moved = [states[:, :0] if self._learned is None else self._learned.move(states[:, 0], change)[:, None]]
        if self._rates.size:
            way = np.where(change < 0.0, -1.0, 1.0)[:, None, None]
            powers = np.stack((signals, there))[..., None] ** np.arange(self._drive.shape[2])
            a, b = np.einsum("wkpq,tnq->wtnkp", self._solutions, powers)
            before, after = way * a + b
            left = np.exp(-np.abs(change)[:, None] * self._rates)[..., None]
            moved.append((after + (self._linear(states) - before) * left).reshape(len(change), -1))
        return np.concatenate(moved, axis=1)

    def value(self, states: Floats) -> Floats:
        """(N,) contribution of the states (N, Z) to the static effective signals."""
        linear = (self._drive * self._linear(states)).sum(axis=(1, 2))
        return linear if self._learned is None else linear + self._learned_weight[:, 0] * states[:, 0]

    def along(self, states: Floats, signals: Floats, there: Floats, way: Floats) -> tuple[Floats, Floats]:
        """Value and slope at `there` (..., N, P) on straight moves from `signals` (N,), in the states `states` (N, Z).

        Args:
            way: 1 for rising, -1 for falling moves; must broadcast to the shape of `there`.
        """
        change = there - signals[:, None]
        value = slope = np.zeros((1, 1))
        if self._learned is not None:
            z = self._learned.move(states[:, :1], change)
            value, slope = self._learned_weight * z, self._learned_weight * self._learned.rise(z, way)
        if self._rates.size:
            powers = signals[:, None, None] ** np.arange(self._drive.shape[2])
            a, b = (self._sums * powers).sum(axis=-1)
            apart = ((self._drive * self._linear(states)).sum(axis=2) - b)[:, None] - way[..., None] * a[:, None]
            fading = apart * np.exp(-np.abs(change)[..., None] * self._rates)
            a, b = self._curves
            value = value + way * horner(a, there) + horner(b, there) + fading.sum(axis=-1)
            a, b = self._slopes
            slope = slope + way * (horner(a, there) - fading @ self._rates) + horner(b, there)
        return np.asarray(value), np.asarray(slope)
