"""Finding a recipe: the stored one of a shape, or one interpolated over curvature from those around it.

Between recipes of one conic constant the effective signals are smooth in curvature. Which curve goes through them is
chosen by leaving each inner recipe out in turn. Beyond the outermost recipes there is none: nothing is extrapolated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator, make_interp_spline

from dm_common.optics.zernike import PISTON_TILT
from dm_common.recipes import Recipe, RecipeBook, RecipeError
from dm_controller.planning.target import FocusTarget

Floats = NDArray[np.float64]
Curve = Callable[[float], Floats]

#: Curvatures that differ less are the same shape, 1/m: over a radius of 11 mm that is 3 pm of defocus.
SAME_CURVATURE = 1e-7
#: The same for conic constants.
SAME_CONIC = 1e-9

#: Curves by name, with the fewest recipes each of them needs; the simplest first, which wins a draw.
_CURVES: dict[str, tuple[int, Callable[[Floats, Floats], Curve]]] = {
    "linear": (2, lambda x, y: make_interp_spline(x, y, k=1)),
    "monotone cubic": (3, PchipInterpolator),
    "cubic spline": (4, CubicSpline),
}


@dataclass(frozen=True, eq=False)
class FoundRecipe:
    """What makes a shape from the conditioned mirror.

    Attributes:
        effective: (N,) effective signals.
        error: m, largest coefficient error to expect: as re-measured, and where interpolated that of the worse
            neighbour and the error of interpolation together.
        interpolated: there is no recipe of this very curvature.
    """

    effective: Floats
    error: float
    interpolated: bool


def find(book: RecipeBook, target: FocusTarget) -> FoundRecipe:
    """The recipe for `target`.

    Raises:
        RecipeError: there is none: added terms, another conic constant, or a curvature outside the recipes'; naming
            field, value and range.
    """
    if any(target.zernike):
        raise RecipeError("zernike: recipes are of plain conics; ask for added terms without conditioning (DIRECT)")
    if not book.recipes:
        raise RecipeError("there are no recipes; build them on the bench with `./dm recipes`")
    recipes = _of_conic(book, target.conic_constant)
    curvatures = [recipe.curvature for recipe in recipes]
    for recipe in recipes:
        if abs(recipe.curvature - target.curvature) <= SAME_CURVATURE:
            return FoundRecipe(recipe.effective, recipe.max_zernike, False)
    low, high = curvatures[0], curvatures[-1]
    if not low < target.curvature < high:
        raise RecipeError(
            f"curvature = {target.curvature:+.4f} 1/m: recipes with conic_constant = {target.conic_constant:g} go from "
            f"{low:+.4f} to {high:+.4f} 1/m and are not extrapolated"
        )
    above = int(np.searchsorted(curvatures, target.curvature))
    worse = max(recipes[above - 1].max_zernike, recipes[above].max_zernike)
    effective = np.asarray(_curve(book, target.conic_constant)(target.curvature), dtype=np.float64)
    return FoundRecipe(effective, worse + book.interpolation_error, True)


def interpolation_error(recipes: Sequence[Recipe], influence_zernike: Floats) -> float:
    """Largest coefficient error of a recipe interpolated from the others, m; 0 with fewer than three.

    Each inner recipe is left out in turn, so gaps are twice as wide as in use: on the safe side.

    Args:
        recipes: of one conic constant, by rising curvature.
        influence_zernike: (K, N) m per unit of effective signal.
    """
    if len(recipes) < 3:
        return 0.0
    missed = _left_out(recipes, _best_curve(recipes))
    return float(np.abs(missed @ influence_zernike[PISTON_TILT:].T).max())


def _of_conic(book: RecipeBook, conic_constant: float) -> list[Recipe]:
    recipes = [r for r in book.recipes if abs(r.conic_constant - conic_constant) <= SAME_CONIC]
    if not recipes:
        there = ", ".join(f"{conic:g}" for conic in sorted({r.conic_constant for r in book.recipes}))
        raise RecipeError(f"conic_constant = {conic_constant:g}: there are recipes of {there} only")
    return recipes


@lru_cache(maxsize=16)
def _curve(book: RecipeBook, conic_constant: float) -> Curve:
    """(N,) effective signals over curvature, by the curve that predicts recipes left out best."""
    recipes = _of_conic(book, conic_constant)
    return _through(recipes, _best_curve(recipes))


def _best_curve(recipes: Sequence[Recipe]) -> str:
    """Name of the curve whose prediction of recipes left out is best."""
    # One recipe is left out for the choice, so a curve must do with one fewer.
    able = [name for name, (fewest, _) in _CURVES.items() if len(recipes) - 1 >= fewest]
    if len(able) < 2:
        return "linear"
    return min(able, key=lambda name: float(np.linalg.norm(_left_out(recipes, name))))


def _left_out(recipes: Sequence[Recipe], name: str) -> Floats:
    """(M - 2, N) what a curve through the others misses of each inner recipe."""
    rows = []
    for k in range(1, len(recipes) - 1):
        others = [*recipes[:k], *recipes[k + 1 :]]
        rows.append(_through(others, name)(recipes[k].curvature) - recipes[k].effective)
    return np.array(rows)


def _through(recipes: Sequence[Recipe], name: str) -> Curve:
    curvature = np.array([recipe.curvature for recipe in recipes])
    return _CURVES[name][1](curvature, np.array([recipe.effective for recipe in recipes]))


__all__ = ["FoundRecipe", "RecipeError", "find", "interpolation_error"]
