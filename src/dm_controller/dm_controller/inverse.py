"""The inverse of the memory law: which signals bring about wanted effective signals, from where the mirror stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dm_calibration.memory.law import MemoryLaw, MemoryState

Floats = NDArray[np.float64]

#: Effective signals are met to this; a DAC step is a thousand times as large.
TOLERANCE = 1e-8
ROUNDS_MAX = 60


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
    law: MemoryLaw, state: MemoryState, effective: Floats, low: float, high: float, ahead: float = 0.0
) -> Inverted:
    """Signals (N,) within `low` .. `high`, applied at the state's time, for `effective` (N,) `ahead` seconds later.

    The law rises with the signal on every way, so each actuator has one solution. All are sought at once by the
    regula falsi with the Illinois rule (Dowell & Jarratt, BIT 11, 1971), which keeps it between two bounds.

    Raises:
        ValueError: `effective` has another length than the mirror actuators, or is not finite.
    """
    if effective.shape != state.signals.shape or not np.isfinite(effective).all():
        raise ValueError(f"effective signals: must be {len(state.signals)} finite numbers")
    if not law.remembers:
        signals = np.clip(effective, low, high)
        return Inverted(signals, effective - signals)
    wanted = law.position_for(state, effective, ahead)
    # One end of the bracket is where the mirror stands, the other the limit on the wanted side.
    rising = wanted >= state.position
    near, near_gap = np.clip(state.signals, low, high), state.position - wanted
    far = np.where(rising, high, low)
    far_gap = law.position_at(state, far) - wanted
    beyond = np.where(rising, far_gap <= 0.0, far_gap >= 0.0)
    near_gap = np.where(beyond, 0.0, near_gap)
    signals, gap = near, near_gap
    for _ in range(ROUNDS_MAX):
        width = near_gap - far_gap
        signals = near - near_gap * (near - far) / np.where(width == 0.0, 1.0, width)
        signals = np.where(beyond, far, signals)
        gap = law.position_at(state, signals) - wanted
        if np.abs(np.where(beyond, 0.0, gap)).max() <= TOLERANCE:
            break
        kept = gap * far_gap < 0.0  # the solution lies between the new point and the far end
        near_gap = np.where(kept, far_gap, 0.5 * near_gap)
        near = np.where(kept, far, near)
        far, far_gap = signals, gap
    return Inverted(signals, np.where(beyond, -gap, 0.0))
