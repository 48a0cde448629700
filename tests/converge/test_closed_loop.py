"""The closed loop on small plants with known faults."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from dm_common.errors import Refusal
from dm_common.measurement import Measurement
from dm_controller.converge.closed_loop import Creep, LoopOptions, LoopStep, StoppedLoop, converge, response_ratio
from dm_controller.converge.converge_run import solver_of
from dm_controller.planning.active_calibration import active_calibration
from dm_controller.planning.target import FocusTarget, TargetError
from dm_controller.solvers.base import Shape, Solver
from dm_controller.solvers.registry import make_solver
from focus_bench import calibration, mirror_info
from linear_mirror import RADIUS
from linear_plant import LIMITS, MODEL, LinearPlant

#: Gains that differ from actuator to actuator, about 1.
SPREAD = np.random.default_rng(5).standard_normal(37)


@pytest.fixture(scope="module")
def solver() -> Solver:
    return make_solver("bounded", MODEL, LIMITS)


def test_an_exact_mirror_takes_one_map(solver: Solver) -> None:
    plant = LinearPlant()
    result = converge(solver, FocusTarget(0.02), plant)
    assert result.converged
    assert result.maps == plant.maps == len(plant.commands) == 1
    assert not result.restored


@pytest.mark.parametrize("gain", [0.6, 0.85, 1.2, 1.5])
def test_wrong_gains_are_corrected_within_five_maps(solver: Solver, gain: float) -> None:
    result = converge(solver, FocusTarget(0.02), LinearPlant(gain * (1.0 + 0.03 * SPREAD)), LoopOptions(1e-9, 5))
    errors = [step.max_zernike for step in result.steps]
    assert result.converged, errors
    assert result.best.max_zernike == min(errors) < 1e-2 * errors[0]


def test_neighbours_at_their_limit_do_not_shrink_the_whole_shape() -> None:
    tight = make_solver("bounded", MODEL, replace(LIMITS, neighbour_difference=0.366))
    plant = LinearPlant(0.65 * (1.0 + 0.03 * SPREAD))
    assert converge(tight, FocusTarget(0.05), plant, LoopOptions(1e-9, 8)).converged


def test_backlash_does_not_make_it_diverge(solver: Solver) -> None:
    result = converge(
        solver, FocusTarget(-0.03), LinearPlant(0.9 * (1.0 + 0.05 * SPREAD), backlash=0.05), LoopOptions(1e-9, 8)
    )
    errors = [step.max_zernike for step in result.steps]
    assert max(errors) == errors[0]
    assert result.best.max_zernike < 0.1 * errors[0]


def test_the_map_limit_is_kept_and_reported(solver: Solver) -> None:
    plant = LinearPlant(0.8)
    seen: list[LoopStep] = []
    result = converge(solver, FocusTarget(0.02), plant, LoopOptions(1e-15, 3), on_step=seen.append)
    assert not result.converged
    assert result.maps == plant.maps == 3
    assert [step.map for step in seen] == [1, 2, 3]
    assert tuple(seen) == result.steps


def test_the_best_command_is_kept_and_written_again(solver: Solver) -> None:
    plant = LinearPlant(0.9)
    plant.disturb = {3: 5e-7}
    result = converge(solver, FocusTarget(0.02), plant, LoopOptions(1e-15, 3))
    assert result.best.map == 2
    assert result.restored
    np.testing.assert_array_equal(plant.commands[-1], result.best.signals)
    assert len(plant.commands) == 4


def test_the_last_correction_may_stay_unmeasured(solver: Solver) -> None:
    plant = LinearPlant(0.8)
    result = converge(solver, FocusTarget(0.02), plant, LoopOptions(1e-15, 2, correct_last=True))
    assert result.maps == plant.maps == 2
    assert len(plant.commands) == 3
    np.testing.assert_array_equal(plant.commands[-1], result.signals)
    wanted = FocusTarget(0.02).coefficients(RADIUS)
    assert np.abs(plant.measure("").coefficients - wanted)[3:].max() < 0.3 * result.best.max_zernike


def test_a_growing_error_halves_the_next_correction(solver: Solver) -> None:
    grown = LinearPlant()
    grown.disturb = {2: 5e-6}
    steps = converge(solver, FocusTarget(0.01), grown, LoopOptions(1e-15, 3)).steps
    full = solver.correct(steps[1].signals, steps[1].error).signals - steps[1].signals
    assert steps[1].max_zernike > steps[0].max_zernike
    assert np.linalg.norm(steps[2].signals - steps[1].signals) <= 0.5 * 1.5 * np.linalg.norm(full) + 1e-9


def test_foreseen_creep_leaves_less(solver: Solver) -> None:
    left = {}
    for share in (0.0, 0.02):
        plant = LinearPlant(drift=0.02)
        creep = Creep.of_rate(share, np.zeros(37), lambda plant=plant: plant.time)  # type: ignore[misc]
        steps = converge(solver, FocusTarget(0.03), plant, LoopOptions(1e-15, 4), creep=creep).steps
        left[share] = steps[-1].max_zernike
    assert left[0.02] < 0.2 * left[0.0]


def test_a_start_of_ones_own(solver: Solver) -> None:
    plant = LinearPlant()
    start = np.full(37, 0.3)
    result = converge(solver, FocusTarget(0.01), plant, start=start)
    np.testing.assert_array_equal(plant.commands[0], start)
    assert result.converged
    assert result.maps >= 2


def test_points_without_data_do_not_matter(solver: Solver) -> None:
    class Holes(LinearPlant):
        def measure(self, label: str) -> Measurement:
            measured = super().measure(label)
            measured.sag[::9] = np.nan
            return measured

    assert converge(solver, FocusTarget(0.02), Holes(0.9), LoopOptions(2e-9, 4)).converged


def test_cancelling_keeps_what_was_measured(solver: Solver) -> None:
    plant = LinearPlant(0.8)
    steps, options = list[LoopStep](), LoopOptions(1e-15, 9)
    with pytest.raises(StoppedLoop, match="cancelled after 2 maps"):
        converge(solver, FocusTarget(0.02), plant, options, on_step=steps.append, cancelled=lambda: plant.maps == 2)
    assert len(steps) == 2


def test_failures_of_the_bench_pass_through(solver: Solver) -> None:
    class Broken(LinearPlant):
        def measure(self, label: str) -> Measurement:
            raise Refusal(302, "no map")

    with pytest.raises(Refusal, match="no map"):
        converge(solver, FocusTarget(0.02), Broken())


def test_maps_of_another_kind_are_refused(solver: Solver) -> None:
    class Other(LinearPlant):
        def measure(self, label: str) -> Measurement:
            measured = super().measure(label)
            object.__setattr__(measured, "sag", measured.sag[:100])
            return measured

    with pytest.raises(ValueError, match="21 terms and 100 sampling points, the calibration has 21 and 300"):
        converge(solver, FocusTarget(0.02), Other())


def test_the_response_ratio_counts_terms_by_their_rms() -> None:
    commanded = Shape(np.concatenate([np.ones(3), 1e-7 * np.arange(18)]), np.zeros(1))
    seen = Shape(np.concatenate([np.full(3, 9.0), 0.8e-7 * np.arange(18)]), np.zeros(1))
    assert response_ratio(commanded, seen) == pytest.approx(0.8)
    tiny = Shape(1e-4 * commanded.coefficients[:] * np.concatenate([np.ones(3), np.full(18, 1e-1)]), np.zeros(1))
    assert math.isnan(response_ratio(tiny, seen))


def test_a_surface_that_does_not_exist_is_refused(solver: Solver) -> None:
    with pytest.raises(TargetError):
        converge(solver, FocusTarget(200.0), LinearPlant())


@pytest.mark.parametrize(
    ("hold_tilt", "axis", "tilt"), [(True, (3e-3, 0.0), 0.0), (True, (0.0, 0.0), 300e-9), (False, (0.0, 0.0), 0.0)]
)
def test_the_action_begins_with_the_tilt_that_a_move_has(
    hold_tilt: bool, axis: tuple[float, float], tilt: float
) -> None:
    active = active_calibration(calibration(), mirror_info(), hold_tilt, axis)
    target = FocusTarget(0.02, 0.0, (0.0, tilt, *19 * (0.0,)))
    result = converge(solver_of(active, ""), target, LinearPlant())
    assert result.converged
    np.testing.assert_array_equal(result.signals, active.mirror.command(target)[0])
