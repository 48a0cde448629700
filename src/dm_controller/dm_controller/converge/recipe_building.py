"""Building recipes on the bench: condition the mirror, go to the shape, measure, correct, and begin again.

Knows no ROS. Every round begins with a degauss, for a recipe holds from that condition only. Its maps are averaged.
Creep goes on meanwhile and the electronics write whole steps only; the memory law says how far the effective signals
were from the wanted ones at each map, and the influence function takes that off. What remains of a map is the *defect*
of the model: measured less predicted surface at the effective signals of the shape. The defect hardly depends on small
corrections, so the maps of all rounds are averaged, and the next effective signals solve the target less the defect.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dm_common.errors import Cancelled
from dm_common.hysteresis.model import HysteresisState
from dm_common.measurement import Measurement
from dm_common.optics.zernike import PISTON_TILT
from dm_common.recipes import Recipe, RecipeBook, RecipeError
from dm_controller.converge.goals import UnreachableError
from dm_controller.planning.planner import Planner
from dm_controller.planning.recipes import interpolation_error
from dm_controller.planning.target import FocusTarget
from dm_controller.solvers.base import MISS, Floats, Shape, measured_shape, rms_sag, target_shape

#: Effective signals that a limit denies by more than this make a shape unreachable from the condition.
MISSED_MAX = 1e-3
#: Maps go on until their mean is as sure as this share of the tolerance.
SURE_SHARE = 0.1
#: No mean of maps is surer than this, m.
SIGMA_MIN = 1e-12


class ConditionedPlant(Protocol):
    """What is driven; `dm_common.measurement.Bench` is one."""

    def degauss(self) -> None:
        """Wipe the hysteresis memory over the full range and end at mid range."""

    def apply(self, signals: Floats) -> Floats:
        """Command `signals` (N,), wait until they stand, return what was written (N,)."""

    def settle(self) -> bool:
        """Wait the settle time; False when cancelled meanwhile."""

    def measure(self, label: str) -> Measurement:
        """Take one map."""


@dataclass(frozen=True)
class BuildOptions:
    """When a recipe is good enough.

    Attributes:
        tolerance: largest coefficient error beyond tilt, m, re-measured.
        maps_max: maps that one recipe may take.
        average: maps of one round.
        settle_time: s after the move at which the shape is to be right.
    """

    tolerance: float = 6.3e-10
    maps_max: int = 32
    average: int = 8
    settle_time: float = 0.5

    def __post_init__(self) -> None:
        if not (math.isfinite(self.tolerance) and self.tolerance > 0.0):
            raise ValueError(f"tolerance = {self.tolerance:g} m: must be above 0 and finite")
        if self.average < 2:
            raise ValueError(f"average = {self.average} maps: must be at least 2, or their noise is not known")
        if self.maps_max < 2 * self.average:
            raise ValueError(
                f"maps_max = {self.maps_max}: must be at least {2 * self.average}, one round of {self.average} to "
                "correct by and one to re-measure"
            )


@dataclass(frozen=True)
class BuildStep:
    """After one map.

    Attributes:
        curvature: 1/m, of the recipe.
        maps: taken for it so far.
        max_zernike, rms: m, of the mean of the round so far: largest coefficient error beyond tilt, sag error.
    """

    curvature: float
    maps: int
    max_zernike: float
    rms: float


@dataclass(frozen=True, eq=False)
class _Round:
    """Maps of one round, averaged.

    Attributes:
        aim: (N,) effective signals.
        defect: measured less predicted surface at `aim`.
        variance: (K - 3,) m^2, of the mean coefficients beyond tilt.
        maps: taken.
    """

    aim: Floats
    defect: Shape
    variance: Floats
    maps: int


class RecipeBuilder:
    """Builds recipes one after the other on one mirror.

    Args:
        loop: plans moves; without a memory its effective signals are signals.
        plant: the bench.
        now: the plant's time, s, of the clock that maps are stamped with.
        state: what the mirror remembers so far, creep above all; None = taken to be long rested at mid range.
        on_step: called after each map.
        cancelled: asked before each map.

    Attributes:
        state: what the mirror remembers now.
        maps: taken altogether.
    """

    def __init__(
        self,
        loop: Planner,
        plant: ConditionedPlant,
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
        self._middle = 0.5 * (limits.low + limits.high)
        self._offset = Shape(model.zernike_offset, model.sag_offset)
        actuators = model.influence_zernike.shape[1]
        self.state = state if state is not None else loop.law.demagnetised(actuators, now(), self._middle)
        self.maps = 0

    def build(self, target: FocusTarget) -> Recipe:
        """The recipe for `target`. Figures of the last round judge signals found before it, so they flatter nothing.

        Raises:
            TargetError: no such surface exists over the aperture.
            RecipeError: added terms.
            UnreachableError: the limits deny the shape.
            Cancelled: `cancelled()` became true.
            Refusal, ValueError: the bench failed, or its maps are of another kind than the calibration's.
        """
        if any(target.zernike):
            raise RecipeError("zernike: recipes are of plain conics, without added terms")
        model, options = self._loop.mirror.model, self._options
        wanted = target_shape(target, model)
        defect, spread = Shape(np.zeros_like(wanted.coefficients), np.zeros_like(wanted.sag)), math.inf
        rounds: list[_Round] = []
        maps = 0
        while True:
            aim = self._solve(wanted, defect)
            signals = self._go(target, aim)
            taken = self._measure_round(target, wanted, aim, maps)
            rounds.append(taken)
            maps += taken.maps
            error = self._predicted(aim) + taken.defect - wanted
            defect, variance = _pooled(rounds, self._response)
            spread = float(np.sqrt(variance.max()))
            enough = error.max_zernike <= options.tolerance and spread <= SURE_SHARE * options.tolerance
            if len(rounds) >= 2 and (enough or maps + options.average > options.maps_max):
                return Recipe(
                    curvature=target.curvature,
                    conic_constant=target.conic_constant,
                    effective=self._solve(wanted, defect),
                    signals=signals,
                    max_zernike=error.max_zernike,
                    rms=rms_sag(error, model),
                    maps=maps,
                )

    def _solve(self, wanted: Shape, defect: Shape) -> Floats:
        """(N,) effective signals for `wanted` on a mirror with this defect."""
        mirror = self._loop.mirror
        change = wanted - self._offset - defect
        return mirror.solve(mirror.rows(change.coefficients, change.sag))

    def _response(self, effective: Floats) -> Shape:
        model = self._loop.mirror.model
        return Shape(model.influence_zernike @ effective, model.influence_sag @ effective)

    def _predicted(self, effective: Floats) -> Shape:
        return self._offset + self._response(effective)

    def _go(self, target: FocusTarget, aim: Floats) -> Floats:
        """Condition the mirror and move it to the effective signals `aim`; returns the signals written."""
        law, plant = self._loop.law, self._plant
        self._stop_if_cancelled()
        began = self._now()
        plant.degauss()
        # While it swings about the middle, creep follows the middle.
        self.state = law.advance(law.degaussed(self.state, began, self._middle), self._now())
        move = self._loop.plan(target, self.state, self._now(), effective=aim, ahead=self._options.settle_time)
        applied = plant.apply(move.plan.signals)
        self.state = law.move(self.state, applied, self._now())
        missed = law.effective(law.advance(self.state, self._now() + self._options.settle_time)) - aim
        worst = int(np.abs(missed).argmax())
        if abs(missed[worst]) > MISSED_MAX:
            raise UnreachableError(
                f"curvature = {target.curvature:+.4f} 1/m: actuator {worst + 1} stands at its limit and misses its "
                f"effective signal by {abs(missed[worst]):.4f} (allowed {MISSED_MAX:g}): no recipe reaches this shape"
            )
        if not plant.settle():
            raise Cancelled("cancelled while settling")
        return applied

    def _measure_round(self, target: FocusTarget, wanted: Shape, aim: Floats, before: int) -> _Round:
        model, law = self._loop.mirror.model, self._loop.law
        coefficients, sags = [], []
        for number in range(1, self._options.average + 1):
            self._stop_if_cancelled()
            if number > 1:
                self._hold(aim)
            measured = self._plant.measure(f"recipe {target.curvature:+.4f} 1/m {before + number}")
            self.maps += 1
            surface = measured_shape(measured.coefficients, measured.sag, model)
            # A map tells when it was taken; one that does not was taken now.
            seen = min(max(1e-9 * measured.stamp_ns, self.state.time), self._now())
            effective = law.effective(law.advance(self.state, seen))
            defect = surface - self._predicted(effective)
            coefficients.append(defect.coefficients)
            sags.append(defect.sag)
            mean = Shape(np.mean(coefficients, axis=0), np.mean(sags, axis=0))
            error = self._predicted(aim) + mean - wanted
            self._on_step(BuildStep(target.curvature, before + number, error.max_zernike, rms_sag(error, model)))
        self.state = law.advance(self.state, self._now())
        scatter = np.var(np.array(coefficients)[:, PISTON_TILT:], axis=0, ddof=1)
        return _Round(aim, mean, scatter / len(coefficients), len(coefficients))

    def _hold(self, aim: Floats) -> None:
        """Keep the shape against creep as it is kept in use: what the law misses of that becomes part of the recipe."""
        law = self._loop.law
        if not law.remembers:
            return
        applied = self._plant.apply(self._loop.hold(self.state, self._now(), aim))
        self.state = law.move(self.state, applied, self._now())

    def _stop_if_cancelled(self) -> None:
        if self._cancelled():
            raise Cancelled("cancelled")


def _pooled(rounds: Sequence[_Round], response: Callable[[Floats], Shape]) -> tuple[Shape, Floats]:
    """The defect where the last round was, from all rounds, and the variance (K - 3,) m^2 of its coefficients.

    A round counts less the more maps scatter in it, and the further the shape was from the last one: of the way
    between, the actuators may miss a share (`MISS`).
    """
    last = rounds[-1]
    weights = []
    for taken in rounds:
        way = response(last.aim - taken.aim).coefficients[PISTON_TILT:]
        weights.append(1.0 / (SIGMA_MIN**2 + np.mean(taken.variance) + (MISS * np.abs(way).max()) ** 2))
    share = np.array(weights) / np.sum(weights)
    pooled = Shape(
        np.sum([w * taken.defect.coefficients for w, taken in zip(share, rounds, strict=True)], axis=0),
        np.sum([w * taken.defect.sag for w, taken in zip(share, rounds, strict=True)], axis=0),
    )
    variance = np.sum([w**2 * taken.variance for w, taken in zip(share, rounds, strict=True)], axis=0)
    return pooled, np.asarray(variance)


def recipe_book(recipes: Sequence[Recipe], loop: Planner, degauss_steps: int, stamp_ns: int) -> RecipeBook:
    """Recipes of one run (one conic constant, by rising curvature) as a book, with their error of interpolation."""
    between = interpolation_error(recipes, loop.mirror.model.influence_zernike)
    return RecipeBook(tuple(recipes), degauss_steps, between, stamp_ns)
