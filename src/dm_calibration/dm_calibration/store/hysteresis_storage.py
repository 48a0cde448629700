"""Conversion of hysteresis model and recipes to and from datasets of a calibration file."""

from collections.abc import Mapping
from dataclasses import MISSING, fields, replace
from typing import Any

import numpy as np

from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit
from dm_calibration.store.hdf5_image import Column
from dm_common.hysteresis.model import HysteresisModel
from dm_common.optics.zernike import TERMS
from dm_common.recipes import NO_RECIPES, Recipe, RecipeBook

#: Columns that recipes have in files of every version, one row each.
_RECIPE_COLUMNS = tuple(field.name for field in fields(Recipe) if field.name not in ("zernike", "by_model", "stamp_ns"))
#: Scalar fields of the recipe book.
_BOOK = tuple(field.name for field in fields(RecipeBook) if field.name != "recipes")


def hysteresis_columns(hysteresis: HysteresisFit | None) -> dict[str, Column]:
    """Datasets of a hysteresis model; none without one."""
    if hysteresis is None:
        return {}
    columns: dict[str, Column] = {
        "memory/name": (hysteresis.name,),
        "memory/remarks": hysteresis.remarks,
        "memory/zernike_sigma": hysteresis.zernike_sigma,
        "memory/figures": np.array([hysteresis.held_out_max_zernike, hysteresis.unknown_sigma, hysteresis.maps]),
    }
    for field in fields(HysteresisModel):
        columns[f"memory/law/{field.name}"] = np.asarray(getattr(hysteresis.law, field.name), dtype=np.float64)
    return columns


def hysteresis_from(columns: Mapping[str, Column]) -> HysteresisFit | None:
    """The hysteresis model in the datasets of a file; None when it has none.

    Raises:
        KeyError, ValueError: something is missing or invalid.
    """
    if "memory/name" not in columns:
        return None
    values: dict[str, Any] = {}
    for field in fields(HysteresisModel):
        older = field.default is not MISSING or field.default_factory is not MISSING
        if older and f"memory/law/{field.name}" not in columns:
            continue  # an older file, written before this field existed
        value = np.asarray(columns[f"memory/law/{field.name}"], dtype=np.float64)
        values[field.name] = value if value.ndim else float(value)
    held_out, unknown, maps = np.asarray(columns["memory/figures"], dtype=np.float64)
    sigma = np.asarray(columns["memory/zernike_sigma"], dtype=np.float64)
    if not (np.isfinite(sigma).all() and np.isfinite([held_out, unknown, maps]).all()):
        raise ValueError("memory/zernike_sigma and memory/figures: must be finite")
    name, remarks = _texts(columns, "memory/name"), _texts(columns, "memory/remarks")
    return HysteresisFit(name[0], HysteresisModel(**values), sigma, float(held_out), float(unknown), int(maps), remarks)


def recipe_columns(book: RecipeBook) -> dict[str, Column]:
    """Datasets of a recipe book; none when it is empty."""
    if not book.recipes:
        return {}
    columns: dict[str, Column] = {
        f"recipes/{name}": np.array([getattr(recipe, name) for recipe in book.recipes]) for name in _RECIPE_COLUMNS
    }
    columns["recipes/zernike"] = np.array([recipe.zernike or len(TERMS) * (0.0,) for recipe in book.recipes])
    known = [recipe.by_model if recipe.by_model.size else np.nan * recipe.effective for recipe in book.recipes]
    columns["recipes/by_model"] = np.array(known)
    columns["recipes/stamp_ns"] = np.array([recipe.stamp_ns for recipe in book.recipes])
    return columns | {f"recipes/{name}": np.array(getattr(book, name)) for name in _BOOK}


def recipes_from(columns: Mapping[str, Column]) -> RecipeBook:
    """The recipe book in the datasets of a file.

    Raises:
        KeyError, ValueError: something is missing or invalid.
    """
    if "recipes/curvature" not in columns:
        return NO_RECIPES
    rows = [np.asarray(columns[f"recipes/{name}"]) for name in _RECIPE_COLUMNS]
    zernike = np.asarray(columns.get("recipes/zernike", np.zeros((len(rows[0]), 0)))).tolist()
    by_model = np.asarray(columns.get("recipes/by_model", np.full((len(rows[0]), 1), np.nan)))
    # Older files have one time for all.
    stamps = np.broadcast_to(np.asarray(columns["recipes/stamp_ns"]), len(rows[0])).tolist()
    recipes = tuple(
        replace(
            Recipe(*(value.astype(np.float64) if value.ndim else value.item() for value in row)),
            zernike=tuple(terms),
            by_model=own if np.isfinite(own).all() else np.zeros(0),
            stamp_ns=stamp,
        )
        for row, terms, own, stamp in zip(zip(*rows, strict=True), zernike, by_model, stamps, strict=True)
    )
    return RecipeBook(recipes, *(np.asarray(columns[f"recipes/{name}"]).item() for name in _BOOK))


def _texts(columns: Mapping[str, Column], name: str) -> tuple[str, ...]:
    value = columns[name]
    if not isinstance(value, tuple):
        raise ValueError(f"{name}: must be texts")
    return value
