"""Control that follows hysteresis and creep through the commands."""

from __future__ import annotations

import numpy as np
import pytest

from dm_controller.solvers.base import MISS, Shape
from studies.comparison.simulated_bench import SimulationConfig
from studies.paper.remembering import Estimate, Memory
from studies.paper.samples import Samples, measure_samples


@pytest.fixture(scope="module")
def samples() -> Samples:
    return measure_samples(SimulationConfig(seed=41, pixels=118, samples=200))


def shape(*coefficients: float) -> Shape:
    return Shape(np.array([0.0, 0.0, 0.0, *coefficients]), np.zeros(4))


def test_a_command_leads_where_it_was_asked_to(samples: Samples) -> None:
    hysteresis = Memory(samples)
    random = np.random.default_rng(5)
    time = samples.bench.time + 10.0
    for _ in range(20):
        wanted = hysteresis.slope * random.uniform(-0.7, 0.7, 37)
        time += 1.0
        reached = hysteresis.stand(hysteresis.command(wanted, time), time)
        np.testing.assert_allclose(reached, wanted, atol=1e-8)


def test_signals_from_two_sides_differ(samples: Samples) -> None:
    reached = []
    for side in (-1.0, 1.0):
        hysteresis = Memory(samples)
        hysteresis.stand(np.full(37, side), samples.bench.time + 10.0)
        reached.append(hysteresis.stand(np.zeros(37), samples.bench.time + 11.0))
    # The standard twin opens its loop by 10 % of the stroke.
    assert np.all(reached[0] < reached[1])
    assert np.mean(reached[1] - reached[0]) / (2.0 * hysteresis.slope) == pytest.approx(0.1, abs=0.04)


def test_positions_creep_by_the_given_share_per_decade(samples: Samples) -> None:
    hysteresis = Memory(samples)
    start = samples.bench.time + 1e6
    rest = hysteresis.stand(samples.bench.mirror.rest, start)
    first = hysteresis.stand(np.full(37, 0.5), start + 1.0)
    crept = hysteresis.stand(np.full(37, 0.5), start + 10.0) - first
    assert crept / (first - rest) == pytest.approx(np.full(37, samples.bench.config.creep), rel=0.1)


def test_a_map_after_no_move_counts_as_much_as_the_one_before() -> None:
    estimate = Estimate(noise=0.5e-9)
    estimate.update(shape(2e-9, 0.0), shape(0.0, 0.0))
    error = estimate.update(shape(0.0, 4e-9), shape(0.0, 0.0))
    np.testing.assert_allclose(error.coefficients[3:], [1e-9, 2e-9])


def test_a_map_after_a_large_move_counts_alone() -> None:
    estimate = Estimate(noise=0.5e-9)
    estimate.update(shape(2e-6, 0.0), shape(0.0, 0.0))
    error = estimate.update(shape(1e-7, 4e-9), shape(-2e-6, 0.0))
    lost = (0.5e-9 / (MISS * 2e-6)) ** 2
    np.testing.assert_allclose(error.coefficients[3:], [1e-7, 4e-9], rtol=2 * lost)
