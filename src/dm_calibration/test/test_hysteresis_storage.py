"""Hysteresis model and recipes in calibration files: what goes in comes out, and files without them are read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit
from dm_calibration.store.hysteresis_storage import hysteresis_columns, hysteresis_from, recipe_columns, recipes_from
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_common.recipes import NO_RECIPES, Recipe, RecipeBook, RecipeError

#: Preisach of second order and a Duhem operator, with creep.
MODEL = HysteresisModel(
    np.array([0.0, 0.1, 0.3]),
    np.array([[0.9, 0.05], [0.1, 0.02], [0.08, 0.01]]),
    np.array([1.6, 0.3]),
    -0.1,
    0.01,
    CREEP_TIMES,
    lag_spectrum=np.full((2, 7), 0.5),
    creep_slope=0.1,
)
HYSTERESIS = HysteresisFit("Preisach and Duhem", MODEL, np.linspace(0.0, 1e-9, 21), 2e-9, 0.03, 312, ("One.", "Two."))


BUILT = 1_700_000_000_000_000_000


def recipe(curvature: float) -> Recipe:
    effective, signals = np.array([0.1, 0.2]) * curvature, np.array([0.3, 0.4])
    return Recipe(curvature, 0.0, effective, signals, 5e-10, 4e-9, 16, stamp_ns=BUILT)


ASTIGMATISM = replace(recipe(0.0), zernike=(*5 * (0.0,), 2e-7, *15 * (0.0,)))
FOLLOWED = replace(recipe(0.02), by_model=np.array([0.5, 0.6]), stamp_ns=BUILT + 1)
BOOK = RecipeBook((recipe(-0.01), FOLLOWED, ASTIGMATISM), 100, 3e-10)


def test_a_hysteresis_comes_back() -> None:
    back = hysteresis_from(hysteresis_columns(HYSTERESIS))
    assert back is not None
    assert (back.name, back.maps, back.remarks) == (HYSTERESIS.name, HYSTERESIS.maps, HYSTERESIS.remarks)
    assert (back.held_out_max_zernike, back.unknown_sigma) == (
        HYSTERESIS.held_out_max_zernike,
        HYSTERESIS.unknown_sigma,
    )
    np.testing.assert_array_equal(back.zernike_sigma, HYSTERESIS.zernike_sigma)
    for name in ("play_radius", "play_weight", "duhem_slope", "duhem_weight", "creep_rate", "creep_time"):
        np.testing.assert_array_equal(getattr(back.law, name), getattr(HYSTERESIS.law, name))


def test_recipes_come_back() -> None:
    back = recipes_from(recipe_columns(BOOK))
    assert (back.degauss_steps, back.interpolation_error) == (100, 3e-10)
    for one, other in zip(back.recipes, BOOK.recipes, strict=True):
        assert (one.shape, one.max_zernike, one.maps, one.stamp_ns) == (
            other.shape,
            other.max_zernike,
            other.maps,
            other.stamp_ns,
        )
        np.testing.assert_array_equal(one.effective, other.effective)
        np.testing.assert_array_equal(one.by_model, other.by_model)
    before = recipe_columns(RecipeBook(BOOK.recipes[:2], 100, 0.0))
    del before["recipes/zernike"], before["recipes/by_model"]  # as files were before recipes had these
    before["recipes/stamp_ns"] = np.array(BUILT)
    older = recipes_from(before).recipes
    assert [(one.shape, one.stamp_ns) for one in older] == [(one.shape, BUILT) for one in BOOK.recipes[:2]]


def test_files_without_them_are_read() -> None:
    assert hysteresis_from({}) is None
    assert recipes_from({}) is NO_RECIPES
    assert hysteresis_columns(None) == {} and recipe_columns(NO_RECIPES) == {}


def test_figures_that_are_no_numbers_are_refused() -> None:
    columns = hysteresis_columns(HYSTERESIS)
    columns["memory/zernike_sigma"] = np.array([np.nan])
    with pytest.raises(ValueError, match="must be finite"):
        hysteresis_from(columns)


def test_recipes_of_another_condition_are_not_merged() -> None:
    with pytest.raises(RecipeError, match="degauss_steps = 50"):
        BOOK.merged(RecipeBook((recipe(0.03),), 50, 0.0))
    newer = RecipeBook((recipe(0.03), replace(ASTIGMATISM, maps=2)), 100, 0.0)
    assert [(r.curvature, r.maps) for r in BOOK.merged(newer).recipes] == [
        (-0.01, 16),
        (0.02, 16),
        (0.03, 16),
        (0.0, 2),
    ]
