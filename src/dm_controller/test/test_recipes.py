"""Finding recipes, estimating between them, and the bound of what they promise."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from dm_msgs.srv import StoreRecipes

from dm_common.errors import ErrorCode
from dm_common.optics.zernike import TERMS
from dm_common.recipes import NO_RECIPES, Recipe, RecipeBook, RecipeError
from dm_common.ros.clients import ServiceCallError
from dm_controller.converge import recipe_run
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.recipes import REPEAT_SHARE, Corrections
from dm_controller.planning.target import FocusTarget

CURVATURES = (-0.05, -0.03, -0.01, 0.0, 0.02, 0.03, 0.05)
ACTUATORS = 37
RANDOM = np.random.default_rng(3)
#: Effective signals over curvature, by power from 1: a sphere of 0.05 1/m is 0.5 away from mid range.
OWN = RANDOM.standard_normal((2, ACTUATORS)) * ((10.0,), (3.0,))
#: The same over added terms: 1 um of one is 0.2 away.
ADDED = 2e5 * RANDOM.standard_normal((len(TERMS), ACTUATORS))
INFLUENCE = np.concatenate((np.zeros((3, ACTUATORS)), 1e-6 * RANDOM.standard_normal((18, ACTUATORS))))


def own(target: FocusTarget) -> np.ndarray:
    """What a model asks for; a conic as if it were a slightly stronger sphere."""
    curvature = target.curvature * (1.0 - 0.001 * target.conic_constant)
    added = np.asarray(target.zernike) @ ADDED if target.zernike else 0.0
    return np.asarray(curvature * OWN[0] + curvature**2 * OWN[1] + added)


class StandIn:
    """A planner whose model promises an error, m, `in_use` times that on held-out moves."""

    def __init__(self, held_out: float, in_use: float = 1.0) -> None:
        self.mirror = SimpleNamespace(
            command=lambda target: (own(target), 0.0),
            tilt=None,
            model=SimpleNamespace(influence_zernike=INFLUENCE, held_out_max_zernike=held_out, aperture_radius=0.11),
        )
        self.hysteresis = None
        self.error_bound = lambda known: in_use * held_out


class Law:
    """What a model misses of effective signals: waves of random direction, as large as `size` (m) at `length`."""

    def __init__(self, rng: np.random.Generator, size: float, length: float) -> None:
        self.ways = rng.standard_normal((6, ACTUATORS)) / (length * np.sqrt(ACTUATORS))
        self.phases = rng.uniform(0.0, 2.0 * np.pi, 6)
        self.waves = scaled(rng.standard_normal((6, ACTUATORS)), size)

    def __call__(self, effective: np.ndarray) -> np.ndarray:
        return np.asarray(np.cos(self.ways @ effective + self.phases) @ self.waves)


def largest(effective: np.ndarray) -> float:
    """Largest coefficient beyond tilt that effective signals (..., N) make, m."""
    return float(np.abs(effective @ INFLUENCE.T).max())


def scaled(effective: np.ndarray, size: float) -> np.ndarray:
    return effective * (size / largest(effective))


def recipe(
    curvature: float,
    missed: np.ndarray | float = 0.0,
    conic: float = 0.0,
    measured: float = 3e-10,
    zernike: tuple[float, ...] = (),
) -> Recipe:
    values = own(FocusTarget(curvature, conic, zernike)) + missed
    return Recipe(curvature, conic, values, values, measured, 1e-9, 6, zernike)


def added(**terms: float) -> tuple[float, ...]:
    """Added terms, m, by what opticians call them."""
    return tuple(terms.get(term.spoken.replace(" ", "_"), 0.0) for term in TERMS)


def book(*recipes: Recipe) -> RecipeBook:
    return RecipeBook(tuple(sorted(recipes, key=lambda each: each.shape)), 100, 0.0)


PLANNER: Any = StandIn(1e-9)
BOOK = book(*[recipe(curvature) for curvature in CURVATURES])


def test_a_stored_recipe_is_found_as_it_is() -> None:
    found = Corrections(BOOK, PLANNER).find(FocusTarget(0.02))
    np.testing.assert_array_equal(found.effective, own(FocusTarget(0.02)))
    assert found.error == pytest.approx(3e-10 + REPEAT_SHARE * 1e-9)


def test_between_recipes_what_the_neighbours_show_corrects_the_model() -> None:
    law = Law(np.random.default_rng(1), 100e-9, 0.5)
    corrected = book(*[recipe(c, law(own(FocusTarget(c)))) for c in np.linspace(-0.05, 0.05, 11)])
    for curvature in (-0.044, -0.011, 0.032):
        found = Corrections(corrected, PLANNER).find(FocusTarget(curvature))
        effective = own(FocusTarget(curvature))
        error = largest(found.effective - effective - law(effective))
        assert error < 0.15 * largest(law(effective))
        assert error < found.error


def test_what_the_calibration_has_learnt_since_moves_recipes_too() -> None:
    """By as much as any shape, and not as if the recipes had shown an error of the model."""
    made = [replace(recipe(c, scaled(np.ones(ACTUATORS), 20e-9)), by_model=own(FocusTarget(c))) for c in CURVATURES]
    learnt: Any = StandIn(1e-9)
    moved = 0.01 * np.random.default_rng(5).standard_normal(ACTUATORS)
    learnt.mirror.command = lambda target: (own(target) + moved, 0.0)
    for curvature in (0.02, 0.025):
        then, now = (Corrections(book(*made), one, 1).find(FocusTarget(curvature)) for one in (PLANNER, learnt))
        np.testing.assert_allclose(now.effective, then.effective + moved, atol=1e-12)
        assert then.error * (1.0 - 1e-9) <= now.error < then.error + 1e-9
    lost = Corrections(book(*made), learnt).find(FocusTarget(0.02))
    np.testing.assert_array_equal(lost.effective, made[4].effective, "without maps since, as it was measured")


def test_recipes_built_later_leave_the_others_what_was_learnt_before() -> None:
    """A map agreed at 2: recipes built at 1 have moved with the calibration since, one built at 3 is as measured."""
    made = [replace(recipe(c), by_model=own(FocusTarget(c)), stamp_ns=3 if c == 0.0 else 1) for c in CURVATURES]
    updated: Any = StandIn(1e-9)
    updated.mirror.command = lambda target: (own(target) + 0.01, 0.0)
    corrections = Corrections(book(*made), updated, 2)
    for built in made:
        moved = 0.0 if built.stamp_ns == 3 else 0.01
        np.testing.assert_allclose(corrections.find(FocusTarget(built.curvature)).effective, built.effective + moved)


def test_the_worse_neighbour_counts() -> None:
    two = book(recipe(0.0, measured=1e-10), recipe(0.02, measured=4e-10))
    found = Corrections(two, PLANNER).find(FocusTarget(0.01))
    assert 4e-10 + REPEAT_SHARE * 1e-9 < found.error < 1e-9
    assert Corrections(two, PLANNER).worst == pytest.approx(found.error, rel=0.01)


def test_a_single_recipe_claims_nothing_of_other_shapes_beyond_the_model() -> None:
    missed = scaled(np.ones(ACTUATORS), 225e-9)
    alone = book(recipe(0.04, missed))
    errors = [Corrections(alone, PLANNER).find(FocusTarget(0.04, conic)).error for conic in (-1.0, -50.0, -200.0)]
    assert errors == sorted(errors)
    assert errors[-1] > 100e-9


def test_shapes_between_recipes_are_promised_from_what_any_request_is() -> None:
    """Which is more than the error of the calibration's held-out moves; a recipe itself repeats as they do."""
    in_use: Any = StandIn(1e-9, in_use=1.4)
    plain, wider = Corrections(BOOK, PLANNER), Corrections(BOOK, in_use)
    assert wider.amplitude == pytest.approx(1.4 * plain.amplitude)
    assert wider.find(FocusTarget(0.01)).error > plain.find(FocusTarget(0.01)).error
    assert wider.find(FocusTarget(0.02)).error == plain.find(FocusTarget(0.02)).error


