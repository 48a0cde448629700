"""The paper's control that follows hysteresis and creep through the commands."""

from __future__ import annotations

import numpy as np
import pytest

from dm_calibration.hysteresis.candidate_fit import CANDIDATES
from dm_common.hysteresis.inverse import invert
from dm_common.hysteresis.observer import HysteresisTracker
from dm_controller.solvers.base import MISS, Shape
from studies.comparison.simulated_bench import SimulationConfig
from studies.paper.hysteresis_control import Estimate
from studies.paper.samples import Samples, measure_samples


@pytest.fixture(scope="module")
def samples() -> Samples:
    result = measure_samples(SimulationConfig(seed=41, pixels=118, samples=200))
    with pytest.MonkeyPatch.context() as patch:
        # The law of the simulation and none: the choice among all is tested elsewhere.
        laws = [law for law in CANDIDATES if law.name in ("linear", "Prandtl-Ishlinskii")]
        patch.setattr("studies.paper.samples.COMMON", laws)
        assert result.hysteresis.name == laws[-1].name
    return result


@pytest.fixture(scope="module")
def tracker(samples: Samples) -> HysteresisTracker:
    """After all that the driver reported during the calibration."""
    tracker = HysteresisTracker(samples.hysteresis.law)
    for report in samples.bench.reports:
        tracker.observe(report)
    return tracker


def shape(*coefficients: float) -> Shape:
    return Shape(np.array([0.0, 0.0, 0.0, *coefficients]), np.zeros(4))


@pytest.mark.slow
def test_a_command_leads_where_it_was_asked_to(samples: Samples, tracker: HysteresisTracker) -> None:
    law, state = samples.hysteresis.law, tracker.state
    assert not tracker.unknown and state is not None
    random = np.random.default_rng(5)
    for _ in range(20):
        wanted = random.uniform(-0.7, 0.7, 37)
        state = law.advance(state, state.time + 1.0)
        signals = invert(law, state, wanted, -1.0, 1.0).signals
        state = law.move(state, signals, state.time)
        np.testing.assert_allclose(law.effective(state), wanted, atol=1e-6)


@pytest.mark.slow
def test_signals_from_two_sides_differ(samples: Samples, tracker: HysteresisTracker) -> None:
    law, reached = samples.hysteresis.law, []
    for side in (-1.0, 1.0):
        assert tracker.state is not None
        turned = law.move(tracker.state, np.full(37, side), tracker.state.time + 10.0)
        reached.append(law.position_at(turned, np.zeros(37)))
    # The standard simulation opens its loop by 10 % of the stroke; effective signals span 2.
    assert np.all(reached[0] < reached[1])
    assert np.mean(reached[1] - reached[0]) / 2.0 == pytest.approx(0.1, abs=0.04)


@pytest.mark.slow
def test_positions_creep_by_the_share_per_decade_of_the_mirror(samples: Samples) -> None:
    law = samples.hysteresis.law
    rested = law.demagnetised(37, 0.0)
    moved = law.move(rested, np.full(37, 0.5), 0.0)
    after = [law.effective(law.advance(moved, time)) for time in (1.0, 10.0)]
    assert (after[1] - after[0]) / after[0] == pytest.approx(np.full(37, samples.bench.config.creep), rel=0.15)


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
