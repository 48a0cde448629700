"""The piezo stacks: gains, hysteresis and creep, from signals to base displacements of the plate's springs.

What stacks differ in, and what they do beyond a rate-independent law and creep, is off by default.
"""

from dataclasses import dataclass

import numpy as np

from dm_simulation.mirror.hysteresis import Hysteresis
from dm_simulation.mirror.zernike import Array

#: Time constants of the part of a loop that lags behind fast moves, s, and how many of them a decade holds.
LAG_TIMES_S, LAG_PER_DECADE = np.geomspace(1e-3, 10.0, 13), 3
#: degC, and the length of a day, s.
ROOM, DAY_S = 20.0, 86400.0
#: Periods of the drift of a day, s.
DRIFT_PERIODS_S = np.array([86400.0, 7 * 3600.0, 3600.0])


@dataclass(frozen=True)
class PiezoConfig:
    """Properties of the stacks. Spreads are standard deviations between them, cut at three.

    Attributes:
        stroke: base displacement from signal -1 to +1, m.
        gain_spread: of the relative gains.
        law, hysteresis: see :class:`dm_simulation.mirror.hysteresis.Hysteresis`.
        hysteresis_spread: of the relative openings of the loops.
        creep: growth of a displacement step per decade of time, as a fraction of the step.
        creep_spread: of the relative creep.
        creep_fastest, creep_slowest, creep_per_decade: creep is that of first-order elements with time constants
            between both, s, so many per decade. The sum of three follows log t to 1 % of the creep rate in between.
        spectrum_spread: of the elements, common to all stacks, as a logarithm.
        creep_position: relative change of creep from mid range to signal 1.
        rate_dependence: share by which the loop widens with each decade of speed.
        stiffening: share of half the stroke that is lost at signals -1 and +1, in squares.
        drift: of the bases over a day, m.
        swing: of the temperature about ROOM over a day, K.
        warm_gain: relative change of all gains per K.
        warm_base: standard deviation of what the bases go by per K, m.
    """

    stroke: float = 8e-6
    gain_spread: float = 0.03
    law: str = "prandtl_ishlinskii"
    hysteresis: float = 0.10
    hysteresis_spread: float = 0.0
    creep: float = 0.01
    creep_spread: float = 0.0
    creep_fastest: float = 0.1
    creep_slowest: float = 1e5
    creep_per_decade: int = 3
    spectrum_spread: float = 0.0
    creep_position: float = 0.0
    rate_dependence: float = 0.0
    stiffening: float = 0.0
    drift: float = 0.0
    swing: float = 0.0
    warm_gain: float = 0.0
    warm_base: float = 0.0


#: Stacks of which each has a law, a loop and a creep of its own.
DRAWN = PiezoConfig(
    law="drawn_preisach",
    hysteresis_spread=0.15,
    creep_spread=0.1,
    spectrum_spread=0.2,
    swing=0.5,
    warm_gain=5e-4,
    warm_base=2e-9,
)


class PiezoActuators:
    """States of all stacks. Time is passed in (s, any origin) and never read from a clock.

    They start demagnetised at signal 0, driven to `initial` and rested there until all creep has died away.

    Attributes:
        gain: (N,) relative gains.
        stuck: (N,) bool, actuators that no longer follow.
        signals: (N,) that they follow.
    """

    def __init__(
        self,
        config: PiezoConfig,
        rng: np.random.Generator,
        initial: Array,
        time: float = 0.0,
    ) -> None:
        count = len(initial)

        def spread(share: float) -> Array:
            return 1 + share * np.clip(rng.standard_normal(count), -3, 3)

        self.config = config
        self.gain = spread(config.gain_spread)
        opening = config.hysteresis * spread(config.hysteresis_spread)
        decades = np.log10(config.creep_slowest / config.creep_fastest)
        elements = round(decades * config.creep_per_decade) + 1
        self._creep_times = np.geomspace(config.creep_fastest, config.creep_slowest, elements)
        spectrum = np.exp(config.spectrum_spread * rng.standard_normal(len(self._creep_times)))
        self._creep = config.creep / config.creep_per_decade * spectrum * spread(config.creep_spread)[:, None]
        self._drift = config.drift * rng.standard_normal((count, len(DRIFT_PERIODS_S))) * (1.0, 0.3, 0.1)
        self._drift_phase = rng.uniform(0, 2 * np.pi, (count, len(DRIFT_PERIODS_S)))
        self._hysteresis = Hysteresis(config.law, opening, count, rng)
        self.stuck = np.zeros(count, bool)
        self.signals = np.array(initial, float)
        self._position = self._hysteresis.move(self.signals)
        self._crept = np.repeat(self._position[:, None], len(self._creep_times), axis=1)
        self._lagged = np.repeat((self._position - self.signals)[:, None], len(LAG_TIMES_S), axis=1)
        self._time = time
        self._warm, self._noon = config.warm_base * rng.standard_normal(count), rng.uniform(0.0, 2.0 * np.pi)

    @property
    def temperature(self) -> float:
        """degC at the time last given."""
        return float(ROOM + self.config.swing * np.sin(2.0 * np.pi * self._time / DAY_S + self._noon))

    def advance(self, time: float) -> None:
        """Let creep go on until `time`. A clock that jumps back only moves the origin of time."""
        elapsed = time - self._time
        self._time = time
        if elapsed > 0:
            # Exact for a constant position, hence independent of how the time is cut into steps.
            self._crept += (self._position[:, None] - self._crept) * -np.expm1(-elapsed / self._creep_times)
            if self.config.rate_dependence:
                loop = (self._position - self.signals)[:, None]
                self._lagged += (loop - self._lagged) * -np.expm1(-elapsed / LAG_TIMES_S)

    def apply(self, signals: Array, time: float) -> None:
        """Take new signals (N,) at `time`."""
        self.advance(time)
        self.signals = np.where(self.stuck, self.signals, signals)
        self._position = self._hysteresis.move(self.signals)

    @property
    def displacement(self) -> Array:
        """Base displacements (N,), m, at the time last given."""
        config, position = self.config, self._position
        creep = (1 + config.creep_position * position) * np.einsum("nk,nk->n", self._creep, self._crept)
        lag = (position - self.signals)[:, None] - self._lagged
        moved = position + creep + config.rate_dependence / LAG_PER_DECADE * lag.sum(axis=1)
        moved = moved - config.stiffening * moved * np.abs(moved)
        turns = np.sin(2 * np.pi * self._time / DRIFT_PERIODS_S + self._drift_phase)
        warmer = self.temperature - ROOM
        gain = self.gain * (1.0 + config.warm_gain * warmer)
        return np.asarray(config.stroke / 2 * gain * moved + (self._drift * turns).sum(axis=1) + self._warm * warmer)
