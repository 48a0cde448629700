"""Mirrors drawn at random from a seed, with their hysteresis law, parameters, and what happens to them later."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dm_simulation.interferometer.interferometer import InterferometerConfig
from dm_simulation.mirror.piezo import PiezoConfig
from dm_simulation.mirror.plate import PlateConfig
from studies.comparison.simulated_bench import SimulationConfig

#: Laws to draw from, with their probabilities.
LAWS = {
    "drawn_preisach": 0.3,
    "drawn_unlike": 0.15,
    "drawn_mixed": 0.2,
    "drawn_bouc_wen": 0.15,
    "drawn_jiles_atherton": 0.2,
}
#: Largest difference between neighbours as shipped, see pdm_driver's `limits.neighbour_difference`.
SHIPPED_NEIGHBOUR_DIFFERENCE = 1.0
#: Creep of few elements, a decade apart: first and last time constant, s.
FEW_ELEMENTS_S = (0.3, 300.0)
#: What may happen after the calibration, with probabilities.
GAIN_STEP, DIES, NOTHING = "gain step", "actuator dies", ""
EVENTS = {NOTHING: 0.8, GAIN_STEP: 0.1, DIES: 0.1}
#: Relative change of all gains in a gain step.
GAIN_STEP_SHARE = 0.002


@dataclass(frozen=True)
class DrawnMirror:
    """A mirror, and what happens to it after its calibration.

    Attributes:
        simulation: the mirror.
        event: NOTHING, GAIN_STEP or DIES, after the calibration.
        held_before: a shape was held for a day before the calibration, then the power was off.
    """

    simulation: SimulationConfig
    event: str
    held_before: bool

    @property
    def changes(self) -> bool:
        """Whether the mirror changes after its calibration."""
        return self.event != NOTHING

    def description(self) -> str:
        """The mirror in one line."""
        config, piezo, instrument = self.simulation, self.simulation.piezo, self.simulation.instrument
        parts = [
            config.law.removeprefix("drawn_").replace("_", "-"),
            f"loop {config.hysteresis:.0%} ± {piezo.hysteresis_spread:.0%}",
            f"creep {config.creep:.1%}" + (" (4 elements)" if piezo.creep_per_decade == 1 else ""),
            f"figure {1e9 * instrument.figure_rms:.0f} nm",
            f"noise {1e9 * instrument.pixel_noise:.1f} nm",
        ]
        for name, share in (
            ("creep with position", piezo.creep_position),
            ("rate", piezo.rate_dependence),
            ("stiffening", piezo.stiffening),
            ("crosstalk", piezo.crosstalk),
        ):
            if share:
                parts.append(f"{name} {share:.1%}")
        if instrument.noise_time:
            parts.append(f"lasting {instrument.noise_time:.0f} s")
        if piezo.swing:
            parts.append(f"{piezo.swing:.1f} K a day")
        if piezo.drift:
            parts.append(f"drift {1e9 * piezo.drift:.1f} nm")
        if self.held_before:
            parts.append("held before")
        return ", ".join([*parts, self.event] if self.event else parts)


def draw_mirror(seed: int, pixels: int = 236) -> DrawnMirror:
    """The mirror of a seed."""
    rng = np.random.default_rng([seed, 14])

    def sometimes(low: float, high: float) -> float:
        """Uniform between both for every other mirror, else 0."""
        value = float(rng.uniform(low, high))
        return value if rng.random() < 0.5 else 0.0

    few = rng.random() < 0.3
    rate = float(rng.uniform(0.006, 0.014))
    elements = PiezoConfig()
    if few:
        fastest, slowest = FEW_ELEMENTS_S
        elements = replace(elements, creep_fastest=fastest, creep_slowest=slowest, creep_per_decade=1)
    piezo = replace(
        elements,
        gain_spread=0.03,
        hysteresis_spread=float(rng.uniform(0.1, 0.2)),
        creep_spread=0.1,
        spectrum_spread=0.2 if few else 0.3,
        creep_position=sometimes(-0.2, 0.2),
        rate_dependence=sometimes(0.0, 0.03),
        stiffening=sometimes(0.0, 0.03),
        drift=sometimes(0.0, 2e-9),
    )
    instrument = InterferometerConfig(
        figure_rms=float(np.exp(rng.uniform(np.log(40e-9), np.log(500e-9)))),
        pixel_noise=float(rng.uniform(0.5e-9, 3e-9)),
        low_order_noise=float(rng.uniform(0.2e-9, 0.5e-9)),
    )
    plate = PlateConfig(
        thickness=2.4e-3 * float(rng.uniform(0.9, 1.1)), spring_stiffness=2e7 * float(rng.uniform(0.7, 1.4))
    )
    simulation = SimulationConfig(
        law=str(rng.choice(list(LAWS), p=list(LAWS.values()))),
        seed=seed,
        hysteresis=float(rng.uniform(0.06, 0.14)),
        creep=rate,
        piezo=piezo,
        plate=plate,
        instrument=instrument,
        pixels=pixels,
        neighbour_difference=SHIPPED_NEIGHBOUR_DIFFERENCE,
    )
    event = str(rng.choice(list(EVENTS), p=list(EVENTS.values())))
    held_before = bool(rng.random() < 0.5)
    simulation = replace(
        simulation,
        piezo=replace(piezo, crosstalk=sometimes(0.0, 0.01), swing=sometimes(0.0, 1.0), warm_gain=5e-4, warm_base=2e-9),
        instrument=replace(instrument, noise_time=sometimes(1.0, 60.0)),
    )
    return DrawnMirror(simulation, event, held_before)
