"""Building recipes on the simulation: what is stored makes the shape again, at another creep."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_calibration.procedure.plan import PlanKind, PlanOptions
from dm_common.errors import Cancelled, Refusal
from dm_common.hysteresis.model import HysteresisState
from dm_common.hysteresis.observer import HysteresisTracker
from dm_common.optics.zernike import SPOKEN
from dm_common.recipes import Recipe, RecipeError
from dm_controller.converge.defects import agreeing_maps
from dm_controller.converge.recipe_building import (
    BuildOptions,
    BuildStep,
    RecipeBuilder,
    recipe_book,
)
from dm_controller.planning.mirror_model import CalibratedMirror
from dm_controller.planning.planner import HysteresisFigures, Planner
from dm_controller.planning.recipes import Corrections, FoundRecipe, UnreachableError, recipe_targets
from dm_controller.planning.target import FocusTarget, Shape
from linear_mirror import hexagon
from linear_plant import LIMITS, MODEL, LinearPlant
from studies.comparison.compare import true_error
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig, influence_model

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("common_laws")]

WAVELENGTH = 632.8e-9
#: Tried by `common_laws`: that of the simulation among them.
TRIED_LAWS = ("linear", "Preisach")


class Rig:
    """A calibrated simulation with what its driver has reported since it was switched on."""

    def __init__(self) -> None:
        self.bench = SimulatedBench(SimulationConfig(law="preisach", seed=31, pixels=118, samples=200))
        calibration = self.bench.calibrate(PlanKind.HYSTERESIS, PlanOptions(hysteresis_maps=200))
        hysteresis = calibration.hysteresis
        assert hysteresis is not None
        mirror = CalibratedMirror(influence_model(calibration.fit, calibration.aperture_radius), self.bench.limits)
        figures = HysteresisFigures(hysteresis.law, hysteresis.held_out_max_zernike, hysteresis.unknown_sigma)
        self.loop = Planner(mirror, figures)
        tracker = HysteresisTracker(hysteresis.law)
        for report in self.bench.reports:
            tracker.observe(report)
        assert tracker.state is not None
        self.state: HysteresisState = tracker.state

    def replay(
        self, target: FocusTarget, effective: np.ndarray, state: HysteresisState
    ) -> tuple[float, HysteresisState]:
        """Condition, go, wait 0.5 s: the largest coefficient error of the true surface, and the state then."""
        bench, law = self.bench, self.loop.law
        began = bench.time
        bench.degauss()
        state = law.advance(law.degaussed(state, began), bench.time)
        move = self.loop.plan(target, state, bench.time, recipe=FoundRecipe(effective), ahead=0.5)
        state = law.move(state, bench.apply(move.plan.signals), bench.time)
        bench.time += 0.5
        return true_error(bench, target).max_zernike, state


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig()


def test_what_was_built_makes_the_shape_again(rig: Rig) -> None:
    steps: list[BuildStep] = []
    bench = rig.bench
    builder = RecipeBuilder(rig.loop, bench, lambda: bench.time, BuildOptions(), state=rig.state, on_step=steps.append)
    terms = np.zeros((4, len(SPOKEN)))
    terms[3, SPOKEN.index("astigmatism cos")] = 300e-9
    targets = recipe_targets((0.04, -0.03, 0.0, 0.0), 0.0, terms.ravel().tolist(), rig.loop, 2e-8)
    astigmatic = targets[2]
    for target in targets:
        builder.build(target)
    recipes = builder.recipes
    assert [recipe.curvature for recipe in recipes] == [-0.03, 0.0, 0.0, 0.04]
    assert [any(recipe.zernike) for recipe in recipes] == [False, False, True, False]
    # The first needs a round to learn the defect by, the others begin with what it showed.
    assert recipes[0].maps <= 16
    assert all(recipe.maps <= 8 for recipe in (recipes[1], recipes[3]))
    assert sum(recipe.maps for recipe in recipes) == builder.maps == len(steps)
    book = recipe_book(recipes, rig.loop, bench.config.degauss_steps, 1)
    corrections = Corrections(book, rig.loop)
    errors, state = [], builder.state
    targets = [FocusTarget(0.04), astigmatic, FocusTarget(-0.03), FocusTarget(0.0), astigmatic, FocusTarget(0.04)]
    for target, waited in zip(targets, (0.0, 20.0, 200.0, 50.0, 0.0, 5.0), strict=True):
        bench.time += waited  # creep that the next degauss does not wipe
        error, state = rig.replay(target, corrections.find(target).effective, state)
        errors.append(error)
    assert np.median(errors) < WAVELENGTH / 1000.0
    assert max(errors) < WAVELENGTH / 400.0


#: Gains that are 3 % off.
GAINS = 1.0 + 0.03 * np.random.default_rng(2).standard_normal(37)
LOOP = Planner(CalibratedMirror(MODEL, LIMITS))


def build(plant: LinearPlant, options: BuildOptions, curvature: float = 0.02) -> Recipe:
    return RecipeBuilder(LOOP, plant, lambda: plant.time, options).build(FocusTarget(curvature))


def test_without_a_hysteresis_effective_signals_are_signals() -> None:
    plant = LinearPlant(GAINS)
    recipe = build(plant, BuildOptions(tolerance=1e-10))
    assert plant.left(recipe) < 1e-10
    assert recipe.max_zernike < 1e-10
    np.testing.assert_allclose(recipe.effective, recipe.signals, atol=1e-4)


def test_every_round_begins_with_a_degauss() -> None:
    plant = LinearPlant(GAINS, noise=1e-9)
    recipe = build(plant, BuildOptions(tolerance=1e-12, maps_max=12, average=4))
    assert plant.calls == 3 * ["degauss", "apply", *4 * ["measure"]]
    assert recipe.maps == 12
    assert recipe.max_zernike > 1e-12  # told as it was measured


def test_the_next_shape_begins_with_what_the_last_ones_showed() -> None:
    """Gains that are 3 % off miss a shape by tens of nm; from the second shape on one round is enough."""
    plant = LinearPlant(GAINS, noise=0.1e-9)
    builder = RecipeBuilder(LOOP, plant, lambda: plant.time, BuildOptions(tolerance=2e-9))
    curvatures = (0.018, 0.019, 0.02)
    rounds = [(builder.build(FocusTarget(c)), plant.calls.count("degauss"))[1] for c in curvatures]
    assert rounds[0] > 1
    assert rounds[2] - rounds[1] == 1
    assert all(plant.left(recipe) < 2e-9 for recipe in builder.recipes)


def test_maps_are_averaged_as_the_noise_asks() -> None:
    quiet, noisy = (LinearPlant(GAINS, noise) for noise in (0.05e-9, 1e-9))
    few, many = (build(plant, BuildOptions(tolerance=2e-9, maps_max=64, average=32)).maps for plant in (quiet, noisy))
    assert few <= 12 < many


def test_averaging_takes_the_noise_down() -> None:
    noise = 0.3e-9
    few, many = (
        np.median([plant.left(build(plant, BuildOptions(1e-12, maps, maps // 2))) for plant in plants])
        for maps, plants in ((maps, [LinearPlant(GAINS, noise, seed=100 + k) for k in range(6)]) for maps in (4, 64))
    )
    assert many < 0.5 * few


@pytest.mark.parametrize("hold_tilt", [True, False])
def test_a_recipe_has_the_tilt_that_a_move_has(hold_tilt: bool) -> None:
    """As asked for when it is built, and to the last bit when it is asked for again; else as asked for then."""
    x, y = hexagon()
    model, tilted = replace(MODEL, actuator_x=x, actuator_y=y), (0.0, 300e-9, *19 * (0.0,))
    planners = [Planner(CalibratedMirror(model, LIMITS, axis=(place, 0.0))) for place in (0.0, 3e-3)]
    builder = planners[1] if hold_tilt else Planner(CalibratedMirror(model, LIMITS, hold_tilt=False))
    plant, target = LinearPlant(GAINS), FocusTarget(0.02, 0.0, tilted)
    recipe = RecipeBuilder(builder, plant, lambda: plant.time, BuildOptions(1e-9)).build(target)
    book = recipe_book([recipe], builder, 100, 0)
    as_built = Corrections(book, builder).find(target)
    np.testing.assert_array_equal(as_built.effective, recipe.effective)
    for planner in planners:
        for zernike in (tilted, ()):
            wanted = FocusTarget(0.02, 0.0, zernike)
            found, tilt = Corrections(book, planner).find(wanted), planner.mirror.tilt
            assert tilt is not None
            np.testing.assert_allclose(tilt @ found.effective, planner.mirror.wanted(wanted)[1], atol=10e-9)
            shape = model.influence_zernike[3:] @ (found.effective - recipe.effective)
            assert np.abs(shape).max() < 1e-10
            if planner is builder and zernike:
                np.testing.assert_array_equal(found.effective, recipe.effective)
            else:
                assert found.error > as_built.error


def test_what_their_own_maps_have_taught_the_calibration_does_not_move_recipes_again() -> None:
    plant, target = LinearPlant(GAINS), FocusTarget(0.02)
    recipe = RecipeBuilder(LOOP, plant, lambda: plant.time, BuildOptions(1e-9)).build(target)
    taught = replace(MODEL, zernike_offset=MODEL.zernike_offset + 20e-9)
    planner = Planner(CalibratedMirror(taught, LIMITS))
    found = Corrections(recipe_book([recipe], planner, 100, 0), planner, checked_ns=1).find(target)
    np.testing.assert_allclose(found.effective, recipe.effective, atol=1e-12)


@pytest.mark.parametrize("share", [0.5, 0.97])
def test_a_recipe_whose_tilt_a_limit_has_cut_is_replayed_as_it_was_measured(share: float) -> None:
    """Where limits bind tilt is given up first, which does not make it a recipe of another axis."""
    x, y = hexagon()
    planner = Planner(CalibratedMirror(replace(MODEL, actuator_x=x, actuator_y=y), LIMITS, axis=(3e-3, 0.0)))
    target = FocusTarget(share * planner.mirror.reachable_range(FocusTarget(0.0), 20e-9)[1])
    plant = LinearPlant(GAINS)
    recipe = RecipeBuilder(planner, plant, lambda: plant.time, BuildOptions(1e-9, reachable=1e-6)).build(target)
    found = Corrections(recipe_book([recipe], planner, 100, 0), planner).find(target)
    np.testing.assert_array_equal(found.effective, recipe.effective)
    assert found.error < 2.0 * max(recipe.max_zernike, 1e-9)


def test_cancelling_stops_between_two_maps() -> None:
    plant = LinearPlant(GAINS)
    builder = RecipeBuilder(LOOP, plant, lambda: plant.time, cancelled=lambda: plant.calls.count("measure") == 3)
    with pytest.raises(Cancelled):
        builder.build(FocusTarget(0.02))
    assert plant.calls.count("measure") == builder.maps == 3


@pytest.mark.parametrize(
    ("curvatures", "zernike", "error", "words"),
    [
        ((0.0, float("nan")), (), Refusal, r"curvature = nan: must be float, -1e\+06 to 1e\+06 1/m"),
        ((0.01, 0.02, 0.01), (), RecipeError, r"curvatures: \+0\.0100 1/m is given twice: must be given once"),
        (
            (0.01, 0.01),
            42 * (1e-8,),
            RecipeError,
            r"\+0\.0100 1/m with .*coma sin \+10 nm.* is given twice: must be given once",
        ),
        ((0.0, 5.0), (), UnreachableError, r"curvature = \+5\.0000 1/m: the limits .* reachable: -0"),
        ((0.0, 0.1), 20 * (0.0,), Refusal, "zernike has 20 values: must have 0 or 21 or 42"),
    ],
)
def test_bad_shapes_are_refused_before_anything_moves(
    curvatures: tuple[float, ...], zernike: tuple[float, ...], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        recipe_targets(curvatures, 0.0, zernike, LOOP, 2e-8)


def test_a_shape_that_only_the_law_denies_is_told(rig: Rig) -> None:
    """The influence function allows effective signals that the conditioned mirror, at its limits, does not reach."""
    weaker = Planner(LOOP.mirror, rig.loop.hysteresis)
    assert weaker.hysteresis is not None
    weaker.law = replace(weaker.hysteresis.law.scaled(0.05), creep_rate=0.0)
    plant = LinearPlant(GAINS)
    with pytest.raises(UnreachableError, match=r"actuator \d+ stands at its limit"):
        RecipeBuilder(weaker, plant, lambda: plant.time).build(FocusTarget(0.02))
    assert "measure" not in plant.calls


def test_a_map_of_another_surface_does_not_count_in_a_round() -> None:
    rng = np.random.default_rng(3)
    maps = [Shape(5e-10 * rng.standard_normal(21), np.zeros(4)) for _ in range(6)]
    assert agreeing_maps(maps) == maps
    wrong = Shape(3e-8 * rng.standard_normal(21), np.zeros(4))
    assert agreeing_maps([*maps[:3], wrong, *maps[3:]]) == maps
    assert len(agreeing_maps([*maps[:2], wrong])) == 3, "two say nothing against one"


def test_maps_left_out_are_counted() -> None:
    plant = LinearPlant(GAINS)
    plant.disturb[1] = 30e-9
    builder = RecipeBuilder(LOOP, plant, lambda: plant.time, BuildOptions(tolerance=1e-9))
    assert plant.left(builder.build(FocusTarget(0.02))) < 1e-9
    assert builder.left_out == 1


def test_no_more_maps_are_taken_than_limits_leave_to_correct() -> None:
    tight = Planner(CalibratedMirror(MODEL, replace(LIMITS, low=-0.06, high=0.06)))
    plant = LinearPlant(GAINS)
    options = BuildOptions(tolerance=1e-9, maps_max=80)
    recipe = RecipeBuilder(tight, plant, lambda: plant.time, options).build(FocusTarget(0.02))
    best = RecipeBuilder(tight, plant, lambda: plant.time, replace(options, tolerance=1e-12)).build(FocusTarget(0.02))
    assert best.max_zernike > 2e-9 and recipe.max_zernike < best.max_zernike + 1e-9
    assert recipe.maps <= 9


def test_noise_is_not_what_limits_leave() -> None:
    """All of the error can be corrected, so building goes on although the mean is not within the tolerance."""
    plant = LinearPlant(GAINS, noise=2e-9)
    assert build(plant, BuildOptions(tolerance=2e-10, maps_max=24, average=4)).maps == 24
