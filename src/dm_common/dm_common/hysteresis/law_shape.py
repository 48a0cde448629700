"""Properties of a law over the whole range of the signals: its smallest slope, its reach, and its loops."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dm_common import Floats
from dm_common.hysteresis.duhem import FadingHysteresis, horner
from dm_common.hysteresis.inverse import pieces, random_histories
from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.limits import Limits

#: Points of a branch of a loop.
STEPS = 81
#: Number of signals at which slopes are evaluated, and of turning points from which moves to them begin.
PLACES = 41


def slope_min(law: HysteresisModel, low: float = -1.0, high: float = 1.0) -> Floats:
    """Smallest slope of the effective signal over `low` .. `high`, on any move, of each law, (1,) or (N,)."""
    return np.asarray(slopes(law, low, high).min(axis=(0, 2, 3)))


def slopes(law: HysteresisModel, low: float = -1.0, high: float = 1.0) -> Floats:
    """(2, 1 or N, S, R) slopes at S = PLACES signals from `low` to `high`, falling [0] and rising [1], for each
    number of play operators that have set in; infinite where that cannot be.

    After a turning point the operators set in one by one, narrow ones first. One of half-width r can only have set in
    where the range leaves room for a turning point 2 r back.
    """
    parts = pieces(law)
    signals = np.linspace(low, high, PLACES)
    behind = np.stack((high - signals, signals - low))[:, None, :, None]  # on a falling and on a rising move
    slope = horner(parts.derivative[..., None, :], signals[:, None])  # for each number of operators that have set in
    if parts.fading.size:
        slope = slope + _fading_slope(parts.fading, law.actuators or 1, signals, parts.radius)
    dead_zone = 0.0 if parts.radius[0] else np.inf  # slope 0 until a first operator sets in, if any does
    return np.asarray(np.where(2.0 * parts.radius <= behind, slope, dead_zone))


def _fading_slope(fading: FadingHysteresis, actuators: int, signals: Floats, radius: Floats) -> Floats:
    """(2, N, S, R) smallest slope of the Duhem part at `signals` (S,), on falling and rising moves that began, after
    full swings, with a turn at least 2 `radius` (R,) away; infinite where the range has no room for that.
    """
    count, step = len(signals), signals[1] - signals[0]
    apart = np.minimum((2.0 * radius / step).astype(int), count - 1)
    smallest = []
    for way in (-1, 1):
        met = signals[::way]
        states, at = np.zeros((actuators, fading.size)), np.full(actuators, met[0])
        for end in (met[-1], met[0], met[-1]):
            states, at = fading.move(states, at, np.full(actuators, end)), np.full(actuators, end)
        slopes = np.full((count, count, actuators), np.inf)  # indexed by steps since the turn, signal
        for turn in range(count):
            there = np.full(actuators, met[turn])
            onward = np.tile(met[turn:], (actuators, 1))
            slope = fading.along(fading.move(states, at, there), there, onward, np.array([[float(way)]]))[1]
            slopes[np.arange(count - turn), np.arange(turn, count)] = slope.T
        later = np.minimum.accumulate(slopes[::-1], axis=0)[::-1]
        smallest.append(later[apart][:, ::way])
    return np.stack(smallest).transpose(0, 3, 2, 1)


def span(law: HysteresisModel, low: float = -1.0, high: float = 1.0) -> Floats:
    """Effective signal at `high` minus that at `low` in a closed full cycle, of each law: (1,) or (N,)."""
    lower = turned(law, (high, low, high, low), 0.5 * (low + high))
    return np.asarray(law.move(lower, np.full_like(lower.signals, high), 0.0).position - lower.position)


def normalised(law: HysteresisModel, low: float = -1.0, high: float = 1.0) -> HysteresisModel:
    """The same law, scaled so that effective signals span as much as signals of `low` .. `high` in a full cycle."""
    return law.scaled((high - low) / span(law, low, high))


def worst_case_limits(law: HysteresisModel, limits: Limits) -> Limits:
    """Limits on effective signals that signals within `limits` reach whatever the history.

    Hysteresis and creep narrow the range; each end is the innermost one over random histories.
    """
    if law.is_identity:
        return limits
    ends: dict[float, list[Floats]] = {limits.low: [], limits.high: []}
    for state in random_histories(law, limits.low, limits.high, np.random.default_rng(0)):
        for end, reached in ends.items():
            reached.append(law.effective(law.move(state, np.full(len(state.signals), end), state.time)))
    low, high = float(np.max(ends[limits.low])), float(np.min(ends[limits.high]))
    share = min((high - low) / (limits.high - limits.low), 1.0)
    return replace(limits, low=low, high=high, neighbour_difference=share * limits.neighbour_difference)


def turned(law: HysteresisModel, turns: Sequence[float], middle: float = 0.0) -> HysteresisState:
    """The state after a degauss that ended at `middle` and straight moves of all actuators to each of `turns`.

    It has one actuator for each law: N if each actuator has its own law, else one.
    """
    state = law.demagnetised(law.actuators or 1, 0.0, middle)
    for turn in turns:
        state = law.move(state, np.full_like(state.signals, turn), 0.0)
    return state


def branch(
    law: HysteresisModel, state: HysteresisState, end: float, steps: int = STEPS
) -> tuple[Floats, Floats, HysteresisState]:
    """Signals (S,), static effective signals (S, N) and the last state on a straight move of all actuators to `end`."""
    signals = np.linspace(float(state.signals[0]), end, steps)
    positions = np.empty((steps, len(state.signals)))
    for step, signal in enumerate(signals):
        state = law.move(state, np.full_like(state.signals, signal), state.time)
        positions[step] = state.position
    return signals, positions, state


def closed_cycle(
    law: HysteresisModel, low: float = -1.0, high: float = 1.0, steps: int = STEPS
) -> tuple[Floats, Floats, Floats]:
    """Signals (S,) from `low` to `high`, and the static effective signals (S, N) there, rising and falling.

    N is the number of laws: that of the actuators if each has its own, else 1.
    """
    state = turned(law, (high, low), 0.5 * (low + high))
    signals, rising, state = branch(law, state, high, steps)
    return signals, rising, branch(law, state, low, steps)[1][::-1]


def opening(rising: Floats, falling: Floats) -> Floats:
    """(N,) largest distance between the branches (S, N) of a closed cycle, as a share of its span."""
    return np.asarray(np.abs(falling - rising).max(axis=0) / (rising[-1] - rising[0]))
