"""Which way to a shape: at once from where the mirror stands, or after a degauss; and what to expect of it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from dm_msgs.msg import FocusRequest

from dm_common.errors import ErrorCode, Refusal
from dm_common.hysteresis.observer import ActuatorEstimate
from dm_common.recipes import RecipeError
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.planner import Move
from dm_controller.planning.recipes import FoundRecipe, find
from dm_controller.planning.target import FocusTarget, Request, TargetError

#: A message's constants are properties of its class, which take longer to look up.
_MODES = (FocusRequest.MODE_AUTO, FocusRequest.MODE_DIRECT, FocusRequest.MODE_CONDITIONED)
_AUTO, _DIRECT, _CONDITIONED = _MODES


class PlanningContext(NamedTuple):
    """What a move depends on beside the request.

    Attributes:
        active: calibration and mirror.
        estimate: the actuators now.
        now: s, ROS time.
        settle: s after the way at which the shape is to be right.
        steps: half-swings of the degauss that conditions, 0 = as the driver does.
        degaussed: such a degauss is under way or has just ended.
        wait: s until it ends.
        degauss_time: s that a whole one takes; 0 = not known.
    """

    active: ActiveCalibration
    estimate: ActuatorEstimate
    now: float
    settle: float
    steps: int
    degaussed: bool
    wait: float
    degauss_time: float


def choose_move(request: Request, time_budget: float, context: PlanningContext) -> Move:
    """The move to the surface of `request`, by the way that its mode asks for; AUTO may take so many s.

    Raises:
        Refusal: a field makes no sense, or no recipe serves the target in the mode CONDITIONED.
    """
    mode, budget = request.mode, request.time_budget
    if mode not in _MODES:
        raise Refusal(ErrorCode.INVALID_ARGUMENT, f"mode = {mode}: must be AUTO (0), DIRECT (1) or CONDITIONED (2)")
    if not (math.isfinite(budget) and budget >= 0.0):
        raise Refusal(
            ErrorCode.INVALID_ARGUMENT, f"time_budget = {budget} s: must be 0 (= as configured) or above, and finite"
        )
    try:
        target = FocusTarget(request.curvature, request.conic_constant, request.zernike)
        if mode == _DIRECT:
            return _direct(target, context)
        if mode == _CONDITIONED:
            return _conditioned(target, context)
        return _best(target, budget or time_budget, context)
    except TargetError as error:
        raise Refusal(ErrorCode.INVALID_ARGUMENT, str(error)) from error


def _direct(target: FocusTarget, context: PlanningContext) -> Move:
    """From where the mirror stands, or will stand after the degauss under way."""
    if context.degaussed:
        return _after_degauss(target, context, None)
    estimate, planner = context.estimate, context.active.planner
    return planner.plan(target, estimate.state, context.now, estimate.known, ahead=context.settle)


def _conditioned(target: FocusTarget, context: PlanningContext) -> Move:
    """A degauss, then the recipe.

    Raises:
        Refusal: there is no recipe for it.
    """
    book = context.active.recipes
    if not book.recipes:
        raise Refusal(
            ErrorCode.NOT_SUPPORTED, "mode CONDITIONED: this calibration holds no recipes; use AUTO or DIRECT"
        )
    if context.steps != book.degauss_steps:
        raise Refusal(
            ErrorCode.CALIBRATION_MISMATCH,
            f"mode CONDITIONED: the recipes begin with a degauss of {book.degauss_steps} half-swings, not of "
            f"{context.steps} (condition.degauss_steps): build them again, or set it to 0",
        )
    try:
        recipe = find(book, target)
    except RecipeError as error:
        raise Refusal(ErrorCode.OUT_OF_RANGE, f"mode CONDITIONED: {error}") from error
    return replace(_after_degauss(target, context, recipe), mode=_CONDITIONED)


def _best(target: FocusTarget, budget: float, context: PlanningContext) -> Move:
    """The way with the smallest bound of its error among those within `budget` s."""
    direct = _direct(target, context)
    if not context.degaussed and not 0.0 < context.degauss_time <= budget:
        return direct
    ways = [direct]
    if not context.degaussed and not direct.known:
        # Even where the model cannot say by how much, a mirror whose history is known repeats better.
        fresh = _after_degauss(target, context, None)
        if fresh.duration <= budget:
            ways = [fresh]
    try:
        recipe = _conditioned(target, context)
        if context.degaussed or recipe.duration <= budget:
            ways.append(recipe)
    except Refusal:
        pass  # none serves: the other ways remain
    return min(ways, key=lambda way: way.plan.max_zernike_upper)


def _after_degauss(target: FocusTarget, context: PlanningContext, recipe: FoundRecipe | None) -> Move:
    """The move after the degauss that is under way, has just ended, or has to begin first."""
    active, estimate = context.active, context.estimate
    wait = context.wait if context.degaussed else context.degauss_time
    begin = context.now + wait
    if not context.degaussed or wait > 0.0:
        estimate = estimate.after_degauss(active.planner.law, active.calibration.actuators, begin, active.middle)
    move = active.planner.plan(
        target,
        estimate.state,
        begin,
        estimate.known,
        effective=recipe.effective if recipe is not None else None,
        ahead=context.settle,
        error=recipe.error if recipe is not None else None,
    )
    return replace(move, duration=wait + move.duration, degauss=None if context.degaussed else context.steps)


def check_reachable(move: Move, active: ActiveCalibration, tolerance: float) -> None:
    """Raise Refusal when the limits leave a larger coefficient error than `tolerance` (m)."""
    if move.max_zernike <= tolerance:
        return
    low, high = active.reachable_range(move.target, tolerance)
    if math.isnan(low):
        text = "no curvature is reachable with these added Zernike terms"
    else:
        text = f"reachable: {low:+.4f} to {high:+.4f} 1/m ({2 * low:+.3f} to {2 * high:+.3f} dioptre)"
    raise Refusal(
        ErrorCode.UNREACHABLE,
        f"curvature = {move.target.curvature:+.4f} 1/m: the limits of the actuators leave a coefficient error "
        f"of {move.max_zernike * 1e9:.1f} nm (allowed {tolerance * 1e9:.1f} nm); {text}",
    )