def test_merging_recipes_that_contradict_each_other_widens_the_bound() -> None:
    good = [recipe(c) for c in (-0.02, 0.0, 0.02)]
    before = Corrections(book(*good), PLANNER).find(FocusTarget(0.01)).error
    merged = book(*good[:2]).merged(book(recipe(0.02, scaled(np.ones(ACTUATORS), 225e-9))))
    assert Corrections(merged, PLANNER).find(FocusTarget(0.01)).error > 30e-9 > before


def random_shape(rng: np.random.Generator, size: float) -> FocusTarget:
    """A sphere with all terms added, of `size` (m) each."""
    return FocusTarget(float(rng.uniform(-0.05, 0.05)), 0.0, tuple(size * rng.standard_normal(len(TERMS))))


@pytest.mark.slow
def test_the_bound_holds_on_laws_that_really_err() -> None:
    """Random sets of recipes, of spheres and of shapes with added terms; models that promise too much; any law."""
    rng = np.random.default_rng(5)
    inside: dict[tuple[bool, int], list[bool]] = {}
    while sum(map(len, inside.values())) < 3000:
        size = 10.0 ** rng.uniform(-10.0, -6.5)
        law = Law(rng, size, 10.0 ** rng.uniform(-1.0, 0.3))
        planner: Any = StandIn(size * 10.0 ** rng.uniform(-3.0, 0.0))
        noise = size * 10.0 ** rng.uniform(-3.0, -0.5)
        count = int(rng.integers(1, 12))
        spheres = bool(rng.integers(2))
        shapes = [random_shape(rng, 0.0 if spheres else 1e-6) for _ in range(count)]
        recipes = book(
            *[
                recipe(
                    shape.curvature,
                    law(own(shape)) + scaled(rng.standard_normal(ACTUATORS), noise),
                    measured=noise,
                    zernike=shape.zernike,
                )
                for shape in shapes
            ]
        )
        corrections, curvatures = Corrections(recipes, planner), [shape.curvature for shape in shapes]
        for _ in range(3):
            near = random_shape(rng, 1e-7 if spheres else 1e-6)
            target = FocusTarget(
                float(rng.uniform(min(curvatures), max(curvatures))), float(rng.uniform(-300.0, 300.0)), near.zernike
            )
            try:
                found = corrections.find(target)
            except RecipeError:
                continue
            error = largest(found.effective - own(target) - law(own(target)))
            inside.setdefault((spheres, count), []).append(error <= found.error)
    shares = {kind: np.mean(those) for kind, those in inside.items()}
    assert min(shares.values()) >= 0.9, shares
    assert np.mean(np.concatenate(list(inside.values()))) >= 0.95, shares


