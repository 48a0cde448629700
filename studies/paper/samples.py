"""The sample surfaces of Table 1 measured on a simulation, and the quantities that sections 2.2 and 3.1 derive."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dm_calibration.calibration import Calibration
from dm_calibration.hysteresis.candidate_fit import COMMON
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit, effective_maps, fit_hysteresis
from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.maps import MapSet, StepKind
from dm_calibration.influence.region_weighting import RegionWeighting, weighting_of
from dm_calibration.influence.surfaces import TABLE_1
from dm_calibration.influence.weights import region_weights, surface_control_error
from dm_calibration.procedure.procedure import Progress
from dm_common import Floats
from dm_common.measurement import Measurement
from dm_common.optics.piston_tilt import remove_plane
from dm_common.optics.sample_regions import regional_rms
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig
from studies.paper.regions import ConcentricRegions, RegionStatistics, figure_5, levelled_rms, residual_map
from studies.paper.weights_cancel import weights_cancel_max_abs

#: Readings of Fig. 5: rms about zero over the sampling points, or over all pixels, each with piston and tilt removed
#: once over the whole aperture; and over the points with every region levelled on its own.
POINTS, PIXELS, LEVELLED = "sampling points", "every pixel", "sampling points, each region levelled"
#: Surfaces that measure “the degree of linearity of control” (section 2.1): the signal of channel 1 varies, and the
#: others share it (p01–p05) or stay.
LINEAR = {f"{names[0]}–{names[-1]}": names for names in (TABLE_1[:5], TABLE_1[45:54])}
#: Number of maps of a mirror at rest from which the noise of one map is found.
REPEATS = 20
#: Time after which creep has come to rest, s.
LONG_REST = 1e4


class Linearity(NamedTuple):
    """Linearity of the sag in the signal, by the terms of the maps beyond tilt.

    Attributes:
        rate: m rms per unit signal, change of the sag along the best straight line.
        departure: largest rms departure of a surface from that line, as a share of the line's change over the range.
        r2: share of the change of the sag that the line explains.
    """

    rate: float
    departure: float
    r2: float


@dataclass(frozen=True, eq=False)
class Samples:
    """One calibrated simulation with its regional errors.

    Attributes:
        bench: the simulation right after its calibration, at rest.
        calibration: all maps, with the fit by AZreg.
        labels: (M,) names of the sample surfaces.
        regional: (M, 10) m, rms surface control error inside the regions.
        actuator_surfaces, zernike_surfaces: panels (a) and (b) of Fig. 5.
        readings: panel (a) of Fig. 5 by reading, see POINTS, PIXELS, LEVELLED; PIXELS only if requested.
        weighting: Eq. (8) with the epsilon of the cross-validation.
        median_weights: (10,) Eq. (8) with epsilon = the median variance, where weights have their full effect.
        weights_cancel: m per unit signal, largest change of G when Eq. (7) replaces Eq. (6).
        influence_max: m per unit signal, largest entry of G, to compare it with.
    """

    bench: SimulatedBench
    calibration: Calibration
    labels: tuple[str, ...]
    regional: Floats
    actuator_surfaces: RegionStatistics
    zernike_surfaces: RegionStatistics
    readings: dict[str, RegionStatistics]
    weighting: RegionWeighting
    median_weights: Floats
    weights_cancel: float
    influence_max: float

    @property
    def fit(self) -> InfluenceFit:
        return self.calibration.fit

    @cached_property
    def noise(self) -> float:
        """Noise of one map, m: median over repeated maps of the largest coefficient's deviation from their mean.

        The mirror is at rest. No controlled surface can be shown by one map to be better than this.
        """
        bench = self.bench.fork()
        bench.apply(bench.mirror.rest)
        bench.settle()
        bench.time += LONG_REST
        taken = np.stack([bench.measure(f"repeat {k}").coefficients for k in range(REPEATS)])
        beyond_tilt = np.abs(taken - taken.mean(axis=0))[:, PISTON_TILT:]
        return float(np.median(beyond_tilt.max(axis=1)))

    @cached_property
    def hysteresis(self) -> HysteresisFit:
        """The hysteresis and creep of the actuators, identified from the maps of the calibration.

        One law for all actuators: in the sample surfaces, single actuators reverse too rarely for laws of their own.

        Raises:
            ExcitationError: the maps do not determine them.
        """
        return fit_hysteresis(self.calibration.maps, COMMON)

    @cached_property
    def effective_maps(self) -> MapSet:
        """The maps of the calibration with effective signals in the place of those applied."""
        return effective_maps(self.calibration.maps, self.hysteresis.law)

    @cached_property
    def linearity(self) -> dict[str, Linearity]:
        """Linearity by group of LINEAR."""
        return {group: self._linearity(labels) for group, labels in LINEAR.items()}

    def _linearity(self, labels: Sequence[str]) -> Linearity:
        maps, rows = self.calibration.maps, [self.row(label) for label in labels]
        signal, sag = maps.applied[rows, 0], (maps.coefficients[rows] * TERM_RMS)[:, PISTON_TILT:]
        moved, change = signal - signal.mean(), sag - sag.mean(axis=0)
        rate = moved @ change / (moved @ moved)
        left = change - np.outer(moved, rate)
        steepness = float(np.linalg.norm(rate))
        departure = np.linalg.norm(left, axis=1).max() / (steepness * np.ptp(signal))
        return Linearity(steepness, float(departure), float(1.0 - np.square(left).sum() / np.square(change).sum()))

    def row(self, label: str) -> int:
        """Row of a surface in the calibration's maps."""
        return self.calibration.maps.label.index(label)


