"""Recipes: signals that produce a shape from a defined initial state (the control-parameter database of [1]).

The initial state follows a degauss over the full range about mid range. A recipe stores the *effective* signals at
which the surface had the wanted shape; from these, the hysteresis model finds the command for any later time and state
of creep. On a mirror without an identified model they are the signals themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dm_common import Floats
from dm_common.optics.zernike import SPOKEN

#: Prefix of the limitation of a calibration that is used without some actuators; its recipes, of all, are withheld.
GOES_ON_WITHOUT = "Used without"


class RecipeError(ValueError):
    """A recipe outside its range, or made from another initial state or for another mirror."""


@dataclass(frozen=True, eq=False)
class Recipe:
    """One shape.

    Attributes:
        curvature: 1/m.
        conic_constant: as requested.
        effective: (N,) effective signals.
        signals: (N,) the command when it was built.
        max_zernike, rms: m, re-measured: largest coefficient error beyond tilt, sag error.
        maps: number of maps taken to find it.
        zernike: m, added sag, as requested; () = none.
        by_model: (N,) effective signals that the calibration gave for the shape when the recipe was built, so that
            later changes of the calibration can shift the recipe; empty = not known.
        stamp_ns: when it was built.
    """

    curvature: float
    conic_constant: float
    effective: Floats
    signals: Floats
    max_zernike: float
    rms: float
    maps: int
    zernike: tuple[float, ...] = ()
    by_model: Floats = field(default_factory=lambda: np.zeros(0))
    stamp_ns: int = 0

    @property
    def series(self) -> tuple[float, tuple[float, ...]]:
        """Conic constant and added terms: shapes of one series differ in curvature alone."""
        return self.conic_constant, self.zernike if any(self.zernike) else ()

    @property
    def shape(self) -> tuple[float, tuple[float, ...], float]:
        """Series and curvature, which identify a recipe among all."""
        return *self.series, self.curvature


@dataclass(frozen=True, eq=False)
class RecipeBook:
    """Recipes of one calibration.

    Attributes:
        recipes: by rising conic constant, added terms, curvature.
        degauss_steps: half-swings of the degauss before each; kept when recipes are withheld.
        interpolation_error: m, how far the error bound halfway between two recipes exceeds the re-measured error, when
            the last recipes were built.
    """

    recipes: tuple[Recipe, ...]
    degauss_steps: int
    interpolation_error: float

    def __post_init__(self) -> None:
        shapes = [recipe.shape for recipe in self.recipes]
        if shapes != sorted(set(shapes)):
            raise RecipeError("recipes: must be sorted by conic constant, added terms and curvature, each shape once")
        if len({len(recipe.effective) for recipe in self.recipes}) > 1:
            raise RecipeError("recipes: are of mirrors with different numbers of actuators")
        for recipe in self.recipes:
            count, known = len(recipe.effective), np.concatenate((recipe.effective, recipe.by_model))
            if len(recipe.signals) != count or len(known) not in (count, 2 * count) or not np.isfinite(known).all():
                raise RecipeError(f"recipe of {recipe.curvature:+.4f} 1/m: effective signals must be finite, one each")
            if not 0.0 <= recipe.max_zernike < np.inf:
                raise RecipeError(f"recipe: max_zernike = {recipe.max_zernike:g} m: must be finite and not negative")

    def check_condition(self, degauss_steps: int) -> None:
        """Raise RecipeError if these recipes begin with a degauss of another number of half-swings."""
        if self.degauss_steps and degauss_steps != self.degauss_steps:
            raise RecipeError(
                f"degauss_steps = {degauss_steps}: must be {self.degauss_steps}, as in the stored recipes "
                "(recipes.degauss_steps), or calibrate anew"
            )

    def merged(self, newer: RecipeBook) -> RecipeBook:
        """The book with recipes of `newer` in place of those of the same shape; the other fields are those of `newer`.

        Raises:
            RecipeError: the newer ones begin with another degauss.
        """
        self.check_condition(newer.degauss_steps)
        both = {recipe.shape: recipe for recipe in (*self.recipes, *newer.recipes)}
        return replace(newer, recipes=tuple(both[shape] for shape in sorted(both)))


def terms_text(zernike: Sequence[float]) -> str:
    """Added terms (m) as text: those that are not zero, in nm."""
    terms = zip(SPOKEN, zernike, strict=True) if len(zernike) else ()
    return ", ".join(f"{name} {1e9 * value:+.4g} nm" for name, value in terms if value)


def recipe_row(recipe: Any) -> tuple[str, ...]:
    """A recipe, or its message, as texts: curvature, conic constant, added terms, re-measured errors (nm), maps."""
    return (
        f"{recipe.curvature:+.4f}",
        f"{recipe.conic_constant:g}",
        terms_text(recipe.zernike) or "-",
        f"{1e9 * recipe.max_zernike:.2f}",
        f"{1e9 * recipe.rms:.2f}",
        str(recipe.maps),
    )


def terms_of(text: str) -> list[float]:
    """Added terms, m, from a text such as "astigmatism cos=200, coma sin=-50", in nm; names of SPOKEN.

    Raises:
        ValueError: an unknown or repeated term, or a value that is not a number; the message names it.
    """
    from dm_common.figures import with_point  # only commands and console parse text

    terms: dict[str, float] = {}
    for part in text.split(","):
        name, _, value = (each.strip() for each in part.partition("="))
        if name in terms:
            raise ValueError(f"zernike = {text!r}: {name} comes twice: must be given once")
        if name not in SPOKEN:
            raise ValueError(f"zernike = {text!r}: must be like 'coma sin=-50'; terms: {', '.join(SPOKEN)}")
        try:
            terms[name] = 1e-9 * float(with_point(value))
        except ValueError as error:
            raise ValueError(f"zernike = {text!r}: {value!r} is not a number of nm") from error
    return [terms.get(name, 0.0) for name in SPOKEN]


def shape_text(shape: Any) -> str:
    """The shape of a recipe, a target or a message of these, for people."""
    curvature, terms = f"{shape.curvature:+.4f} 1/m", terms_text(shape.zernike)
    return f"{curvature} with {terms}" if terms else curvature


NO_RECIPES = RecipeBook((), 0, 0.0)
