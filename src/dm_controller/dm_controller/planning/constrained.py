"""Commands where the limits bind: the limits are those of the signals, the shape is that of the effective signals.

What a signal does depends on where the actuator stands, so a limit on signals is another limit on effective signals for
every state. The programme is solved for signals, with the law taken as straight about the last solution (sequential
quadratic programming): a few rounds end where the next one changes nothing. Each round ends inside the limits, so what
comes out is always legal, and it is the nearest legal shape, not a part of the way to one that is not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dm_common.bounded import BoundedProgramme
from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.limits import Limits

Floats = NDArray[np.float64]

#: What neighbours stay below their limit: one step of a 16-bit DAC, since each of the two is rounded.
DAC_STEP = 2.0**-15
#: Rounds of the programme, and the change of a signal at which it ends.
ROUNDS, CONVERGED = 8, 1e-6
#: Half the step that the slope of the law is taken over.
SLOPE_STEP = 1e-4


@dataclass(frozen=True, eq=False)
class Constrained:
    """A legal command.

    Attributes:
        signals: (N,) inside all limits.
        effective: (N,) effective signals that it leads to.
    """

    signals: Floats
    effective: Floats


def within(limits: Limits) -> Limits:
    """`limits` with room for the rounding of the electronics."""
    return replace(limits, neighbour_difference=max(limits.neighbour_difference - DAC_STEP, 0.5 * DAC_STEP))


class ConstrainedInverse:
    """Nearest legal commands on one mirror.

    Args:
        law: of its actuators.
        limits: of the signals.
        matrix: (M, N) what a unit of each effective signal does, in the rows that are to be met.
        ridge: weight of the squared effective signals, in the squared unit of `matrix`.
    """

    def __init__(self, law: HysteresisModel, limits: Limits, matrix: Floats, ridge: float) -> None:
        self._law, self._limits = law, limits
        stacked = np.vstack((matrix, np.sqrt(ridge) * np.eye(matrix.shape[1])))
        orthogonal, self._root = np.linalg.qr(stacked)
        self._project = orthogonal[: len(matrix)].T

    def solve(self, at: HysteresisState, rows: Floats, ahead: float, start: Floats) -> Constrained:
        """The legal command at the state's time whose rows, `ahead` s later, come nearest to `rows` (M,).

        Args:
            start: (N,) signals to begin with, for instance those of the inverse without limits between neighbours.
        """
        wanted = self._project @ rows
        law, limits = self._law, self._limits
        rest = np.exp(-ahead / law.creep_time)
        growth = 1.0 + law.creep_share @ (1.0 - rest)  # of a step taken now, until it counts
        crept = (law.creep_share * at.crept) @ rest
        signals = np.clip(start, limits.low, limits.high)
        for _ in range(ROUNDS):
            reached = growth * law.position_at(at, signals) + crept
            rise = law.position_at(at, signals + SLOPE_STEP) - law.position_at(at, signals - SLOPE_STEP)
            slope = growth * rise / (2.0 * SLOPE_STEP)
            programme = BoundedProgramme(self._root * slope, limits)
            before = signals
            signals = programme.solve(wanted - self._root @ (reached - slope * signals))
            if np.abs(signals - before).max() <= CONVERGED:
                break
        return Constrained(signals, growth * law.position_at(at, signals) + crept)
