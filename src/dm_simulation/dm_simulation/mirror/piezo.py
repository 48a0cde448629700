"""The piezo stacks: gains, hysteresis and creep, from signals to base displacements of the plate's springs.

Differences between stacks, and effects beyond a rate-independent law and creep, are off by default.
"""

from dataclasses import dataclass

import numpy as np

from dm_common.values import parameter, real, text, whole
from dm_simulation.mirror.hysteresis import LAWS, Hysteresis
from dm_simulation.mirror.zernike import Array

#: Time constants of the part of a loop that lags behind fast moves, s, and their number per decade.
LAG_TIMES_S, LAG_PER_DECADE = np.geomspace(1e-3, 10.0, 13), 3
#: Room temperature, degC, and length of a day, s.
ROOM, DAY_S = 20.0, 86400.0
#: Periods of the components of the daily drift, s.
DRIFT_PERIODS_S = np.array([86400.0, 7 * 3600.0, 3600.0])


@dataclass(frozen=True)
class PiezoConfig:
    """Properties of the stacks. Spreads are standard deviations between them, cut at three."""

    stroke: float = parameter(
        real(8e-6, 0.0, 1e-3, "m"), "Stroke of a stack, displacement of its base, from signal -1 to +1."
    )
    gain_spread: float = parameter(real(0.03, 0.0, 0.3), "Standard deviation of relative gains.")
    law: str = parameter(
        text("prandtl_ishlinskii", choices=tuple(LAWS)), "Hysteresis law; drawn_* = each actuator its own, by the seed."
    )
    hysteresis: float = parameter(
        real(0.10, 0.0, 0.3),
        "Largest opening of the full loop, as a fraction of the stroke; drawn laws: at most 0.8 of what each can have.",
    )
    hysteresis_spread: float = parameter(real(0.0, 0.0, 0.3), "Spread of relative loop openings.")
    creep: float = parameter(real(0.01, 0.0, 0.1), "Creep of a step per decade of time, as a fraction of the step.")
    creep_spread: float = parameter(real(0.0, 0.0, 0.3), "Spread of relative creep.")
    creep_fastest: float = parameter(
        real(0.1, 1e-3, 1e6, "s"), "Time constant of the fastest first-order creep element."
    )
    creep_slowest: float = parameter(real(1e5, 1e-3, 1e7, "s"), "Time constant of the slowest creep element.")
    creep_per_decade: int = parameter(
        whole(3, 1, 10), "Creep elements per decade of time; the sum of three follows log t to 1 % of the creep rate."
    )
    spectrum_spread: float = parameter(real(0.0, 0.0, 1.0), "Spread of creep elements' log weights, common to stacks.")
    creep_position: float = parameter(real(0.0, -0.5, 0.5), "Relative change of creep from mid range to signal 1.")
    rate_dependence: float = parameter(real(0.0, 0.0, 0.1), "Widening of loops per decade of speed.")
    crosstalk: float = parameter(
        real(0.0, 0.0, 0.1), "Share of the next actuator's signal that an actuator picks up, standard deviation."
    )
    stiffening: float = parameter(
        real(0.0, 0.0, 0.2), "Share of half the stroke lost at signals -1 and +1; grows as displacement squared."
    )
    drift: float = parameter(real(0.0, 0.0, 1e-7, "m"), "Drift of the bases over a day.")
    swing: float = parameter(real(0.0, 0.0, 20.0, "K"), "Amplitude of the daily temperature cycle about 20 degC.")
    warm_gain: float = parameter(real(0.0, -0.01, 0.01, "1/K"), "Relative change of all gains per kelvin.")
    warm_base: float = parameter(real(0.0, 0.0, 1e-7, "m/K"), "Standard deviation of the bases' shift per kelvin.")


#: Stacks that differ from each other in law, loop and creep.
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
        signals: (N,) signals that they follow, with crosstalk.
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

        if config.creep_fastest > config.creep_slowest:
            raise ValueError(
                f"piezo.creep_fastest = {config.creep_fastest:g} s: must not exceed piezo.creep_slowest, "
                f"{config.creep_slowest:g} s"
            )
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
        self._warm, self._noon = config.warm_base * rng.standard_normal(count), rng.uniform(0.0, 2.0 * np.pi)
        self._crosstalk = config.crosstalk * rng.standard_normal(count)
        self.signals = self._with_crosstalk(np.array(initial, float))
        self._position = self._hysteresis.move(self.signals)
        self._crept = np.repeat(self._position[:, None], len(self._creep_times), axis=1)
        self._lagged = np.repeat((self._position - self.signals)[:, None], len(LAG_TIMES_S), axis=1)
        self._time = self._began = time

    def _with_crosstalk(self, signals: Array) -> Array:
        return signals + self._crosstalk * np.roll(signals, -1)

    @property
    def _age(self) -> float:
        """s since the start, so that results follow from the seed whatever the time of day."""
        return self._time - self._began

    @property
    def temperature(self) -> float:
        """degC at the time last given."""
        return float(ROOM + self.config.swing * np.sin(2.0 * np.pi * self._age / DAY_S + self._noon))

    def advance(self, time: float) -> None:
        """Let creep go on until `time`. A clock that jumps back only moves the origin of time."""
        elapsed = time - self._time
        self._began += min(elapsed, 0.0)
        self._time = time
        if elapsed > 0:
            # Exact for a constant position, hence independent of how the time is divided into steps.
            self._crept += (self._position[:, None] - self._crept) * -np.expm1(-elapsed / self._creep_times)
            if self.config.rate_dependence:
                loop = (self._position - self.signals)[:, None]
                self._lagged += (loop - self._lagged) * -np.expm1(-elapsed / LAG_TIMES_S)

    def apply(self, signals: Array, time: float) -> None:
        """Take new signals (N,) at `time`."""
        self.advance(time)
        self.signals = np.where(self.stuck, self.signals, self._with_crosstalk(signals))
        self._position = self._hysteresis.move(self.signals)

    @property
    def displacement(self) -> Array:
        """Base displacements (N,), m, at the time last given."""
        config, position = self.config, self._position
        creep = (1 + config.creep_position * position) * np.einsum("nk,nk->n", self._creep, self._crept)
        lag = (position - self.signals)[:, None] - self._lagged
        moved = position + creep + config.rate_dependence / LAG_PER_DECADE * lag.sum(axis=1)
        moved = moved - config.stiffening * moved * np.abs(moved)
        turns = np.sin(2 * np.pi * self._age / DRIFT_PERIODS_S + self._drift_phase)
        warmer = self.temperature - ROOM
        gain = self.gain * (1.0 + config.warm_gain * warmer)
        return np.asarray(config.stroke / 2 * gain * moved + (self._drift * turns).sum(axis=1) + self._warm * warmer)
