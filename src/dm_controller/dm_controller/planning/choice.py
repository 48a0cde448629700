"""The choice between two ways to a shape: at once from the present state, or after a degauss."""

from dataclasses import replace
from typing import NamedTuple

from dm_msgs.msg import FocusRequest

from dm_common.errors import ErrorCode, Refusal
from dm_common.hysteresis.observer import ActuatorEstimate
from dm_common.recipes import RecipeError
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.planner import Move
from dm_controller.planning.recipes import FoundRecipe
from dm_controller.planning.target import FocusTarget


class Degauss(NamedTuple):
    """The degauss that a move can begin with.

    Attributes:
        steps: half-swings, 0 = as the driver does.
        begun: it is under way or has just ended.
        wait: s until it ends, from its beginning if it has not begun; 0 = it has ended, or not known.
    """

    steps: int
    begun: bool
    wait: float


class PlanningContext(NamedTuple):
    """What a move depends on beside the request.

    Attributes:
        active: calibration and mirror.
        estimate: the actuators now.
        now: s, ROS time.
        settle: s after the end of the move at which the shape is to be right.
        degauss: the one that a move can begin with.
    """

    active: ActiveCalibration
    estimate: ActuatorEstimate
    now: float
    settle: float
    degauss: Degauss


def choose_move(target: FocusTarget, mode: str, budget: float, context: PlanningContext) -> Move:
    """The move to `target` by the way that the mode of a request asks for; `auto` may take `budget` s.

    Raises:
        Refusal: no recipe serves the target in the mode conditioned.
    """
    if mode == FocusRequest.MODE_CONDITIONED:
        return _conditioned(target, context)
    if mode == FocusRequest.MODE_DIRECT:
        return _unconditioned(target, context)
    return _best(target, budget, context)


def _unconditioned(target: FocusTarget, context: PlanningContext) -> Move:
    """A move from the present state, or from that after the degauss under way."""
    if context.degauss.begun:
        return _after_degauss(target, context, None)
    estimate, planner = context.estimate, context.active.planner
    return planner.plan(target, estimate.state, context.now, estimate.known, ahead=context.settle)


def _conditioned(target: FocusTarget, context: PlanningContext) -> Move:
    """A degauss, then the recipe.

    Raises:
        Refusal: there is no recipe for it.
    """
    book, degauss = context.active.recipes, context.degauss
    if not book.recipes:
        withheld = "the recipes are withheld: maps disagree, or an actuator does not follow"
        there = withheld if book.degauss_steps else "this calibration holds no recipes"
        raise Refusal(ErrorCode.NOT_SUPPORTED, f"mode conditioned: {there}; use auto or direct")
    if degauss.steps != book.degauss_steps:
        raise Refusal(
            ErrorCode.CALIBRATION_MISMATCH,
            f"mode conditioned: the recipes begin with a degauss of {book.degauss_steps} half-swings, not of "
            f"{degauss.steps} (condition.degauss_steps): build them again, or set it to 0",
        )
    try:
        recipe = context.active.corrections.find(target)
    except RecipeError as error:
        raise Refusal(ErrorCode.OUT_OF_RANGE, f"mode conditioned: {error}") from error
    return replace(_after_degauss(target, context, recipe), mode=FocusRequest.MODE_CONDITIONED)


def _best(target: FocusTarget, budget: float, context: PlanningContext) -> Move:
    """The way with the smallest bound of its error among those within `budget` s."""
    degauss, ways = context.degauss, [_unconditioned(target, context)]
    if not degauss.begun:
        if not 0.0 < degauss.wait <= budget:
            return ways[0]
        if not ways[0].known:
            # Even if the model cannot say by how much, a mirror with a known history repeats better.
            fresh = _after_degauss(target, context, None)
            if fresh.duration <= budget:
                ways = [fresh]
    try:
        recipe = _conditioned(target, context)
        if degauss.begun or recipe.duration <= budget:
            ways.append(recipe)
    except Refusal:
        pass  # no recipe serves: the other ways remain
    # A single way needs no prediction before its command is sent.
    return ways[0] if len(ways) == 1 else min(ways, key=lambda way: way.plan.max_zernike_upper)


def _after_degauss(target: FocusTarget, context: PlanningContext, recipe: FoundRecipe | None) -> Move:
    """The move after the degauss that is under way, has just ended, or has to begin first."""
    active, estimate, degauss = context.active, context.estimate, context.degauss
    begin = context.now + degauss.wait
    if not degauss.begun or degauss.wait > 0.0:
        law, actuators = active.planner.law, active.calibration.actuators
        estimate = estimate.after_degauss(law, actuators, context.now, begin, active.middle)
    move = active.planner.plan(
        target,
        estimate.state,
        begin,
        estimate.known,
        ahead=context.settle,
        recipe=recipe,
    )
    return replace(move, duration=degauss.wait + move.duration, degauss=None if degauss.begun else degauss.steps)


def unreachable(move: Move, active: ActiveCalibration, tolerance: float) -> Refusal:
    """The refusal of a shape in which the limits leave more error than `tolerance` (m), with what they permit."""
    reachable = active.reachable_range(move.target, tolerance)
    return Refusal(ErrorCode.UNREACHABLE, move.target.denied(move.max_zernike, tolerance, reachable))
