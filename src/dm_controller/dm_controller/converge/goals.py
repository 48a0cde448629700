"""Goals of `build_recipes`: what is checked before anything moves."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from dm_common.errors import CodedError, ErrorCode, Refusal
from dm_common.optics.zernike import TERMS
from dm_common.recipes import RecipeError, shape_text
from dm_controller.planning.planner import Planner
from dm_controller.planning.recipes import SAME_SHAPE
from dm_controller.planning.target import TARGET, FocusTarget


class UnreachableError(CodedError, RecipeError):
    """The limits of the actuators deny the shape."""

    error_code = ErrorCode.UNREACHABLE


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
        raise Refusal(ErrorCode.INVALID_LENGTH, f"zernike has {len(zernike)} values: must have {allowed}")
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
            raise RecipeError(f"curvatures: {shape_text(one)} is there twice; each recipe once")
    for target in targets:
        left = loop.mirror.command(target)[1]
        if left > error_max:
            raise UnreachableError(target.denied(left, error_max, loop.mirror.reachable_range(target, error_max)))
    return targets
