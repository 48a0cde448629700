"""Loops of a law without creep, as pages and reports draw them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dm_common.hysteresis.model import HysteresisModel, HysteresisState

Floats = NDArray[np.float64]

#: Points of a way from one turning point to the next.
STEPS = 81


def rested(law: HysteresisModel, middle: float = 0.0) -> HysteresisState:
    """The state after a degauss of as many actuators as have laws of their own, or of one."""
    return law.demagnetised(law.actuators or 1, 0.0, middle)


def branch(
    law: HysteresisModel, state: HysteresisState, end: float, steps: int = STEPS
) -> tuple[Floats, Floats, HysteresisState]:
    """Signals (S,), static effective signals (S, N) and the last state on a straight way of all actuators to `end`."""
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

    N is the number of actuators that have laws of their own, or 1.
    """
    state = rested(law, 0.5 * (low + high))
    for turn in (high, low):
        state = branch(law, state, turn, 2)[2]
    signals, rising, state = branch(law, state, high, steps)
    return signals, rising, branch(law, state, low, steps)[1][::-1]


def opening(rising: Floats, falling: Floats) -> Floats:
    """(N,) largest distance of the branches (S, N) of a closed cycle, as a share of its span."""
    return np.asarray(np.abs(falling - rising).max(axis=0) / (rising[-1] - rising[0]))
