"""What to do with a focus request: which way to the shape, from where, and what to expect of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from dm_msgs.msg import FocusRequest

from dm_common.errors import ErrorCode, Refusal
from dm_common.recipes import RecipeError
from dm_controller.hysteresis_observer import Look, after_degauss
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.conversions import target_of
from dm_controller.planning.planner import Move
from dm_controller.planning.recipes import FoundRecipe, find
from dm_controller.planning.target import FocusTarget, TargetError

#: A message's constants are properties of its class, which take longer to look up.
_MODES = (FocusRequest.MODE_AUTO, FocusRequest.MODE_DIRECT, FocusRequest.MODE_CONDITIONED)
_AUTO, _DIRECT, _CONDITIONED = _MODES


@dataclass(frozen=True, eq=False)
class Decision:
    """A request that was judged.

    Attributes:
        target: the wanted surface.
        move: command, prediction and what to hold.
        mode: FocusRequest.MODE_DIRECT or MODE_CONDITIONED.
        condition: half-swings of the degauss to begin with, 0 = as the driver does; None = go at once.
        duration: s until the shape stands.
        look: the mirror as it was, or will be after that degauss.
    """

    target: FocusTarget
    move: Move
    mode: int
    condition: int | None
    duration: float
    look: Look
    _find_range: Callable[[], tuple[float, float]]

    @cached_property
    def reachable(self) -> tuple[float, float]:
        """1/m, for this conic constant and these added terms; found when first asked for."""
        return self._find_range()


class PlanningContext(NamedTuple):
    """What a decision depends on beside the request.

    Attributes:
        use: calibration and mirror.
        look: the mirror now.
        now: s, ROS time.
        conditioned: half-swings of a degauss that has just ended or is under way, 0 = as the driver does; None = none.
        wait: s until that one ends.
        degauss_time: s that a degauss of so many half-swings takes; 0 = not known.
    """

    use: ActiveCalibration
    look: Look
    now: float
    conditioned: int | None
    wait: float
    degauss_time: Callable[[int], float]


def condition_steps(use: ActiveCalibration, configured: int) -> int:
    """Half-swings of the degauss that conditions: as `configured`, else as the recipes were built; 0 = the driver's."""
    return configured or (use.recipes.degauss_steps if use.recipes.recipes else 0)


def decide(request: FocusRequest, situation: PlanningContext, values: Mapping[str, Any]) -> Decision:
    """Judge a request: everything that can be known before anything moves. `values`: the node's parameters.

    Raises:
        Refusal: the request makes no sense, or no recipe serves it in the mode CONDITIONED.
    """
    use = situation.use
    budget = _budget(request, values)
    try:
        target = target_of(request)
        steps = condition_steps(use, values["condition.degauss_steps"])
        if situation.conditioned is not None:
            steps = situation.conditioned
        options = _Options(situation, target, values["reachable_tolerance"], steps, values["settle_time"])
        if request.mode == _DIRECT:
            return options.direct()
        if request.mode == _CONDITIONED:
            return options.conditioned()
        return options.best(budget)
    except TargetError as error:
        raise Refusal(ErrorCode.INVALID_ARGUMENT, str(error)) from error


def _budget(request: FocusRequest, values: Mapping[str, Any]) -> float:
    if request.mode not in _MODES:
        raise Refusal(
            ErrorCode.INVALID_ARGUMENT, f"mode = {request.mode}: must be AUTO (0), DIRECT (1) or CONDITIONED (2)"
        )
    if not (math.isfinite(request.time_budget) and request.time_budget >= 0.0):
        raise Refusal(
            ErrorCode.INVALID_ARGUMENT,
            f"time_budget = {request.time_budget} s: must be 0 (= as configured) or above, and finite",
        )
    return float(request.time_budget or values["time_budget"])


@dataclass(frozen=True, eq=False)
class _Options:
    """The ways to one target."""

    situation: PlanningContext
    target: FocusTarget
    tolerance: float
    steps: int
    settle: float

    def direct(self) -> Decision:
        """From where the mirror stands, or will stand after the degauss under way."""
        situation = self.situation
        if situation.conditioned is not None:
            return self._decision(FocusRequest.MODE_DIRECT, None)
        look, loop = situation.look, situation.use.loop
        move = loop.plan(self.target, look.state, situation.now, look.known, ahead=self.settle)
        duration = move.duration + self.settle
        return Decision(self.target, move, _DIRECT, None, duration, look, self._range)

    def _range(self) -> tuple[float, float]:
        return self.situation.use.reachable_range(self.target, self.tolerance)

    def conditioned(self) -> Decision:
        """A degauss, then the recipe.

        Raises:
            Refusal: there is no recipe for it.
        """
        book = self.situation.use.recipes
        if not book.recipes:
            raise Refusal(
                ErrorCode.NOT_SUPPORTED, "mode CONDITIONED: this calibration holds no recipes; use AUTO or DIRECT"
            )
        if self.steps != book.degauss_steps:
            raise Refusal(
                ErrorCode.CALIBRATION_MISMATCH,
                f"mode CONDITIONED: the recipes begin with a degauss of {book.degauss_steps} half-swings, not of "
                f"{self.steps} (condition.degauss_steps): build them again, or set it to 0",
            )
        try:
            recipe = find(book, self.target)
        except RecipeError as error:
            raise Refusal(ErrorCode.OUT_OF_RANGE, f"mode CONDITIONED: {error}") from error
        return self._decision(FocusRequest.MODE_CONDITIONED, recipe)

    def best(self, budget: float) -> Decision:
        """The way with the smallest bound of its error among those within `budget` s."""
        direct = self.direct()
        begun = self.situation.conditioned is not None
        if not begun and not 0.0 < self.situation.degauss_time(self.steps) <= budget:
            return direct
        ways = [direct]
        if not begun and not direct.look.known:
            # Even where the model cannot say by how much, a mirror whose history is known repeats better.
            fresh = self._decision(FocusRequest.MODE_DIRECT, None)
            if fresh.duration <= budget:
                ways = [fresh]
        try:
            recipe = self.conditioned()
            if begun or recipe.duration <= budget:
                ways.append(recipe)
        except Refusal:
            pass  # none serves: the other ways remain
        return min(ways, key=lambda way: way.move.plan.max_zernike_upper)

    def _decision(self, mode: int, recipe: FoundRecipe | None) -> Decision:
        """The move after a degauss."""
        situation, use = self.situation, self.situation.use
        wait, condition = situation.wait, None
        look = situation.look
        if situation.conditioned is None:
            wait, condition = situation.degauss_time(self.steps), self.steps
        if situation.conditioned is None or wait > 0.0:
            actuators = use.calibration.actuators
            look = after_degauss(use.loop.law, look, actuators, situation.now + wait, use.middle)
        move = use.loop.plan(
            self.target,
            look.state,
            situation.now + wait,
            look.known,
            effective=recipe.effective if recipe is not None else None,
            ahead=self.settle,
            error=recipe.error if recipe is not None else None,
        )
        duration = wait + move.duration + self.settle
        return Decision(self.target, move, mode, condition, duration, look, self._range)
