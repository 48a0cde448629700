"""Corrections that recipes give for a shape: what the model misses there, and how reliable they are.

A recipe shows by how much the model's effective signals err for one shape; for nearby shapes they err about as much.
Corrections are samples of a field over effective signals whose differences grow with the root of the distance, as those
of a random walk do. Its best linear estimate (kriging: Matheron 1963; Gaussian process regression with the exponential
covariance) serves every shape near recipes, of whatever kind. The size of the field follows from the error that the
model promises, and from the recipes: their corrections, and the error of predicting each from the others.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, pairwise

import numpy as np

from dm_common import Floats
from dm_common.errors import CodedError, ErrorCode, Refusal, size_text
from dm_common.optics.zernike import PISTON_TILT, TERMS
from dm_common.recipes import Recipe, RecipeBook, RecipeError, shape_text, terms_text
from dm_controller.planning.planner import Planner
from dm_controller.planning.target import TARGET, FocusTarget, Shape

#: Surfaces whose coefficients differ by less than this are the same shape, m.
SAME_SHAPE = 3e-12
#: Tilt at the edge, m, that recipes may have beyond what is wanted: a few tenths of a camera's pixel.
SAME_TILT = 20e-9
#: Effective signals that differ by less than this are the same: a third of a DAC step.
SAME_SIGNALS = 1e-5
#: Correlation length: distance of effective signals, rms over actuators, at which the correlation of corrections is
#: 1/e. A sphere of 0.05 1/m and mid range are about 0.5 apart.
REACH = 1.0
#: Variance of a recipe's own error, as a share of the field's.
NUGGET = 1e-3
#: Largest share of the variance that recipes may leave; above it they do not serve a shape.
LEFT_MAX = 0.5
#: Error of repeating a conditioned shape, as a share of the model's error on held-out moves.
REPEAT_SHARE = 0.3
#: Recipes with weights below this share of the largest do not count as measured nearby.
SLIGHT = 0.2


@dataclass(frozen=True, eq=False)
class FoundRecipe:
    """The effective signals for a shape from the conditioned mirror.

    Attributes:
        effective: (N,) effective signals.
        error: m, 95 % bound of the largest coefficient error without creep: as re-measured at the recipes used, plus
            the possible change of the correction away from them; infinite = not measured.
        built: s, when the run that built the oldest of the recipes used had ended; 0 = not known.
    """

    effective: Floats
    error: float = math.inf
    built: float = 0.0


class Kriging:
    """The best linear estimate of a field of unit variance from samples at `places` (R, N), effective signals, with
    `noise` (R,), the variance of each.
    """

    def __init__(self, places: Floats, noise: Floats) -> None:
        self._places = places
        self._inverse = np.linalg.inv(_alike(places[:, None], places) + np.diag(noise))

    def at(self, place: Floats) -> tuple[Floats, float]:
        """Weights (R,) of the samples at `place` (N,), and the variance that remains."""
        alike = _alike(place, self._places)
        weights = alike @ self._inverse
        return weights, max(1.0 - float(weights @ alike), 0.0)

    def left_out(self, values: Floats) -> tuple[Floats, Floats]:
        """Error of predicting each sample of `values` (R, N) from the others, and (R,) the variance that remains."""
        left = 1.0 / np.diag(self._inverse)
        return left[:, None] * (self._inverse @ values), left


def _alike(one: Floats, other: Floats) -> Floats:
    """(..., R) correlation between effective signals (..., N) and (R, N)."""
    return np.asarray(np.exp(-np.sqrt(np.square(one - other).mean(axis=-1)) / REACH))


class Corrections:
    """The corrections that the recipes of `book` show on the mirror of `planner`.

    Args:
        checked_ns: when a map last agreed with the calibration; its updates since a recipe was built shift that recipe
            too. Recipes built later stay as measured, even if earlier updates are lost.

    Raises:
        RecipeError: there are none, or as `target_of`.

    Attributes:
        amplitude: m, bound of the largest coefficient of a correction where no recipe is near.
    """

    def __init__(self, book: RecipeBook, planner: Planner, checked_ns: int = 0) -> None:
        if not book.recipes:
            raise RecipeError("there are no recipes; build them on the bench with `./dm recipes`")
        self._mirror, self._recipes = planner.mirror, (recipes := book.recipes)
        shapes = [target_of(recipe, planner.mirror.model.aperture_radius) for recipe in recipes]
        self._surfaces = np.array([self._surface(shape) for shape in shapes])
        self._effective = np.array([recipe.effective for recipe in recipes])
        now = [planner.mirror.command(shape)[0] for shape in shapes]
        known = zip(recipes, now, strict=True)
        then = np.array([r.by_model if r.by_model.size and checked_ns > r.stamp_ns else own for r, own in known])
        tilt = self._other_tilt(then)
        self._then, self._own = then + tilt, np.array(now) + tilt
        self._corrections = self._effective - self._then
        self._measured = np.array([recipe.max_zernike for recipe in recipes])
        self._kriging = Kriging(self._own, np.full(len(recipes), NUGGET))
        missed, left = self._kriging.left_out(self._corrections)
        # Nothing predicts a single recipe: its whole correction is the error. The re-measured error is counted apart.
        beyond = np.maximum(self._largest(missed) - self._measured.max(), 0.0) / np.sqrt(left)
        hysteresis, model = planner.hysteresis, planner.mirror.model
        held_out = model.held_out_max_zernike if hysteresis is None else hysteresis.held_out_max_zernike
        shown = max(float(self._largest(self._corrections).max()), float(beyond.max()))
        # The largest of a few samples underestimates the largest there is.
        self.amplitude = max(planner.error_bound(known=True), shown * (1.0 + 2.0 / len(recipes)))
        self._repeat = REPEAT_SHARE * held_out

    def _other_tilt(self, own: Floats) -> Floats:
        """(R, N) effective signals of the tilt that recipes added to the model's `own` (R, N), as those built for
        another axis or while tilt was free do; 0 where corrections bring it along or a limit has cut it.
        """
        mirror, count = self._mirror, len(own)
        if mirror.tilt is None:
            return np.zeros_like(own)
        tilt, at_limit = mirror.tilt @ (self._effective - own).T, mirror.limits.at_limit
        cut = [(at_limit(one) | at_limit(other)).any() for one, other in zip(own, self._effective, strict=True)]
        tilt[:, np.array(cut) | (np.abs(tilt).max(axis=0) <= SAME_TILT)] = 0.0
        flat = Shape(np.zeros((len(TERMS), count)), np.zeros((len(mirror.model.sag_offset), count)))
        return mirror.unlimited(flat, tilt).T

    def _surface(self, target: FocusTarget) -> Floats:
        """Coefficients beyond tilt, m."""
        return target.coefficients(self._mirror.model.aperture_radius)[PISTON_TILT:]

    def _bound(self, measured: float, left: float) -> float:
        """m, for shapes near recipes with the re-measured error `measured` (m), which leave the variance `left`."""
        return measured + math.hypot(self.amplitude * math.sqrt(left), self._repeat)

    def _largest(self, effective: Floats) -> Floats:
        """(R,) m, largest coefficients beyond tilt that effective signals (R, N) make."""
        influence = self._mirror.model.influence_zernike[PISTON_TILT:]
        return np.asarray(np.abs(effective @ influence.T).max(axis=1))

    def find(self, target: FocusTarget) -> FoundRecipe:
        """The effective signals for `target`; its tilt is the model's, since no map measures that.

        Raises:
            RecipeError: it is beyond the curvatures of all recipes, or no recipe is near.
        """
        own, apart = self._mirror.command(target)[0], np.abs(self._surfaces - self._surface(target)).max(axis=1)
        if (same := np.flatnonzero(apart <= SAME_SHAPE)).size:
            changes = own - self._then[same]
            least = int(np.abs(changes).max(axis=1).argmin())
            recipe, change = int(same[least]), changes[least]
            measured = float(self._measured[recipe])
            shift, left = (0.0, 0.0) if np.abs(change).max() <= SAME_SIGNALS else (change, self._kriging.at(own)[1])
            built = 1e-9 * self._recipes[recipe].stamp_ns
            return FoundRecipe(self._effective[recipe] + shift, self._bound(measured, left), built)
        curvatures = [recipe.curvature for recipe in self._recipes]
        inside = target.with_curvature(float(np.clip(target.curvature, min(curvatures), max(curvatures))))
        if inside.deviation(target, self._mirror.model.aperture_radius) > SAME_SHAPE:
            raise RecipeError(
                f"curvature = {shape_text(target)}: outside the recipes, which are not extrapolated; there are "
                f"{self._there()}"
            )
        weights, left = self._kriging.at(own)
        if left > LEFT_MAX:
            raise RecipeError(
                f"curvature = {shape_text(target)}: no recipe is near this shape; there are {self._there()}"
            )
        near = np.abs(weights) >= SLIGHT * np.abs(weights).max()
        error = self._bound(float(self._measured[near].max()), left)
        built = 1e-9 * min(one.stamp_ns for one, used in zip(self._recipes, near, strict=True) if used)
        return FoundRecipe(own + weights @ self._corrections, error, built)

    @cached_property
    def worst(self) -> float:
        """m, bound of the largest coefficient error at recipes and halfway between neighbours."""
        lefts = [
            self._kriging.at(0.5 * (own + following))[1]
            for own, following, a, b in zip(self._own, self._own[1:], self._recipes, self._recipes[1:], strict=False)
            if a.series == b.series
        ]
        return self._bound(float(self._measured.max()), max(lefts, default=0.0))

    def _there(self) -> str:
        """The recipes there are, in words."""
        ranges = []
        for (conic, terms), alike in groupby(self._recipes, lambda recipe: recipe.series):
            curvatures = [recipe.curvature for recipe in alike]
            text = f"{len(curvatures)} from {curvatures[0]:+.4f} to {curvatures[-1]:+.4f} 1/m"
            text += f" with conic_constant = {conic:g}"
            ranges.append(f"{text}, {terms_text(terms)}" if terms else text)
        return ", ".join(ranges)


class UnreachableError(CodedError, RecipeError):
    """The limits of the actuators do not allow the shape."""

    error_code = ErrorCode.UNREACHABLE


def target_of(recipe: Recipe, radius: float) -> FocusTarget:
    """The shape that a recipe makes. Raises RecipeError if there is none such over an aperture of `radius` (m)."""
    target = FocusTarget(recipe.curvature, recipe.conic_constant, recipe.zernike)
    try:
        TARGET.check(target)
        target.check_aperture(radius)
    except Refusal as error:
        raise RecipeError(f"recipes: {error}") from error
    return target


def recipe_targets(
    curvatures: Sequence[float], conic_constant: float, zernike: Sequence[float], loop: Planner, error_max: float
) -> list[FocusTarget]:
    """The shapes to build recipes for, by rising curvature.

    Args:
        zernike: m, added terms: none, one set for all, or one set after the other for each.
        error_max: largest coefficient error, m, that the model may leave.

    Raises:
        Refusal: `zernike` is of another length, or a number is not finite.
        RecipeError: a shape asked for twice, naming it.
        UnreachableError: one out of reach.
        TargetError: no such surface exists over the aperture.
    """
    sizes = sorted({0, len(TERMS), len(TERMS) * len(curvatures)})
    if len(zernike) not in sizes:
        allowed = " or ".join(map(str, sizes))
        raise Refusal(ErrorCode.INVALID_LENGTH, f"{size_text('zernike', len(zernike))}: must have {allowed}")
    terms = np.reshape(zernike if len(zernike) else np.zeros(len(TERMS)), (-1, len(TERMS)))
    each = np.broadcast_to(terms, (len(curvatures), len(TERMS))).tolist()
    targets = [
        FocusTarget(curvature, conic_constant, tuple(added) if any(added) else ())
        for curvature, added in sorted(zip(map(float, curvatures), each, strict=True))
    ]
    for target in targets:
        TARGET.check(target)
    radius = loop.mirror.model.aperture_radius
    for one, other in pairwise(targets):
        if one.deviation(other, radius) <= SAME_SHAPE:
            raise RecipeError(f"curvatures: {shape_text(one)} is given twice: must be given once")
    for target in targets:
        left = loop.mirror.command(target)[1]
        if left > error_max:
            raise UnreachableError(target.denied(left, error_max, loop.mirror.reachable_range(target, error_max)))
    return targets
