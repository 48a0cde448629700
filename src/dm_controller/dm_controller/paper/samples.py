"""The sample surfaces of Table 1 measured on a twin, and what sections 2.2 and 3.1 of the paper need of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dm_calibration.calibration import Calibration
from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.maps import SURFACE, MapSet
from dm_calibration.influence.region_weighting import RegionWeighting, weighting_of
from dm_calibration.influence.weights import region_weights, surface_control_error, weights_cancel_max_abs
from dm_calibration.optics.regions import RegionStatistics, figure_5
from dm_calibration.optics.sample_regions import regional_rms
from dm_calibration.procedure import Progress
from dm_controller.experiments.twin_bench import TwinBench, TwinConfig

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Samples:
    """One calibrated twin with its regional errors.

    Attributes:
        bench: the twin right after its calibration, at rest.
        calibration: all maps, with the fit by AZreg.
        labels: (M,) names of the sample surfaces.
        regional: (M, 10) m, rms surface control error inside the regions.
        actuator_surfaces, zernike_surfaces: panels (a) and (b) of Fig. 5.
        weighting: Eq. (8) with the epsilon of the cross-validation.
        median_weights: (10,) Eq. (8) with epsilon = the median variance, where weights act in full.
        weights_cancel: m per unit signal, largest change of G when Eq. (7) replaces Eq. (6).
        influence_max: m per unit signal, largest entry of G, to compare it with.
    """

    bench: TwinBench
    calibration: Calibration
    labels: tuple[str, ...]
    regional: Floats
    actuator_surfaces: RegionStatistics
    zernike_surfaces: RegionStatistics
    weighting: RegionWeighting
    median_weights: Floats
    weights_cancel: float
    influence_max: float

    @property
    def fit(self) -> InfluenceFit:
        return self.calibration.fit

    def row(self, label: str) -> int:
        """Row of a surface in the calibration's maps."""
        return self.calibration.maps.label.index(label)


def measure_samples(config: TwinConfig, progress: Callable[[Progress], None] = lambda progress: None) -> Samples:
    """Measure Table 1 on a new twin, with the pokes and reference frames of a full calibration, and judge the maps.

    Raises:
        TooFewMapsError, ValueError: as the calibration and the region weights do.
    """
    bench = TwinBench(config)
    calibration = bench.calibrate(progress=progress)
    maps, influence = calibration.maps, calibration.fit.influence_zernike
    chosen = maps.select(np.array([kind == SURFACE for kind in maps.kind], dtype=bool))
    error = surface_control_error(chosen.sag, chosen.applied, influence, chosen.points)
    regional = regional_rms(error, chosen.points, labels=chosen.label)
    panel_a, panel_b = figure_5(regional, chosen.label)
    weighting = weighting_of(maps, calibration.fit.used)
    return Samples(
        bench=bench,
        calibration=calibration,
        labels=chosen.label,
        regional=regional,
        actuator_surfaces=panel_a,
        zernike_surfaces=panel_b,
        weighting=weighting,
        median_weights=region_weights(weighting.variance, float(np.median(weighting.variance))),
        weights_cancel=_cancel(chosen),
        influence_max=float(np.abs(influence).max()),
    )


def _cancel(surfaces: MapSet) -> float:
    """Changes from the first sample surface, and weights that differ a hundredfold from row to row."""
    delta_c = (surfaces.coefficients[1:] - surfaces.coefficients[0]).T
    delta_s = (surfaces.applied[1:] - surfaces.applied[0]).T
    return weights_cancel_max_abs(delta_c, delta_s, np.geomspace(0.01, 1.0, len(delta_c)))