class _MapKeepingBench(SimulatedBench):
    """Keeps the latest map of each sample surface, in single precision: the rounding error is some 1e-13 m."""

    def __init__(self, config: SimulationConfig) -> None:
        super().__init__(config)
        self.kept: dict[str, NDArray[np.float32]] = {}
        self._latest: Floats = np.empty((0, 0))

    def take_map(self) -> Floats:
        self._latest = super().take_map()
        return self._latest

    def measure(self, label: str) -> Measurement:
        measured = super().measure(label)
        if label in TABLE_1:
            self.kept[label] = self._latest.astype(np.float32)
        return measured


def measure_samples(
    config: SimulationConfig, progress: Callable[[Progress], None] = lambda progress: None, *, every_pixel: bool = False
) -> Samples:
    """Measure Table 1 on a new simulation, with the pokes and reference frames of a full calibration, and judge them.

    Args:
        every_pixel: judge the regions of Fig. 5 on all pixels too; all maps of them are kept in memory meanwhile.

    Raises:
        TooFewMapsError, ValueError: as the calibration and the region weights do.
    """
    bench = _MapKeepingBench(config) if every_pixel else SimulatedBench(config)
    calibration = bench.calibrate(progress=progress)
    maps, influence = calibration.maps, calibration.fit.influence_zernike
    chosen = maps.select(np.array([kind == StepKind.SURFACE for kind in maps.kind], dtype=bool))
    error = surface_control_error(chosen.sag, chosen.applied, influence, chosen.points)
    regional = regional_rms(error, chosen.points, labels=chosen.label)
    panel_a, panel_b = figure_5(regional, chosen.label)
    levelled = levelled_rms(error, chosen.points)
    readings = {POINTS: panel_a, LEVELLED: figure_5(levelled, chosen.label)[0]}
    if isinstance(bench, _MapKeepingBench):
        readings[PIXELS] = figure_5(_on_every_pixel(bench, chosen, influence), chosen.label)[0]
        bench.kept.clear()
    weighting = weighting_of(maps, calibration.fit.used)
    return Samples(
        bench=bench,
        calibration=calibration,
        labels=chosen.label,
        regional=regional,
        actuator_surfaces=panel_a,
        zernike_surfaces=panel_b,
        readings=readings,
        weighting=weighting,
        median_weights=region_weights(weighting.variance, float(np.median(weighting.variance))),
        weights_cancel=_cancel(chosen),
        influence_max=float(np.abs(influence).max()),
    )


def _on_every_pixel(bench: _MapKeepingBench, surfaces: MapSet, influence: Floats) -> Floats:
    """(M, 10) m: rms surface control error inside the regions over all pixels of the maps."""
    aperture = bench.aperture
    regions = ConcentricRegions((bench.config.pixels,) * 2, aperture)

    def errors() -> Iterator[Floats]:
        for label, signals in zip(surfaces.label, surfaces.applied, strict=True):
            yield remove_plane(residual_map(bench.kept[label].astype(np.float64), influence @ signals, aperture))

    return regions.rms_of_each(errors(), surfaces.label)


def _cancel(surfaces: MapSet) -> float:
    """`weights_cancel` of :class:`Samples`, for weights that rise a hundredfold from the first to the last row."""
    delta_c = (surfaces.coefficients[1:] - surfaces.coefficients[0]).T
    delta_s = (surfaces.applied[1:] - surfaces.applied[0]).T
    return weights_cancel_max_abs(delta_c, delta_s, np.geomspace(0.01, 1.0, len(delta_c)))
