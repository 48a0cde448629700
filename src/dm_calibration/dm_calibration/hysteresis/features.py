"""The effective signal as a sum of features of the commands, linear in the weights that are to be identified."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dm_common.hysteresis.duhem import DuhemOperator
from dm_common.hysteresis.model import CREEP_TIMES

Floats = NDArray[np.float64]


def play_features(signals: Floats, radius: Floats, powers: int) -> Floats:
    """Powers of the values of play operators along a sequence that begins demagnetised.

    Args:
        signals: (M, N).
        radius: (R,) half-widths.
        powers: D.

    Returns:
        (M, R D, N), the powers of one half-width beside each other.
    """
    count, actuators = signals.shape
    half_width = radius[:, None]
    play = np.zeros((len(radius), actuators))
    values = np.empty((count, len(radius), actuators))
    for row, shape in enumerate(signals):
        play = np.clip(play, shape - half_width, shape + half_width)
        values[row] = play
    stacked = np.stack([values**power for power in range(1, powers + 1)], axis=2)
    return stacked.reshape(count, len(radius) * powers, actuators)


def fading_feature(signals: Floats, operator: DuhemOperator) -> Floats:
    """(M, 1, N) values of a Duhem operator along `signals` (M, N), which begin at 0 demagnetised."""
    z, last = np.zeros(signals.shape[1]), np.zeros(signals.shape[1])
    values = np.empty((len(signals), 1, signals.shape[1]))
    for row, shape in enumerate(signals):
        z = operator.move(z, shape - last)
        values[row, 0], last = z, shape
    return values


def crept(features: Floats, time: Floats, start: float, moved: Floats | None = None) -> Floats:
    """What creep adds to features (M, F, N) per unit of creep rate, seen at `time` (M,) s; all before `start` was 0.

    Args:
        moved: (M,) s, when each row began to stand, between the looks; None = right after the look before.
    """
    element = CREEP_TIMES[:, None, None]
    state = np.zeros((len(CREEP_TIMES), *features.shape[1:]))
    result = np.empty_like(features)
    moved = np.concatenate(([start], time[:-1])) if moved is None else np.maximum(moved, start)
    still = np.exp(-np.diff(np.column_stack((moved, time)).ravel(), prepend=start)[:, None] / CREEP_TIMES)
    before = np.zeros(features.shape[1:])
    for row, now in enumerate(features):
        state = before + (state - before) * still[2 * row].reshape(element.shape)
        state = now + (state - now) * still[2 * row + 1].reshape(element.shape)
        result[row], before = state.sum(axis=0), now
    return result * _per_element()


def relaxation(time: Floats, start: float) -> Floats:
    """(M,) how much of an old displacement's creep is still to fade at `time` (s) when it ended at `start`."""
    return np.asarray(np.exp(-(time[:, None] - start) / CREEP_TIMES).sum(axis=1) * _per_element())


def _per_element() -> float:
    return float(np.log10(CREEP_TIMES[-1] / CREEP_TIMES[0])) / (len(CREEP_TIMES) - 1)
