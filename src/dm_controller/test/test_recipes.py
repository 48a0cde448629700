"""Finding recipes, and interpolating between them."""

from __future__ import annotations

import numpy as np
import pytest

from dm_common.recipes import NO_RECIPES, Recipe, RecipeBook, RecipeError
from dm_controller.planning.recipes import find, interpolation_error
from dm_controller.planning.target import FocusTarget

CURVATURES = (-0.03, -0.01, 0.0, 0.02, 0.03, 0.05)
DIRECTION = np.random.default_rng(3).standard_normal((4, 5))


def effective(curvature: float) -> np.ndarray:
    """A smooth curve through space, of third order."""
    return np.array([1.0, 20.0 * curvature, (20.0 * curvature) ** 2, (20.0 * curvature) ** 3]) @ DIRECTION


def recipe(curvature: float, conic_constant: float = 0.0, max_zernike: float = 3e-10) -> Recipe:
    values = effective(curvature)
    return Recipe(curvature, conic_constant, values, values, max_zernike, 1e-9, 20)


def book(*recipes: Recipe, interpolation_error: float = 2e-10) -> RecipeBook:
    return RecipeBook(recipes, 100, interpolation_error, 0)


BOOK = book(*[recipe(c) for c in CURVATURES])


def test_a_stored_recipe_is_found_as_it_is() -> None:
    found = find(BOOK, FocusTarget(0.02))
    np.testing.assert_array_equal(found.effective, effective(0.02))
    assert (found.error, found.interpolated) == (3e-10, False)


def test_between_recipes_the_curve_that_predicts_best_is_taken() -> None:
    found = find(BOOK, FocusTarget(0.012))
    # A cubic spline goes through a cubic exactly; straight lines would miss by this:
    between = 0.4 * effective(0.0) + 0.6 * effective(0.02)
    assert np.abs(found.effective - effective(0.012)).max() < 1e-9 < np.abs(between - effective(0.012)).max()
    assert found.interpolated
    assert found.error == pytest.approx(5e-10)


def test_the_worse_neighbour_counts() -> None:
    two = book(recipe(0.0, max_zernike=1e-10), recipe(0.02, max_zernike=4e-10), interpolation_error=0.0)
    found = find(two, FocusTarget(0.005))
    assert found.error == 4e-10
    np.testing.assert_allclose(found.effective, 0.75 * effective(0.0) + 0.25 * effective(0.02))


@pytest.mark.parametrize(
    ("target", "words"),
    [
        (FocusTarget(0.051), r"curvature = \+0\.0510 1/m: .* from -0\.0300 to \+0\.0500 1/m and are not extrapolated"),
        (FocusTarget(-0.2), r"curvature = -0\.2000 1/m"),
        (FocusTarget(0.02, -1.0), r"conic_constant = -1: there are recipes of 0 only"),
        (FocusTarget(0.02, 0.0, (0.0,) * 3 + (1e-9,) + (0.0,) * 17), "zernike: recipes are of plain conics"),
    ],
)
def test_nothing_is_extrapolated(target: FocusTarget, words: str) -> None:
    with pytest.raises(RecipeError, match=words):
        find(BOOK, target)


def test_an_empty_book_says_so() -> None:
    with pytest.raises(RecipeError, match="there are no recipes"):
        find(NO_RECIPES, FocusTarget(0.0))


def test_recipes_of_another_conic_do_not_join() -> None:
    mixed = book(recipe(0.0, -1.0), recipe(0.04, -1.0), *[recipe(c) for c in CURVATURES])
    found = find(mixed, FocusTarget(0.01, -1.0))
    np.testing.assert_allclose(found.effective, 0.75 * effective(0.0) + 0.25 * effective(0.04))


def test_the_error_of_interpolation_is_that_of_recipes_left_out() -> None:
    influence = np.zeros((21, 5))
    influence[3, 0], influence[1, 1] = 1e-6, 1.0  # tilt does not count
    straight = [recipe(c) for c in (-0.02, 0.0, 0.02)]
    line = 0.5 * (effective(-0.02) + effective(0.02))
    assert interpolation_error(straight, influence) == pytest.approx(1e-6 * abs(line - effective(0.0))[0])
    assert interpolation_error(BOOK.recipes, influence) < 1e-12
    assert interpolation_error(straight[:2], influence) == 0.0
