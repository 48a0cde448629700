"""Building recipes on the bench: condition the mirror, go to the shape, measure, correct, and begin again.

Knows no ROS. Every round begins with a degauss, since a recipe holds only from that condition. Its maps are averaged
until the mean is accurate enough. Meanwhile creep goes on, and the electronics quantise. The hysteresis model gives the
deviation of the effective signals from the wanted ones at each map, and the influence function its effect, which is
subtracted. What remains of a map is the model's defect at the effective signals of the shape. The defect of the next
shape is estimated from all rounds so far (`converge.defects`), so most shapes are right at once and take a single
round, the one that re-measures them. In the end each recipe uses its neighbours' maps too.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dm_common import Floats
from dm_common.errors import Cancelled, beside
from dm_common.hysteresis.model import HysteresisState
from dm_common.measurement import Bench
from dm_common.recipes import NO_RECIPES, Recipe, RecipeBook, shape_text
from dm_controller.converge.defects import Defects, agreeing_maps, mean_of
from dm_controller.planning.mirror_model import response, target_shape
from dm_controller.planning.planner import Planner
from dm_controller.planning.recipes import Corrections, FoundRecipe, UnreachableError, target_of
from dm_controller.planning.target import FocusTarget
from dm_controller.solvers.base import Shape, measured_shape, rms_sag

#: Largest deviation of an effective signal, due to a limit, at which a recipe still stores those aimed at, not reached.
MISS_IGNORED = 1e-3
#: A round ends once the standard error of its mean is this share of the tolerance; fewest maps to find that error from.
SURE_SHARE, MAPS_MIN = 0.2, 3
#: Share of the tolerance above what a perfect correction leaves at which nothing is left to correct.
ENOUGH_SHARE = 0.5


@dataclass(frozen=True)
class BuildOptions:
    """When a recipe is good enough.

    Attributes:
        tolerance: largest coefficient error beyond tilt, m, re-measured.
        maps_max: most maps of one recipe: at least one round to correct by and one to re-measure.
        average: most maps of one round; fewer than 2 do not show the noise.
        settle_time: s after the move at which the shape is to be right.
        reachable: largest coefficient error, m, that limits may leave in a shape set after the degauss.
    """

    tolerance: float = 6.3e-10
    maps_max: int = 32
    average: int = 8
    settle_time: float = 0.5
    reachable: float = 2e-8


@dataclass(frozen=True)
class BuildStep:
    """Progress after one map.

    Attributes:
        curvature: 1/m, of the recipe.
        maps: taken for it so far.
        recipes: built before it.
        max_zernike, rms: m, of the mean of the round so far: largest coefficient error beyond tilt, sag error.
    """

    curvature: float
    maps: int
    recipes: int
    max_zernike: float
    rms: float


@dataclass(frozen=True, eq=False)
class _Round:
    """Maps of one round, averaged.

    Attributes:
        target, signals: what was wanted, and (N,) what was written.
        aim: (N,) effective signals of the shape.
        defect: measured less predicted surface at `aim`.
        maps: taken.
    """

    target: FocusTarget
    signals: Floats
    aim: Floats
    defect: Shape
    maps: int


class RecipeBuilder:
    """Builds recipes one after the other on one mirror.

    Args:
        loop: plans moves; without a hysteresis model its effective signals are signals.
        now: returns the time, s, of the clock that maps are stamped with.
        state: of the actuators now, of which the degauss leaves the creep; None = demagnetised, long at mid range.
        on_step: called after each map; `cancelled` before each.

    Attributes:
        maps, left_out: taken altogether, and those of them that contradicted the others of their round.
    """

    def __init__(
        self,
        loop: Planner,
        plant: Bench,
        now: Callable[[], float],
        options: BuildOptions | None = None,
        *,
        state: HysteresisState | None = None,
        on_step: Callable[[BuildStep], None] = lambda step: None,
        cancelled: Callable[[], bool] = lambda: False,
    ) -> None:
        self._loop, self._plant, self._now = loop, plant, now
        self._options = options or BuildOptions()
        self._on_step, self._cancelled = on_step, cancelled
        limits, model = loop.mirror.limits, loop.mirror.model
        self._middle = limits.middle
        actuators = model.influence_zernike.shape[1]
        self.state = state if state is not None else loop.law.demagnetised(actuators, now(), self._middle)
        self.maps = self.left_out = 0
        self._defects = Defects(model)
        self._built: list[tuple[_Round, int]] = []

    def build(self, target: FocusTarget) -> Recipe:
        """The recipe for `target`, as it is known now.

        Raises:
            TargetError: no such surface exists over the aperture.
            UnreachableError: the limits do not allow the shape.
            Cancelled: `cancelled()` became true.
            Refusal, ValueError: the bench failed, or its maps are of another kind than the calibration's.
        """
        options = self._options
        aim, maps = self._solve(target, None), 0
        while True:
            aim = self._solve(target, aim)
            taken = self._measure_round(target, aim, maps)
            maps += taken.maps
            aim = taken.aim
            error = self._error(taken).max_zernike
            enough = max(options.tolerance, self._least(taken) + ENOUGH_SHARE * options.tolerance)
            if error <= enough or maps + options.average > options.maps_max:
                self._built.append((taken, maps))
                return self._recipe(taken, maps)

    @property
    def recipes(self) -> tuple[Recipe, ...]:
        """The recipes built, in order, from all that was measured so far.

        Their errors are those of each shape's last round, whose signals were found before it, so they are unbiased.
        """
        return tuple(self._recipe(taken, maps) for taken, maps in self._built)

    def _recipe(self, taken: _Round, maps: int) -> Recipe:
        """From all that was measured so far; `taken` is the last round of its shape, and `maps` counts all its maps."""
        error = self._error(taken)
        return Recipe(
            curvature=taken.target.curvature,
            conic_constant=taken.target.conic_constant,
            effective=self._solve(taken.target, taken.aim),
            signals=taken.signals,
            max_zernike=error.max_zernike,
            rms=rms_sag(error, self._loop.mirror.model),
            maps=maps,
            zernike=taken.target.zernike,
        )

    def _error(self, taken: _Round) -> Shape:
        """The surface measured in a round, minus the wanted one."""
        return self._predicted(taken.aim) + taken.defect - target_shape(taken.target, self._loop.mirror.model)

    def _least(self, taken: _Round) -> float:
        """The error (m) that limits and number of actuators leave even of a perfect correction."""
        mirror = self._loop.mirror
        wanted, tilt = mirror.wanted(taken.target)
        best = mirror.solve(mirror.rows(wanted - taken.defect, tilt))
        return float(self._error(replace(taken, aim=best)).max_zernike)

    def _solve(self, target: FocusTarget, near: Floats | None) -> Floats:
        """(N,) effective signals for `target` on a mirror with the defect at `near` (N,); None = without a defect."""
        mirror = self._loop.mirror
        wanted, tilt = mirror.wanted(target)
        change = wanted if near is None else wanted - self._defects.at(near)
        return mirror.solve(mirror.rows(change, tilt))

    def _predicted(self, effective: Floats) -> Shape:
        model = self._loop.mirror.model
        return model.offset + response(model, effective)

    def _go(self, target: FocusTarget, aim: Floats) -> tuple[Floats, Floats]:
        """Condition the mirror and move it to the effective signals `aim`.

        Returns:
            (N,) signals written, and (N,) the effective signals to keep: `aim`, or what the limits allow instead.
        """
        law, plant, settle_time = self._loop.law, self._plant, self._options.settle_time
        self._stop_if_cancelled()
        began = self._now()
        plant.degauss()
        # During the swings about the middle, creep follows the middle.
        self.state = law.advance(law.degaussed(self.state, began, self._middle), self._now())
        move = self._loop.plan(target, self.state, self._now(), recipe=FoundRecipe(aim), ahead=settle_time)
        applied = plant.apply(move.signals)
        self.state = law.move(self.state, applied, self._now())
        missed = law.effective(law.advance(self.state, self._now() + settle_time)) - aim
        worst, denied = int(np.abs(missed).argmax()), response(self._loop.mirror.model, missed).max_zernike
        if denied > (allowed := self._options.reachable):
            raise UnreachableError(
                f"curvature = {target.curvature:+.4f} 1/m: actuator {worst + 1} stands at its limit and misses its "
                f"effective signal by {abs(missed[worst]):.4f}, which leaves a coefficient error of "
                f"{beside('.1f', denied * 1e9, allowed * 1e9)} nm (allowed {allowed * 1e9:g} nm): no recipe reaches it"
            )
        if not plant.settle():
            raise Cancelled("cancelled while settling")
        return applied, aim if abs(missed[worst]) <= MISS_IGNORED else aim + missed

    def _measure_round(self, target: FocusTarget, aim: Floats, before: int) -> _Round:
        model, law, options = self._loop.mirror.model, self._loop.law, self._options
        signals, aim = self._go(target, aim)
        defects = list[Shape]()
        while True:
            self._stop_if_cancelled()
            if defects:
                self._hold(aim)
            number = len(defects) + 1
            measured = self._plant.measure(f"recipe {shape_text(target)} {before + number}")
            self.maps += 1
            surface = measured_shape(measured.coefficients, measured.sag, model)
            # The time of the map by its stamp, limited to the time between the last state and now.
            seen = min(max(1e-9 * measured.stamp_ns, self.state.time), self._now())
            defects.append(surface - self._predicted(law.effective(law.advance(self.state, seen))))
            agreeing = agreeing_maps(defects)
            taken = _Round(target, signals, aim, mean_of(agreeing), number)
            error = self._error(taken)
            maps, built = before + number, len(self._built)
            self._on_step(BuildStep(target.curvature, maps, built, error.max_zernike, rms_sag(error, model)))
            sure = number >= MAPS_MIN and self._defects.spread(agreeing) <= SURE_SHARE * options.tolerance
            if sure or number == options.average:
                break
        self.left_out += len(defects) - len(agreeing)
        self._defects.add(aim, agreeing)
        self.state = law.advance(self.state, self._now())
        return taken

    def _hold(self, aim: Floats) -> None:
        """Correct the shape for creep as any held shape is, so that the law's error in creep is part of the recipe."""
        law = self._loop.law
        if not law.has_history:
            return
        applied = self._plant.apply(self._loop.hold(self.state, self._now(), aim))
        self.state = law.move(self.state, applied, self._now())

    def _stop_if_cancelled(self) -> None:
        if self._cancelled():
            raise Cancelled("cancelled")


def recipe_book(
    recipes: Sequence[Recipe], loop: Planner, degauss_steps: int, stamp_ns: int, before: RecipeBook = NO_RECIPES
) -> RecipeBook:
    """Recipes of one run as a book; its interpolation error is that of these together with the recipes `before`.

    Args:
        loop: planner of the present calibration, which the recipes' own maps may have updated meanwhile.

    Raises:
        RecipeError: the recipes `before` begin with another degauss.
    """
    radius = loop.mirror.model.aperture_radius
    models = [loop.mirror.command(target_of(recipe, radius))[0] for recipe in recipes]
    known = [replace(recipe, by_model=own, stamp_ns=stamp_ns) for recipe, own in zip(recipes, models, strict=True)]
    ordered = sorted(known, key=lambda recipe: recipe.shape)
    book = RecipeBook(tuple(ordered), degauss_steps, 0.0)
    whole = before.merged(book)
    between = Corrections(whole, loop).worst - max(recipe.max_zernike for recipe in whole.recipes)
    return replace(book, interpolation_error=between)
