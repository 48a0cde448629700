"""All that the page shows, measured: on the standard bench, with ideal actuators, and on further simulations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from dm_common import Floats
from dm_controller.planning.target import FocusTarget
from studies.comparison.simulated_bench import SimulationConfig
from studies.paper.control import (
    LINEAR_READINGS,
    METHODS,
    READINGS,
    Series,
    aspheres,
    branch_spread,
    fitting_limit,
    run_series,
    spheres,
)
from studies.paper.regressions import Regressions, regress_samples, relative_errors_on
from studies.paper.reported import CURVATURE_RANGE
from studies.paper.samples import Samples, measure_samples
from studies.paper.sampling_study import SamplingStudy, study_samples

STANDARD, IDEAL = "standard bench", "ideal actuators"
#: Hysteresis laws that the play operators of the regression do not contain as a special case.
FOREIGN_LAWS = ("preisach", "bouc_wen")
#: Methods by which the aspheres are controlled.
ASPHERE_METHODS = ("AZreg", "AZWreg")
#: Method by which the spheres are controlled on simulations of foreign laws.
LAW_METHOD = "AZreg"
#: Readings on each bench: ideal actuators have no hysteresis.
READINGS_ON = MappingProxyType({STANDARD: READINGS, IDEAL: LINEAR_READINGS})


@dataclass(frozen=True)
class PaperOptions:
    """How much to run.

    Attributes:
        bench: the standard bench, its seed included.
        spheres: number of spheres over the range of curvature.
        seeds: number of further simulations for Table 3, with the seeds that follow the bench's; with small cameras.
        shuffles: number of shuffles of the regression's responses.
        foreign_laws: whether Table 3 and the spheres are tried on other hysteresis laws too.
    """

    bench: SimulationConfig
    spheres: int = 11
    seeds: int = 5
    shuffles: int = 200
    foreign_laws: bool = True

    def __post_init__(self) -> None:
        if self.spheres < 3:
            raise ValueError(f"spheres = {self.spheres}: must be at least 3, the ends of the range and its middle")
        if self.seeds < 1:
            raise ValueError(f"seeds = {self.seeds}: must be at least 1")
        if self.shuffles < 1:
            raise ValueError(f"shuffles = {self.shuffles}: must be at least 1")

    @classmethod
    def full(cls, seed: int) -> PaperOptions:
        """The full run, from which the page is made."""
        return cls(SimulationConfig(seed=seed, pixels=944))

    @classmethod
    def quick(cls, seed: int) -> PaperOptions:
        """Everything once, on a small camera with few sampling points."""
        return cls(
            SimulationConfig(seed=seed, pixels=118, samples=200), spheres=5, seeds=1, shuffles=20, foreign_laws=False
        )

    @property
    def steps(self) -> int:
        """Steps that `measure` reports."""
        series = sum(len(METHODS) * len(readings) + len(ASPHERE_METHODS) for readings in READINGS_ON.values())
        return 2 * len(READINGS_ON) + series + 1 + self.seeds + (2 * len(FOREIGN_LAWS) if self.foreign_laws else 0)


@dataclass(frozen=True, eq=False)
class BenchResults:
    """One simulation.

    Attributes:
        spheres: by method and reading.
        aspheres: by method, in the reading "measured".
        branch_spread: m, see :func:`~studies.paper.control.branch_spread`.
        limit_rms: m, smallest rms sag error of the strongest sphere that the model predicts inside the limits.
    """

    samples: Samples
    regressions: Regressions
    spheres: dict[tuple[str, str], Series]
    aspheres: dict[str, Series]
    branch_spread: float
    limit_rms: float


@dataclass(frozen=True, eq=False)
class Results:
    """Results of all experiments.

    Attributes:
        benches: STANDARD and IDEAL.
        seeds: of the further simulations.
        over_seeds: (B, S) RelErr of the test surfaces on them, by model.
        over_laws: (S,) the same on one simulation of each foreign law, by law and model.
        law_spheres: the spheres by LAW_METHOD on such simulations, by law and reading.
        sampling: errors of the ways to sample a map, on the standard bench.
    """

    options: PaperOptions
    benches: dict[str, BenchResults]
    seeds: tuple[int, ...]
    over_seeds: dict[str, Floats]
    over_laws: dict[str, dict[str, Floats]]
    law_spheres: dict[str, dict[str, Series]]
    sampling: SamplingStudy

    @property
    def standard(self) -> BenchResults:
        return self.benches[STANDARD]

    @property
    def ideal(self) -> BenchResults:
        return self.benches[IDEAL]


def measure(options: PaperOptions, step: Callable[[str], None] = lambda what: None) -> Results:
    """Run all experiments.

    Args:
        step: called with a description before each of `options.steps` steps.

    Raises:
        TooFewMapsError, Refusal, ValueError: a simulation could not be calibrated, or its maps judged.
    """
    configs = {
        STANDARD: options.bench,
        IDEAL: replace(options.bench, law="none", hysteresis=0.0, creep=0.0),
    }
    benches = {name: _bench(name, config, options, step) for name, config in configs.items()}
    small = replace(options.bench, pixels=min(options.bench.pixels, 236))
    seeds = tuple(options.bench.seed + k for k in range(1, options.seeds + 1))
    rows = []
    for seed in seeds:
        step(f"Table 3 on another simulation, seed {seed}")
        rows.append(relative_errors_on(replace(small, seed=seed)))
    over_seeds = {model: np.stack([row[model] for row in rows]) for model in rows[0]}
    over_laws, law_spheres = {}, {}
    for law in FOREIGN_LAWS if options.foreign_laws else ():
        step(f"Table 3 on a {law} simulation")
        over_laws[law] = relative_errors_on(replace(small, law=law))
        step(f"spheres on a {law} simulation")
        samples = measure_samples(replace(small, law=law))
        law_spheres[law] = {
            reading: run_series(samples, LAW_METHOD, reading, spheres(options.spheres)) for reading in READINGS
        }
    step("ways to sample a map")
    sampling = study_samples(benches[STANDARD].samples)
    return Results(options, benches, seeds, over_seeds, over_laws, law_spheres, sampling)


def _bench(name: str, config: SimulationConfig, options: PaperOptions, step: Callable[[str], None]) -> BenchResults:
    step(f"{name}: sample surfaces")
    samples = measure_samples(config, every_pixel=True)
    step(f"{name}: regressions")
    regressions = regress_samples(samples, options.shuffles, config.seed)
    controlled = {}
    for method in METHODS:
        for reading in READINGS_ON[name]:
            step(f"{name}: {method}, {reading}")
            controlled[method, reading] = run_series(samples, method, reading, spheres(options.spheres))
    shaped = {}
    for method in ASPHERE_METHODS:
        step(f"{name}: conics by {method}")
        shaped[method] = run_series(samples, method, "measured", aspheres())
    strongest = max(fitting_limit(samples, FocusTarget(curvature))[0] for curvature in CURVATURE_RANGE)
    return BenchResults(samples, regressions, controlled, shaped, branch_spread(samples), strongest)
