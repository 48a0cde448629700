"""Tables 2 and 3: the surface control error regressed on what is known of a surface, both models, all readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.influence.fit import FitOptions, InfluenceFit, fit_influence
from dm_calibration.regression.stepwise import leave_one_out, stepwise
from dm_calibration.regression.surface_error import surface_errors
from dm_common import Floats
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig
from studies.paper.readings import Reading, ReadRegression, regress_surface_errors
from studies.paper.reported import MODELS, TEST_SURFACES
from studies.paper.samples import Samples

#: The reading used for the tables of the page; the others are shown for comparison.
TAKEN = Reading.HISTORY
#: Significance level of the paper (section 3.1).
LEVEL = 0.05


@dataclass(frozen=True, eq=False)
class Regressions:
    """All regressions on one calibrated simulation.

    Attributes:
        by_reading: the regression of each model in each reading.
        shuffled_p: (B,) p(F) of the plain linear reading on responses shuffled among the training surfaces; of
            unbiased p values, a share of LEVEL would be below LEVEL.
        linear_left_out: (n,) m, absolute error of each training surface, predicted by the plain linear reading of AZreg
            from a model selected without it; with their names in `training`.
    """

    by_reading: dict[Reading, dict[str, ReadRegression]]
    shuffled_p: Floats
    training: tuple[str, ...]
    linear_left_out: Floats

    def shuffled_below(self, p: float) -> float:
        """Share of the shuffled responses with a p(F) below `p`."""
        return float((self.shuffled_p < p).mean())

    @property
    def taken(self) -> dict[str, ReadRegression]:
        """Both models in the reading taken."""
        return self.by_reading[TAKEN]


def fit_of(calibration: Calibration, bench: SimulatedBench, model: str) -> InfluenceFit:
    """The influence function of a model from the maps of a calibration."""
    if calibration.fit.method == model:
        return calibration.fit
    return fit_influence(calibration.maps, FitOptions(method=model), rings=bench.mirror.rings)


def regress_samples(samples: Samples, shuffles: int = 0, seed: int = 0) -> Regressions:
    """Both models in all readings.

    Args:
        shuffles: number of shuffles of the responses, which show what selection finds by chance.
        seed: of the shuffles.
    """
    maps = samples.calibration.maps
    fits = {model: fit_of(samples.calibration, samples.bench, model) for model in MODELS}
    by_reading = {
        reading: {model: regress_surface_errors(maps, fits[model], reading) for model in MODELS} for reading in Reading
    }
    errors = surface_errors(samples.calibration.maps, samples.fit)
    train = np.array([label not in TEST_SURFACES for label in errors.labels])
    candidates = np.hstack((errors.signals, maps.coefficients[errors.rows]))[train]
    response = errors.response[train]
    names = [f"x{k + 1}" for k in range(candidates.shape[1])]
    random = np.random.default_rng(seed)
    return Regressions(
        by_reading,
        np.array([stepwise(candidates, random.permutation(response), names).p_value for _ in range(shuffles)]),
        tuple(label for label, trained in zip(errors.labels, train, strict=True) if trained),
        np.abs(leave_one_out(candidates, response) - response),
    )


def relative_errors(regression: ReadRegression) -> Floats:
    """(S,) RelErr of the test surfaces in the order of the paper; NaN for one that was not measured."""
    by_name = {row.surface: row.relative_error for row in regression.table3}
    return np.array([by_name.get(name, np.nan) for name in TEST_SURFACES])


def relative_errors_on(config: SimulationConfig) -> dict[str, Floats]:
    """(S,) RelErr of the test surfaces on a new simulation, by model, in the reading taken."""
    bench = SimulatedBench(config)
    calibration = bench.calibrate()
    return {
        model: relative_errors(regress_surface_errors(calibration.maps, fit_of(calibration, bench, model), TAKEN))
        for model in MODELS
    }
