"""What a memory plan promises before it runs, against what its held-out maps then show."""

from __future__ import annotations

import numpy as np
import pytest

from dm_calibration.procedure.forecast import Forecast, forecast, map_noise
from dm_calibration.procedure.plan import PlanKind, PlanOptions, make_plan
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig

pytestmark = pytest.mark.slow

SIMULATION = SimulationConfig(law="bouc_wen", seed=8, pixels=120, degauss_steps=50)


def test_the_promise_is_kept_within_a_factor_of_two() -> None:
    bench = SimulatedBench(SIMULATION)
    began = bench.time
    options = PlanOptions(hysteresis_maps=150)
    calibration = bench.calibrate(PlanKind.HYSTERESIS, options)
    hysteresis = calibration.hysteresis
    assert hysteresis is not None
    expected = forecast(make_plan(PlanKind.HYSTERESIS, bench.mirror, options), SIMULATION.settle_time, calibration)
    assert 0.5 < hysteresis.held_out_max_zernike / expected.max_zernike < 2.0
    assert expected.duration == pytest.approx(bench.time - began, rel=0.2)
    assert 1e-10 < map_noise(calibration.maps) < 5e-10


def test_without_an_earlier_calibration_only_the_duration_is_known() -> None:
    mirror = SimulatedBench(SIMULATION).mirror
    short, long = (
        forecast(make_plan(PlanKind.HYSTERESIS, mirror, PlanOptions(hysteresis_maps=maps)), 0.5, None)
        for maps in (80, 400)
    )
    assert short.max_zernike == long.max_zernike == 0.0
    assert long.duration > 3.0 * short.duration


def test_plans_without_check_moves_promise_nothing() -> None:
    mirror = SimulatedBench(SIMULATION).mirror
    found = forecast(make_plan(PlanKind.POKES, mirror), 0.5, None)
    assert isinstance(found, Forecast) and found.max_zernike == 0.0
    assert np.isfinite(found.duration) and found.duration > 74.0
    # The time of a map that was taken says more than a guess: 124 s were promised where 53 s were needed.
    measured = forecast(make_plan(PlanKind.POKES, mirror), 0.5, None, map_time=0.14)
    assert measured.duration == pytest.approx(found.duration * 0.64 / 1.5)
