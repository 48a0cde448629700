"""The inverse of the hysteresis model: the signals that produce given effective signals from the present state.

On a straight move the play operators set in one after another, and between two of these onsets the law is a polynomial
in the signal. The values of the law at all onsets identify the piece that holds the solution; Newton's method finds it
there. The cost grows with actuators times operators.

Limits bind the signals, while the shape depends on the effective signals. So the programme is solved for the signals
with the law linearised about the last solution (sequential quadratic programming). After a round that did not reduce
the error, half its step and the slopes of its chord are tried. A small weight on changes, without effect at
convergence, keeps signals from moving far for patterns that hardly show, such as piston. All rounds keep the limits.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil, comb

import numpy as np

from dm_common import Floats
from dm_common.bounded import BoundedProgramme
from dm_common.hysteresis.duhem import horner
from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.limits import Limits

#: Accuracy to which effective signals are met (a DAC step is three hundred times as large), and most Newton rounds.
TOLERANCE = 1e-7
ROUNDS_MAX = 60
#: Most iterations if creep elements follow the signals; error of effective signals that ends them, 1/3 DAC step.
LAG_ROUNDS, LAG_LEFT = 20, 1e-5
#: Newton's step never divides by a slope below this; laws that can be inverted are steeper by far.
SLOPE_MIN = 1e-3
#: Margin of neighbours below their limit: one step of a 16-bit DAC, since each of the two signals is rounded.
DAC_STEP = 2.0**-15
#: Most rounds of the programme; change of signals, and share by which a round reduces the error, below which it ends.
ROUNDS, CONVERGED, GAINED = 8, 1e-6, 0.003
#: Weight of changes, relative to the largest gain of the matrix; factors on it after a failed and a successful round.
DAMPING, DAMPING_RAISED, DAMPING_LOWERED = 0.003, 10.0, 0.3
#: Half the signal step of the finite differences that give the slope of the law.
SLOPE_STEP = 1e-4


@dataclass(frozen=True, eq=False)
class Inverted:
    """A command for wanted effective signals.

    Attributes:
        signals: (N,) inside the limits.
        residual: (N,) wanted minus reached effective signals; non-zero only where a limit was met.
    """

    signals: Floats
    residual: Floats


def invert(
    law: HysteresisModel, state: HysteresisState, effective: Floats, low: float, high: float, ahead: float = 0.0
) -> Inverted:
    """Signals (N,) within `low` .. `high` that, applied at the state's time, give `effective` (N,) `ahead` s later.

    The law increases with the signal on every straight move, so each actuator has one solution.

    Raises:
        ValueError: `effective` does not have one value for each actuator, or is not finite.
    """
    if effective.shape != state.signals.shape or not np.isfinite(effective).all():
        raise ValueError(f"effective signals: must be {len(state.signals)} finite numbers")
    if law.is_identity:
        signals = np.clip(effective, low, high)
        return Inverted(signals, effective - signals)
    faded, grown, followed = law.creep_ahead(state, ahead)
    grown, apart, left = grown + followed, state.signals - state.position, np.inf
    for _ in range(LAG_ROUNDS):
        wanted = law.static_of(effective, grown, faded + followed * apart)
        inverted = pieces(law).solve(state, wanted, low, high)
        before, apart = apart, inverted.signals - wanted
        last, left = left, np.maximum.reduce(np.abs(followed * (apart - before)))
        if not LAG_LEFT < left < last:  # a growing change means divergence
            break
    if not inverted.residual.any():
        return inverted
    # A limit may lie before the onset of the piece that holds the solution: the law itself gives what is missed.
    residual = np.where(inverted.residual, effective - law.effective_at(state, inverted.signals, ahead), 0.0)
    return Inverted(inverted.signals, residual)


class Pieces:
    """The polynomials of one law on rising and on falling moves.

    Attributes:
        radius: (R,) half-widths, rising.
        polynomial: (D + 1, 2, 1 or N, R) coefficients by rising power of the sum over the operators 0 .. k that have
            set in, on falling [0] and on rising [1] moves; common to all actuators, or for each.
        derivative: (D, 2, 1 or N, R) likewise, of its slope.
        fading: contribution of Duhem operators, of which there may be none.
    """

    def __init__(self, law: HysteresisModel) -> None:
        order = np.argsort(law.play_radius, kind="stable")
        self._order = None if (np.diff(order) == 1).all() else order
        self.radius = law.play_radius[order]
        weight = np.moveaxis(law.play_weight.reshape(-1, *law.play_weight.shape[-2:])[:, order], 2, 0)
        self._single = np.concatenate((np.zeros((1, *weight.shape[1:])), weight))  # each alone, in its own value
        powers = len(self._single)
        self.polynomial = np.zeros((powers, 2, *weight.shape[1:]))
        for way, sign in enumerate((-1.0, 1.0)):
            # An operator that has set in follows the signal at its half-width: (s - sign r)^power.
            for power in range(powers):
                for low in range(power + 1):
                    self.polynomial[low, way] += (
                        comb(power, low) * (-sign * self.radius) ** (power - low) * self._single[power]
                    )
        self.polynomial = self.polynomial.cumsum(axis=-1)
        self.fading = law.fading
        self.derivative = self.polynomial[1:] * np.arange(1.0, powers)[:, None, None, None]

    def onsets(self, state: HysteresisState, sign: Floats, polynomial: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Signals (..., N, R) at which operators set in, the law there, the contribution of Duhem operators to its
        slope, and the contribution (N, R) to the law of the operators that have not set in yet.

        Args:
            sign: 1 for rising, -1 for falling moves.
            polynomial: (D + 1, ..., N or 1, R) of these moves.
        """
        play = state.play if self._order is None else state.play[:, self._order]
        value = horner(self._single, play)
        waiting = value.sum(axis=1)[:, None] - value.cumsum(axis=1)
        onset = play + sign * self.radius
        added, rise = self.fading.along(state.fading, state.signals, onset, sign)
        return onset, horner(polynomial, onset) + waiting + added, rise, waiting

    def solve(self, state: HysteresisState, wanted: Floats, low: float, high: float) -> Inverted:
        """Signals for the static effective signals `wanted` (N,), found by Newton's method."""
        rising = wanted >= state.position
        way, sign = rising.astype(np.intp), np.where(rising, 1.0, -1.0)
        rows = np.arange(len(wanted))
        laws = rows if self.polynomial.shape[2] > 1 else np.zeros_like(rows)
        onset, at_onset, _, waiting = self.onsets(state, sign[:, None], self.polynomial[:, way, laws])
        still = sign[:, None] * (wanted[:, None] - at_onset)
        last = len(self.radius) - 1
        piece = np.maximum(np.count_nonzero(still >= 0.0, axis=1) - 1, 0)
        following = np.minimum(piece + 1, last)
        begin, end = onset[rows, piece], np.where(piece < last, onset[rows, following], np.where(rising, high, low))
        # The chord of a narrow piece is a good start; beyond the last onset the slope is about 1.
        before, after = still[rows, piece], still[rows, following]
        chord = np.where(before > after, (end - begin) / np.where(before > after, before - after, 1.0), sign)
        signals = np.minimum(np.maximum(begin + chord * before, low), high)
        # The root of the increasing law between `near` and `far`, or the end that comes nearest to it.
        near, far = np.maximum(np.minimum(begin, end), low), np.minimum(np.maximum(begin, end), high)
        polynomial, derivative = (each[:, way, laws, piece] for each in (self.polynomial, self.derivative))
        fixed = waiting[rows, piece]
        for _ in range(ROUNDS_MAX):
            added, rise = self.fading.along(state.fading, state.signals, signals[:, None], sign[:, None])
            gap = horner(polynomial, signals) + fixed + added[:, 0] - wanted
            slope = horner(derivative, signals) + rise[:, 0]
            near, far = np.where(gap < 0.0, signals, near), np.where(gap < 0.0, far, signals)
            step = np.minimum(np.maximum(signals - gap / np.maximum(slope, SLOPE_MIN), near), far)
            if np.abs(step - signals).max() <= TOLERANCE:
                break
            signals = step
        return Inverted(signals, np.where(np.abs(gap) <= 2.0 * TOLERANCE, 0.0, -gap))


