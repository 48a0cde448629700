"""Goals of `converge` and `build_recipes`: what is checked before anything moves, and how they end."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from dm_common.errors import EXPECTED, Cancelled, ErrorCode, error_code
from dm_common.recipes import RecipeError
from dm_controller.planning.planner import Planner
from dm_controller.planning.recipes import SAME_CURVATURE
from dm_controller.planning.target import FocusTarget


class UnreachableError(RecipeError):
    """The limits of the actuators deny the shape."""

    error_code = ErrorCode.UNREACHABLE


def recipe_targets(
    curvatures: Sequence[float], conic_constant: float, loop: Planner, error_max: float
) -> list[FocusTarget]:
    """The shapes to build recipes for, by rising curvature.

    Args:
        error_max: largest coefficient error, m, that the model may leave.

    Raises:
        RecipeError: a curvature asked for twice, naming it.
        UnreachableError: one out of reach.
        TargetError: no such surface exists over the aperture.
    """
    ordered = sorted(float(curvature) for curvature in curvatures)
    for one, next_one in pairwise(ordered):
        if next_one - one <= SAME_CURVATURE:
            raise RecipeError(f"curvatures: {one:+.4f} 1/m is there twice; each recipe once")
    targets = [FocusTarget(curvature, conic_constant) for curvature in ordered]
    for target in targets:
        left = loop.mirror.command(target)[1]
        if left > error_max:
            raise UnreachableError(target.denied(left, error_max, loop.mirror.reachable_range(target, error_max)))
    return targets


def ending(error: Exception) -> tuple[str, int, str]:
    """Outcome of the action, ErrorCode and sentence of a goal that `error` ended. A defect is raised again."""
    if isinstance(error, Cancelled):
        return "canceled", ErrorCode.CANCELED, str(error)
    if isinstance(error, EXPECTED):
        return "abort", error_code(error), str(error)
    if isinstance(error, TimeoutError):
        return "abort", ErrorCode.TIMEOUT, str(error)
    raise error
