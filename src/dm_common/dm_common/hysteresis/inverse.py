"""The inverse of the memory law: which signals bring about wanted effective signals, from where the mirror stands.

On a straight way the play operators set in one after another, and between two of these places the law is a polynomial
in the signal. Its value at all places tells the piece that holds the solution, Newton's method finds it there. The work
grows with actuators times operators.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import comb

import numpy as np
from numpy.typing import NDArray

from dm_common.hysteresis.duhem import DuhemOperator
from dm_common.hysteresis.model import HysteresisModel, HysteresisState

Floats = NDArray[np.float64]

#: Effective signals are met to this; a DAC step is three hundred times as large.
TOLERANCE = 1e-7
ROUNDS_MAX = 60
#: Newton's step never divides by less; laws that can be inverted are steeper by far.
SLOPE_MIN = 1e-3


@dataclass(frozen=True, eq=False)
class Inverted:
    """A command for wanted effective signals.

    Attributes:
        signals: (N,) inside the limits.
        missed: (N,) wanted less reached effective signals: 0 but where a limit was met.
    """

    signals: Floats
    missed: Floats


def invert(
    law: HysteresisModel, state: HysteresisState, effective: Floats, low: float, high: float, ahead: float = 0.0
) -> Inverted:
    """Signals (N,) within `low` .. `high`, applied at the state's time, for `effective` (N,) `ahead` seconds later.

    The law rises with the signal on every way, so each actuator has one solution.

    Raises:
        ValueError: `effective` has another length than the mirror actuators, or is not finite.
    """
    if effective.shape != state.signals.shape or not np.isfinite(effective).all():
        raise ValueError(f"effective signals: must be {len(state.signals)} finite numbers")
    if not law.remembers:
        signals = np.clip(effective, low, high)
        return Inverted(signals, effective - signals)
    wanted = law.position_for(state, effective, ahead)
    inverted = pieces(law).solve(state, wanted, low, high)
    limited = inverted.missed != 0.0
    if not limited.any():
        return inverted
    # A limit may lie before the place where the piece begins that the solution would need.
    missed = np.where(limited, wanted - law.position_at(state, inverted.signals), 0.0)
    return Inverted(inverted.signals, missed)


class Pieces:
    """The polynomials of one law on a rising and on a falling way.

    Attributes:
        radius: (R,) half-widths, rising.
        polynomial: (D + 1, 2, 1 or N, R) coefficients by rising power of the sum over the operators 0 .. k that have
            set in, on a falling [0] and on a rising [1] way; of all actuators, or of each.
        single: (D + 1, 1 or N, R) the same of each operator alone, in its own value.
        order: that sorts the law's operators; None = they are sorted.
        duhem, duhem_weight, duhem_slope: the Duhem operator, None = none; its weight () or (N,), and the polynomial of
            its slope in its value.
    """

    def __init__(self, law: HysteresisModel) -> None:
        order = np.argsort(law.play_radius, kind="stable")
        self.order = None if (np.diff(order) == 1).all() else order
        self.radius = law.play_radius[order]
        weight = np.moveaxis(law.play_weight.reshape(-1, *law.play_weight.shape[-2:])[:, order], 2, 0)
        self.single = np.concatenate((np.zeros((1, *weight.shape[1:])), weight))
        powers = len(self.single)
        self.polynomial = np.zeros((powers, 2, *weight.shape[1:]))
        for way, sign in enumerate((-1.0, 1.0)):
            # What has set in follows the signal at the distance of its half-width: (s - sign r)^power.
            for power in range(powers):
                for low in range(power + 1):
                    self.polynomial[low, way] += (
                        comb(power, low) * (-sign * self.radius) ** (power - low) * self.single[power]
                    )
        self.polynomial = self.polynomial.cumsum(axis=-1)
        self.duhem = DuhemOperator(law.duhem_slope) if law.duhem_slope.size else None
        self.duhem_weight = np.asarray(law.duhem_weight, dtype=np.float64)
        self.duhem_slope = np.concatenate(([1.0], -law.duhem_slope, [0.0]))
        self.powers = np.arange(1.0, powers)[:, None]

    def solve(self, state: HysteresisState, wanted: Floats, low: float, high: float) -> Inverted:
        """Signals for the static effective signals `wanted` (N,)."""
        rising = wanted >= state.position
        way, sign = rising.astype(np.intp), np.where(rising, 1.0, -1.0)
        if len(self.radius) == 1 and self.radius[0] == 0.0:  # no play: one piece, which begins where the mirror stands
            start = np.minimum(np.maximum(state.signals + (wanted - state.position), low), high)
            near, far = np.where(rising, state.signals, low), np.where(rising, high, state.signals)
            polynomial, none = self.polynomial[:, 0, :, 0], np.zeros(1)
            return self._newton(
                state, wanted, sign, polynomial, none, start, np.maximum(near, low), np.minimum(far, high)
            )
        play = state.play if self.order is None else state.play[:, self.order]
        value = horner(self.single, play)
        waiting = value.sum(axis=1)[:, None] - value.cumsum(axis=1)  # operators that have not set in yet
        onset = play + sign[:, None] * self.radius
        rows = np.arange(len(wanted))
        laws = rows if self.polynomial.shape[2] > 1 else np.zeros_like(rows)
        at_onset = horner(self.polynomial[:, way, laws], onset) + waiting
        if self.duhem is not None:
            change = onset - state.signals[:, None]
            at_onset += self.duhem_weight[..., None] * self.duhem.move(state.fading[:, None], change)
        still = sign[:, None] * (wanted[:, None] - at_onset)
        last = len(self.radius) - 1
        piece = np.maximum(np.count_nonzero(still >= 0.0, axis=1) - 1, 0)
        following = np.minimum(piece + 1, last)
        polynomial, fixed = self.polynomial[:, way, laws, piece], waiting[rows, piece]
        begin, end = onset[rows, piece], np.where(piece < last, onset[rows, following], np.where(rising, high, low))
        # The chord of a narrow piece comes close; beyond the last place the slope is about 1.
        before, after = still[rows, piece], still[rows, following]
        chord = np.where(before > after, (end - begin) / np.where(before > after, before - after, 1.0), sign)
        near, far = np.minimum(begin, end), np.maximum(begin, end)
        start = np.minimum(np.maximum(begin + chord * before, low), high)
        return self._newton(state, wanted, sign, polynomial, fixed, start, np.maximum(near, low), np.minimum(far, high))

    def _newton(
        self,
        state: HysteresisState,
        wanted: Floats,
        sign: Floats,
        polynomial: Floats,
        fixed: Floats,
        signals: Floats,
        low: Floats,
        high: Floats,
    ) -> Inverted:
        """The root between `low` and `high` (N,) of what rises there, or the end that comes nearest to it."""
        derivative = polynomial[1:] * self.powers
        gap = wanted
        for _ in range(ROUNDS_MAX):
            value = horner(polynomial, signals) + fixed
            slope = horner(derivative, signals) if len(derivative) > 1 else derivative[0]
            if self.duhem is not None:
                fading = self.duhem.move(state.fading, signals - state.signals)
                value += self.duhem_weight * fading
                slope = slope + self.duhem_weight * horner(self.duhem_slope, sign * fading)
            gap = value - wanted
            below = gap < 0.0
            low, high = np.where(below, signals, low), np.where(below, high, signals)
            step = np.minimum(np.maximum(signals - gap / np.maximum(slope, SLOPE_MIN), low), high)
            if np.abs(step - signals).max() <= TOLERANCE:
                break
            signals = step
        return Inverted(signals, np.where(np.abs(gap) <= 2.0 * TOLERANCE, 0.0, -gap))


#: A law never changes, so what is worked out from it is kept.
pieces = lru_cache(maxsize=8)(Pieces)


def horner(coefficients: Floats, x: Floats) -> Floats:
    """Polynomials with `coefficients` (D + 1, ...) by rising power, D > 0, at x (...)."""
    total = coefficients[-1] * x + coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        total = total * x + coefficient
    return np.asarray(total)