#: Cached, since a law never changes.
pieces = lru_cache(maxsize=8)(Pieces)


def within(limits: Limits) -> Limits:
    """`limits` with a margin for the rounding of the electronics, where the limit between neighbours can bind."""
    if not limits.neighbours_can_bind:
        return limits
    return replace(limits, neighbour_difference=max(limits.neighbour_difference - DAC_STEP, 0.5 * DAC_STEP))


class ConstrainedInverse:
    """Finds the nearest commands inside the limits of one mirror.

    Args:
        matrix: (M, N) response to a unit of each effective signal; its M rows are those of the target.
        ridge: weight of the squared effective signals, in the squared unit of `matrix`.
    """

    def __init__(self, law: HysteresisModel, limits: Limits, matrix: Floats, ridge: float) -> None:
        self._law, self._limits = law, limits
        stacked = np.vstack((matrix, np.sqrt(ridge) * np.eye(matrix.shape[1])))
        orthogonal, self._root = np.linalg.qr(stacked)
        self._damping = DAMPING * float(np.linalg.norm(self._root, 2)) * np.eye(matrix.shape[1])
        self._project = orthogonal[: len(matrix)].T

    def solve(self, at: HysteresisState, rows: Floats, ahead: float, start: Floats) -> tuple[Floats, Floats]:
        """The command within the limits, at the state's time, whose response `ahead` s later is nearest to `rows` (M,).

        Args:
            start: (N,) signals to begin with, for instance those of the inverse without limits between neighbours.

        Returns:
            (N,) signals inside all limits, and (N,) the effective signals that they lead to.
        """
        wanted = self._project @ rows
        law, limits = self._law, self._limits

        def reached(signals: Floats) -> Floats:
            return law.effective_at(at, signals, ahead)

        def rise(signals: Floats) -> Floats:
            return (reached(signals + SLOPE_STEP) - reached(signals - SLOPE_STEP)) / (2.0 * SLOPE_STEP)

        def residual_norm(effective: Floats) -> float:
            return float(np.linalg.norm(self._root @ effective - wanted))

        signals = np.clip(start, limits.low, limits.high)
        effective, slope = reached(signals), rise(signals)
        least, damping = np.inf, self._damping  # the start may violate limits
        for _ in range(ROUNDS):
            programme = BoundedProgramme(np.vstack((self._root * slope, damping)), limits)
            straight = wanted - self._root @ (effective - slope * signals)
            found = programme.solve(np.concatenate((straight, damping @ signals)))
            step, there = found - signals, reached(found)
            gained = least - residual_norm(there)
            if gained > 0.0:
                signals, effective = found, there
                slope = rise(signals)
            else:
                # Actuators that turn within the step change their slopes: the chord of the whole step is more accurate.
                np.divide(there - effective, step, out=slope, where=np.abs(step) > SLOPE_STEP)
                half = signals + 0.5 * step
                if residual_norm(reached(half)) < least:
                    signals, effective = half, reached(half)
            least, damping = residual_norm(effective), damping * (DAMPING_LOWERED if gained > 0.0 else DAMPING_RAISED)
            if np.abs(step).max() <= CONVERGED or 0.0 < gained < GAINED * least:
                break
        return signals, effective


#: Number of random histories that show which range is always reachable, moves of each, and s between moves.
HISTORIES, HISTORY_MOVES, HISTORY_PAUSE_S = 400, 12, 600.0


def random_histories(
    law: HysteresisModel, low: float, high: float, rng: np.random.Generator, histories: int = HISTORIES
) -> Iterator[HysteresisState]:
    """States after random moves between `low` and `high`; together they cover at least `histories` actuators."""
    count = law.actuators or histories
    for _ in range(ceil(histories / count)):
        state = law.demagnetised(count, 0.0, 0.5 * (low + high))
        for _ in range(HISTORY_MOVES):
            state = law.move(state, rng.uniform(low, high, count), state.time + HISTORY_PAUSE_S)
        yield state
