"""What goals of `converge` and `build_recipes` have in common: the check of their figures, and how they end."""

from __future__ import annotations

import math
from typing import Any

from dm_common.errors import EXPECTED, Cancelled, ErrorCode, error_code

#: Most maps that a goal may ask for.
MAPS_MAX = 100


def check_figures(goal: Any) -> None:
    """Raise ValueError naming the field of a goal of either action that makes no sense."""
    if not (math.isfinite(goal.tolerance) and goal.tolerance >= 0.0):
        raise ValueError(f"tolerance = {goal.tolerance} m: must be 0 (= configured) or above, and finite")
    if goal.max_maps > MAPS_MAX:
        raise ValueError(f"max_maps = {goal.max_maps}: must be 0 (= configured) to {MAPS_MAX}")


def ending(error: Exception) -> tuple[str, int, str]:
    """Outcome of the action, ErrorCode and sentence of a goal that `error` ended. A defect is raised again."""
    if isinstance(error, Cancelled):
        return "canceled", ErrorCode.CANCELED, str(error)
    if isinstance(error, EXPECTED):
        return "abort", error_code(error), str(error)
    if isinstance(error, TimeoutError):
        return "abort", ErrorCode.TIMEOUT, str(error)
    raise error
