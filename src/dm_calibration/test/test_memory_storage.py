"""Memory and recipes in calibration files: what goes in comes out, and files without them are read."""

from __future__ import annotations

import numpy as np
import pytest

from dm_calibration.memory.memory_fit import MemoryFit
from dm_calibration.memory.recipes import NO_RECIPES, Recipe, RecipeBook, RecipeError
from dm_calibration.memory.storage import memory_columns, memory_from, recipe_columns, recipes_from
from memory_laws import rich

MEMORY = MemoryFit("Preisach and Duhem", rich(), np.linspace(0.0, 1e-9, 21), 2e-9, 0.03, 312, ("One.", "Two."))


def recipe(curvature: float) -> Recipe:
    return Recipe(curvature, 0.0, np.array([0.1, 0.2]) * curvature, np.array([0.3, 0.4]), 5e-10, 4e-9, 16)


BOOK = RecipeBook((recipe(-0.01), recipe(0.02)), 100, 3e-10, 1_700_000_000_000_000_000)


def test_a_memory_comes_back() -> None:
    back = memory_from(memory_columns(MEMORY))
    assert back is not None
    assert (back.name, back.maps, back.remarks) == (MEMORY.name, MEMORY.maps, MEMORY.remarks)
    assert (back.held_out_max_zernike, back.unknown_sigma) == (MEMORY.held_out_max_zernike, MEMORY.unknown_sigma)
    np.testing.assert_array_equal(back.zernike_sigma, MEMORY.zernike_sigma)
    for name in ("play_radius", "play_weight", "duhem_slope", "duhem_weight", "creep_rate", "creep_time"):
        np.testing.assert_array_equal(getattr(back.law, name), getattr(MEMORY.law, name))


def test_recipes_come_back() -> None:
    back = recipes_from(recipe_columns(BOOK))
    assert (back.degauss_steps, back.interpolation_error, back.stamp_ns) == (100, 3e-10, BOOK.stamp_ns)
    for one, other in zip(back.recipes, BOOK.recipes, strict=True):
        assert (one.curvature, one.max_zernike, one.maps) == (other.curvature, other.max_zernike, other.maps)
        np.testing.assert_array_equal(one.effective, other.effective)


def test_files_without_them_are_read() -> None:
    assert memory_from({}) is None
    assert recipes_from({}) is NO_RECIPES
    assert memory_columns(None) == {} and recipe_columns(NO_RECIPES) == {}


def test_figures_that_are_no_numbers_are_refused() -> None:
    columns = memory_columns(MEMORY)
    columns["memory/zernike_sigma"] = np.array([np.nan])
    with pytest.raises(ValueError, match="must be finite"):
        memory_from(columns)


def test_recipes_of_another_condition_are_not_merged() -> None:
    with pytest.raises(RecipeError, match="degauss_steps = 50"):
        BOOK.merged(RecipeBook((recipe(0.03),), 50, 0.0, 1))
    assert [r.curvature for r in BOOK.merged(RecipeBook((recipe(0.03),), 100, 0.0, 1)).recipes] == [-0.01, 0.02, 0.03]