def test_other_shapes_are_served_where_recipes_are_near() -> None:
    missed = scaled(np.ones(ACTUATORS), 1e-9)
    corrected = book(*[recipe(c, missed) for c in CURVATURES])
    conic = Corrections(corrected, PLANNER).find(FocusTarget(0.02, -1.0))
    assert largest(conic.effective - own(FocusTarget(0.02, -1.0)) - missed) < 2e-10
    mixed = book(recipe(0.02, missed, -1.0), *corrected.recipes)
    assert Corrections(mixed, PLANNER).find(FocusTarget(0.02, -1.0)).error < conic.error


def test_a_shape_with_added_terms_has_recipes_as_a_sphere_has() -> None:
    """Found as it is, however the same surface is asked for; its neighbours learn from it; it changes no sphere."""
    law = Law(np.random.default_rng(2), 100e-9, 0.5)
    strengths = (-2e-6, -1e-6, 0.0, 1e-6, 2e-6)
    shapes = [FocusTarget(0.0, 0.0, added(astigmatism_cos=strength)) for strength in strengths]
    corrected = book(*[recipe(0.0, law(own(shape)), zernike=shape.zernike) for shape in shapes])
    corrections = Corrections(corrected, PLANNER)
    for shape in shapes:
        # A conic constant changes nothing of a plane.
        found = corrections.find(replace(shape, conic_constant=-1.0))
        assert largest(found.effective - own(shape) - law(own(shape))) < 1e-15
    between = FocusTarget(0.0, 0.0, added(astigmatism_cos=0.5e-6))
    found = corrections.find(between)
    error = largest(found.effective - own(between) - law(own(between)))
    assert error < found.error < largest(law(own(between)))
    assert error < 0.3 * largest(law(own(between)))
    with pytest.raises(RecipeError, match=r"no recipe is near.* 1 from .* with conic_constant = 0, astigmatism cos -2"):
        corrections.find(FocusTarget(0.0, 0.0, added(coma_sin=20e-6)))


def test_nothing_is_extrapolated_and_far_from_all_recipes_there_is_none() -> None:
    alone = book(recipe(-0.02, conic=-1.0), recipe(-0.03))
    there = (
        r"there are 1 from -0\.0200 to -0\.0200 1/m with conic_constant = -1, 1 from -0\.0300 to -0\.0300 1/m with "
        "conic_constant = 0"
    )
    with pytest.raises(
        RecipeError, match=rf"curvature = \+0\.0510 1/m: outside the recipes, which are not extrapolated; {there}"
    ):
        Corrections(alone, PLANNER).find(FocusTarget(0.051))
    # The range ends with the shape, not with the last digit.
    Corrections(alone, PLANNER).find(FocusTarget(float(np.nextafter(-0.02, 0.0)), -2.0))
    with pytest.raises(RecipeError, match=rf"curvature = -0\.0250 1/m: no recipe is near this shape; {there}"):
        Corrections(alone, PLANNER).find(FocusTarget(-0.025, 3000.0))


def test_an_empty_book_says_so() -> None:
    with pytest.raises(RecipeError, match="there are no recipes"):
        Corrections(NO_RECIPES, PLANNER).find(FocusTarget(0.0))
    none: Any = None
    assert ActiveCalibration(none, none, none, PLANNER, NO_RECIPES).conditioned_error == 0.0


def test_recipes_whose_answer_was_lost_are_stored_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A calibration node that has just been started loses the answer to a controller that it does not know yet."""
    answers = [ServiceCallError("no answer within 10 s"), StoreRecipes.Response(message="stored")]

    def call(*_arguments: Any) -> Any:
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    monkeypatch.setattr(recipe_run, "call", call)
    monkeypatch.setattr(recipe_run.time, "sleep", lambda _duration: None)
    said: list[str] = []
    alive: Any = SimpleNamespace(wait_for_return=lambda _stop: None, since_now=lambda _served: lambda: "")
    bench: Any = SimpleNamespace(waiting=said.append, parameters={}, hold=SimpleNamespace(lost=None))
    store: Any = SimpleNamespace(service_is_ready=lambda: True)
    run = recipe_run.RecipeRun(bench, store, alive)
    handle: Any = SimpleNamespace(is_cancel_requested=False)
    assert run._stored(handle, StoreRecipes.Request()) == (ErrorCode.OK, "stored")
    assert said == ["waiting: no answer within 10 s"]
