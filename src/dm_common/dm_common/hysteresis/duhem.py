"""Rate-independent hysteresis that fades with travel: Duhem operators, one with a learned slope and linear ones.

``dz/du = f(z)`` while the signal rises and ``f(-z)`` while it falls, f(0) = 1 [21]. Play operators never forget what
was not wiped out by a larger swing; this one forgets exponentially, as some ceramics do. f is a polynomial whose
coefficients are fitted, ``f(z) = 1 - a_1 z - a_2 z^2 - ...``; the law a mirror really has need not be one of them.
Actuators may have polynomials of their own, and others on falling than on rising moves.

The equation has no u in it, so a move of any length is one look-up in the table of ``F(z) = integral dz / f``.

Linear ones follow powers of the signal, each at its own rate: ``dz = u^p du - rate z |du|``. Their weighted sums are
laws of Coleman and Hodgdon [38] with any polynomials. They take up what no slope in z alone shows: domain walls that
follow a curve of the signal [36].
"""

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import NDArray

from dm_common import Floats

#: Largest |z| of a table.
REACH = 2.5
#: Longest straight way, from one end of the signals to the other.
FULL_SWING = 2.0
#: Slope at which a table ends: z comes no nearer to its limit.
SLOPE_MIN = 1e-3
KNOTS = 2001
#: No operators.
NONE, NO_DRIVE = np.zeros(0), np.zeros((0, 0))


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
        self._polynomial = np.vstack((np.ones(len(rows)), -slope.reshape(len(rows), -1).T))
        z = np.linspace(-REACH, REACH, KNOTS)
        f = polyval(z, self._polynomial)  # (rows, KNOTS)
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
        return horner(self._polynomial[:, self._rows(np.broadcast_to(way, along.shape))], along)


def horner(coefficients: Floats, x: Floats) -> Floats:
    """Polynomials with `coefficients` (D + 1, ...) by rising power, at x (...): faster than NumPy's for few x."""
    total = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return np.asarray(total)


class FadingHysteresis:
    """What Duhem operators add to a law.

    States are (N, Z): of the operator with the learned slope, if there is one, then of the linear ones, rate by rate.

    Args:
        slope, weight: of that operator, and () or (N,) of its value; an empty slope = none.
        rates: (K,) of the linear ones, positive.
        drive: (K, P) or (N, K, P) weights of those that follow the powers 0 .. P - 1.

    Raises:
        ValueError: as :class:`DuhemOperator`.
    """

    def __init__(
        self, slope: Floats = NONE, weight: float | Floats = 1.0, rates: Floats = NONE, drive: Floats = NO_DRIVE
    ) -> None:
        self._learned = DuhemOperator(slope) if slope.size else None
        self._learned_weight = np.reshape(weight, (-1, 1))
        self._rates, self._drive = rates, drive if drive.ndim == 3 else drive[None]
        # way a(u) + b(u), polynomials of the signal, solve the linear equations; what z is apart from that fades.
        count, powers = drive.shape[-2:]
        self._solutions = np.zeros((2, count, powers, powers))
        for power in range(powers):
            self._solutions[0, :, power, power] = 1.0 / rates
            if power:
                self._solutions[:, :, power] -= power / rates[:, None] * self._solutions[::-1, :, power - 1]
        # The same of the weighted sums at each rate, and of those at all rates by rising power, with its slope.
        self._sums = np.einsum("nkp,wkpq->wnkq", self._drive, self._solutions)
        self._curves = np.moveaxis(self._sums.sum(axis=2), 2, 1)[..., None]
        self._slopes = polyder(self._curves, axis=1) if powers else self._curves

    @property
    def size(self) -> int:
        """Z, the number of states of an actuator."""
        return int(self._learned is not None) + self._drive[0].size

    def _linear(self, states: Floats) -> Floats:
        """(N, K, P) of `states` (N, Z)."""
        return states[:, int(self._learned is not None) :].reshape(len(states), *self._drive.shape[1:])

    def move(self, states: Floats, signals: Floats, there: Floats) -> Floats:
        """States (N, Z) after straight ways from `signals` (N,), where they are `states`, to `there` (N,)."""
        change = there - signals
        moved = [] if self._learned is None else [self._learned.move(states[:, 0], change)[:, None]]
        if self._rates.size:
            way = np.where(change < 0.0, -1.0, 1.0)[:, None, None]
            powers = np.stack((signals, there))[..., None] ** np.arange(self._drive.shape[2])
            a, b = np.einsum("wkpq,tnq->wtnkp", self._solutions, powers)
            before, after = way * a + b
            left = np.exp(-np.abs(change)[:, None] * self._rates)[..., None]
            moved.append((after + (self._linear(states) - before) * left).reshape(len(change), -1))
        return np.concatenate(moved, axis=1)

    def value(self, states: Floats) -> Floats:
        """(N,) what actuators with the states (N, Z) add to static effective signals."""
        linear = (self._drive * self._linear(states)).sum(axis=(1, 2))
        return linear if self._learned is None else linear + self._learned_weight[:, 0] * states[:, 0]

    def along(self, states: Floats, signals: Floats, there: Floats, way: Floats) -> tuple[Floats, Floats]:
        """Value and slope at `there` (..., N, P) on straight ways from `signals` (N,), where they are `states` (N, Z).

        Args:
            way: 1 where they rise, -1 where they fall; of a shape that broadcasts to that of `there`.
        """
        change = there - signals[:, None]
        value = slope = np.zeros(())
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
