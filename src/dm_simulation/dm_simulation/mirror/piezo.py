"""The piezo stacks: gain spread, hysteresis and creep, from signals to base displacements of the plate's springs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dm_simulation.mirror.hysteresis import Hysteresis
from dm_simulation.mirror.zernike import Array

#: Creep: first-order elements between these time constants (s), so many per decade. Their sum follows log t to 1 % of
#: the creep rate in between.
CREEP_FASTEST_S = 0.1
CREEP_SLOWEST_S = 1e5
CREEP_PER_DECADE = 3


@dataclass(frozen=True)
class PiezoConfig:
    """Properties of the stacks.

    Attributes:
        stroke: base displacement from signal -1 to +1, m.
        gain_spread: standard deviation of the relative gains (cut at three of them).
        law, hysteresis: see :class:`dm_simulation.mirror.hysteresis.Hysteresis`.
        creep: growth of a displacement step per decade of time, as a fraction of the step.
    """

    stroke: float = 8e-6
    gain_spread: float = 0.03
    law: str = "prandtl_ishlinskii"
    hysteresis: float = 0.10
    creep: float = 0.01


class PiezoActuators:
    """States of all stacks. Time is passed in (s, any origin) and never read from a clock.

    They start demagnetised at signal 0, driven to `initial` and rested there until all creep has died away.
    """

    def __init__(
        self,
        config: PiezoConfig,
        rng: np.random.Generator,
        initial: Array,
        time: float = 0.0,
    ) -> None:
        count = len(initial)
        self.config = config
        self.gain = 1 + config.gain_spread * np.clip(rng.standard_normal(count), -3, 3)
        self._hysteresis = Hysteresis(config.law, config.hysteresis, count)
        decades = np.log10(CREEP_SLOWEST_S / CREEP_FASTEST_S)
        self._tau = np.geomspace(CREEP_FASTEST_S, CREEP_SLOWEST_S, round(decades * CREEP_PER_DECADE) + 1)
        self.signals = np.array(initial, float)
        self._position = self._hysteresis.move(self.signals)
        self._crept = np.repeat(self._position[:, None], len(self._tau), axis=1)
        self._time = time

    def advance(self, time: float) -> None:
        """Let creep go on until `time`. A clock that jumps back only moves the origin of time."""
        elapsed = time - self._time
        self._time = time
        if elapsed > 0 and self.config.creep:
            # Exact for a constant position, hence independent of how the time is cut into steps.
            rest = np.exp(-elapsed / self._tau)
            self._crept += (self._position[:, None] - self._crept) * (1 - rest)

    def apply(self, signals: Array, time: float) -> None:
        """Take new signals (N,) at `time`."""
        self.advance(time)
        self.signals = np.array(signals, float)
        self._position = self._hysteresis.move(self.signals)

    @property
    def displacement(self) -> Array:
        """Base displacements (N,), m, at the time last given."""
        creep = self.config.creep / CREEP_PER_DECADE * (self._crept.sum(axis=1))
        return self.config.stroke / 2 * self.gain * (self._position + creep)
