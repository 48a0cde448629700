"""Parameters of a simulation and of its operation."""

from __future__ import annotations

from dataclasses import dataclass, field

from dm_simulation.interferometer.interferometer import InterferometerConfig
from dm_simulation.mirror.piezo import PiezoConfig
from dm_simulation.mirror.plate import PlateConfig


@dataclass(frozen=True)
class SimulationConfig:
    """Parameters of a simulation and of its operation.

    Attributes:
        law: hysteresis law, one of dm_simulation's.
        seed: of gains, figure and noise, and of laws that are drawn.
        hysteresis: loop opening as a share of the stroke.
        creep: per decade of time.
        piezo, plate, instrument: all other parameters of the stacks, the plate and the interferometer, not its camera.
        pixels: the camera has pixels x pixels. A small one is quicker, and its terms are hardly noisier: the low-order
            noise of an interferometer does not average out over pixels.
        samples: sampling points.
        settle_time: between command and map, s.
        exposure: one map takes this long, s.
        degauss_steps: half-swings of a degauss.
        neighbour_difference: largest difference between neighbours, normalised.
    """

    law: str = "prandtl_ishlinskii"
    seed: int = 1
    hysteresis: float = 0.10
    creep: float = 0.01
    piezo: PiezoConfig = field(default_factory=PiezoConfig)
    plate: PlateConfig = field(default_factory=PlateConfig)
    instrument: InterferometerConfig = field(default_factory=InterferometerConfig)
    pixels: int = 236
    samples: int = 500
    settle_time: float = 0.5
    exposure: float = 0.5
    degauss_steps: int = 100
    neighbour_difference: float = 2.0

    def __post_init__(self) -> None:
        if self.pixels < 64:
            raise ValueError(f"pixels = {self.pixels}: must be at least 64, or the terms cannot be told apart well")
        for name in ("settle_time", "exposure"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} = {getattr(self, name)} s: must not be negative")
        if self.degauss_steps < 1:
            raise ValueError(f"degauss_steps = {self.degauss_steps}: must be at least 1")
