"""A hundred nights of drift on the simulation: a map each night keeps true what would be wrong without."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.procedure.applied_history import AppliedHistory
from dm_calibration.procedure.plan import PlanKind, PlanOptions
from dm_calibration.recalibration.drift import UpdateOptions
from dm_calibration.recalibration.updates import InUse, RecalibrationManager
from dm_common.measurement import Measurement
from dm_common.optics.zernike import TERM_RMS, basis
from dm_simulation.mirror.piezo import PiezoConfig
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("common_laws")]

#: Tried by `common_laws`: that of the simulation among them.
TRIED_LAWS = ("linear", "Preisach")
NIGHTS = 100
CONFIG = SimulationConfig(law="preisach", seed=41)
ASTIGMATISM = 4


class AgeingSimulation:
    """A Preisach simulation whose gains and figure drift, with what its driver has reported."""

    def __init__(self, config: SimulationConfig, plan: PlanKind = PlanKind.HYSTERESIS) -> None:
        self.bench = SimulatedBench(config)
        self.calibration = self.bench.calibrate(plan, PlanOptions(hysteresis_maps=150))
        self.history = AppliedHistory()
        found = self.calibration.hysteresis
        assert (found is not None) == (plan is PlanKind.HYSTERESIS)
        self.history.follow(found.law if found is not None else None)
        self._gain = self.bench.piezo.gain.copy()
        self._heard = 0
        self._figure = 0.0
        self.bench.degauss()

    def age(self, gain: np.ndarray | float, astigmatism_rms: float) -> None:
        self.bench.piezo.gain = self._gain * (1.0 + gain)
        self._figure = astigmatism_rms / TERM_RMS[ASTIGMATISM]

    def night(self, rng: np.random.Generator) -> None:
        """A day passes; then another shape."""
        self.bench.time += 86400.0
        self.move(rng)

    def move(self, rng: np.random.Generator) -> None:
        """Another shape."""
        self.bench.apply(np.clip(rng.uniform(-0.6, 0.6) + 0.25 * rng.standard_normal(37), -1.0, 1.0))
        self.bench.settle()
        for applied in self.bench.reports[self._heard :]:
            self.history.observe(replace(applied, moving=False, heard=applied.time))
        self._heard = len(self.bench.reports)

    def measurement(self, sag: np.ndarray) -> Measurement:
        measured = self.bench.measurement_of(sag)
        points = measured.points
        measured.coefficients[ASTIGMATISM] += self._figure
        measured.sag[:] += self._figure * basis(points.x, points.y)[:, ASTIGMATISM]
        return measured

    def error(self, fit: InfluenceFit, effective: np.ndarray) -> float:
        """Largest coefficient error of a prediction, m."""
        true = self.measurement(self.bench.true_map()).coefficients
        return float(np.abs(fit.zernike_offset + fit.influence_zernike @ effective - true)[3:].max())


@pytest.fixture(scope="module")
def simulation() -> AgeingSimulation:
    return AgeingSimulation(CONFIG)


def in_use(updates: RecalibrationManager) -> InUse:
    assert updates.in_use is not None
    return updates.in_use


def changed_fit(updates: RecalibrationManager) -> InfluenceFit:
    return in_use(updates).filter.changed(in_use(updates).drift)


def test_two_maps_show_creep_that_the_calibration_could_not(tmp_path: Path) -> None:
    """Creep ends after minutes, a shape is held for a day, and the law expects that it went on."""
    simulation = AgeingSimulation(replace(CONFIG, creep=0.02, piezo=PiezoConfig(creep_slowest=100.0)))
    updates = RecalibrationManager(tmp_path, UpdateOptions)
    assert updates.begin(simulation.calibration) == ""
    simulation.bench.apply(np.full(37, 0.9))
    simulation.bench.time += 86400.0
    rng = np.random.default_rng(44)
    errors = []
    for checks in range(8):
        simulation.move(rng)
        measured = simulation.measurement(simulation.bench.take_map())
        standing = simulation.history.settled(1e-9 * measured.stamp_ns, 0.1)
        fits = (simulation.calibration.fit, changed_fit(updates))
        errors.append([simulation.error(fit, standing.effective) for fit in fits])
        if checks < 2:
            assert updates.take(measured, standing).accepted
    without, kept = np.median(errors[2:], axis=0)
    assert kept < 0.5 * without


@pytest.mark.parametrize("plan", [PlanKind.HYSTERESIS, PlanKind.POKES])
def test_a_mirror_that_does_not_drift_is_not_made_worse(
    simulation: AgeingSimulation, tmp_path: Path, plan: PlanKind
) -> None:
    """Nor where hysteresis, which a calibration by pokes does not know, looks like a drift of every map."""
    if plan is PlanKind.POKES:
        simulation = AgeingSimulation(CONFIG, plan)
    updates = RecalibrationManager(tmp_path, UpdateOptions)
    assert updates.begin(simulation.calibration) == ""
    rng = np.random.default_rng(43)
    errors = []
    for _ in range(48):
        simulation.bench.time += 30 * 86400.0
        simulation.night(rng)
        measured = simulation.measurement(simulation.bench.take_map())
        standing = simulation.history.settled(1e-9 * measured.stamp_ns, 0.1)
        fits = (simulation.calibration.fit, changed_fit(updates))
        errors.append([simulation.error(fit, standing.effective) for fit in fits])
        assert updates.take(measured, standing).accepted
    without, kept = np.sqrt(np.mean(np.square(errors), axis=0))
    assert kept < 1.02 * without


def test_maps_of_the_nights_keep_the_calibration_true(simulation: AgeingSimulation, tmp_path: Path) -> None:
    updates = RecalibrationManager(tmp_path, UpdateOptions)
    assert updates.begin(simulation.calibration) == ""
    rng = np.random.default_rng(42)
    drift = 0.01 * rng.uniform(0.2, 1.0, 37)
    errors = []
    for night in range(NIGHTS):
        share = (night + 1) / NIGHTS
        simulation.age(drift * share, 20e-9 * share)
        simulation.night(rng)
        measured = simulation.measurement(simulation.bench.take_map())
        standing = simulation.history.settled(1e-9 * measured.stamp_ns, 0.1)
        fits = (simulation.calibration.fit, changed_fit(updates))
        errors.append([simulation.error(fit, standing.effective) for fit in fits])
        assert updates.take(measured, standing).accepted, night
    without, kept = np.median(errors[-20:], axis=0)
    assert kept < 0.2 * without
    assert kept < 632.8e-9 / 200
    before = in_use(updates).drift
    assert before.offset_rms == pytest.approx(20e-9, rel=0.2)

    # A map of a bumped bench changes nothing.
    simulation.age(drift, 40e-9)
    simulation.night(rng)
    bumped = simulation.measurement(simulation.bench.take_map())
    verdict = updates.take(bumped, simulation.history.settled(1e-9 * bumped.stamp_ns, 0.1))
    assert not verdict.accepted
    after = in_use(updates).drift
    assert after.gain is before.gain and after.offset is before.offset and after.covariance is before.covariance
