"""The decaying cycle that wipes a piezo's hysteresis (docs/protocols.md, degauss)."""

import math
from collections.abc import Iterator

import numpy as np

from dm_common.errors import ErrorCode, Refusal
from dm_common.limits import DEGAUSS_STEPS_MAX, DEGAUSS_STEPS_MIN
from dm_common.values import real, whole
from dm_driver.moves import Kind, Move
from dm_driver.safety_limiter import DriverLimits, Shape

#: Share of the full range from which on a degauss wipes all earlier history.
FULL_CYCLE = 0.999


def degauss_waypoints(actuators: int, middle: float, amplitude: float, steps: int, end: Shape) -> Iterator[Shape]:
    """Yield the turning points: `middle` -r, +r, -r, ... with r falling linearly from `amplitude` to 0, then `end`.

    All actuators move together, so neighbours never differ between turning points. Ramps have to join the points: only
    the vendor's version steps from one to the next with no slew limit.

    Args:
        amplitude: first half-swing about the middle, inside the limits.
        steps: half-swings n; r = amplitude (1 - k / n) for k = 0 .. n.
        end: (N,) signals to end in.
    """
    for step in range(steps + 1):
        radius = amplitude * (1.0 - step / steps)
        yield np.full(actuators, middle + (radius if step % 2 else -radius))
    yield end


def degauss_move(
    limits: DriverLimits,
    amplitude: float,
    steps: int,
    end: Shape,
    duration_max: float = math.inf,
    name: str = "steps",
) -> Move:
    """The decaying cycle about mid range, then the way to `end` (a legal shape).

    Args:
        amplitude, steps, end: see `degauss_waypoints`; amplitude 0 = the largest inside the limits.
        duration_max: s, longest time that it may take.
        name: of the parameter or field that gave `steps`, for the refusal.

    Raises:
        Refusal: NOT_FINITE or OUT_OF_RANGE.
    """
    middle = limits.middle
    largest = limits.half_range
    real(0.0, 0.0, largest).check("amplitude", amplitude)
    whole(0, 1, DEGAUSS_STEPS_MAX).check(name, steps)
    swing = amplitude or largest
    # The swings add up to steps * swing; the moves to the first one and to the end take at most the whole range each.
    # On a slow line the last step of each of these moves takes as long as a whole one.
    duration = (steps * swing + 4.0 * largest) / limits.slew_rate + (steps + 2) / limits.frames_per_second
    if not duration <= duration_max:
        line = "" if math.isinf(limits.frames_per_second) else f" and {limits.frames_per_second:.4g} frames per second"
        raise Refusal(
            ErrorCode.OUT_OF_RANGE,
            f"{name} = {steps}: would take {duration:.0f} s at limits.slew_rate = {limits.slew_rate:g} 1/s{line}, "
            f"must be at most {duration_max:g} s (degauss.duration_max)",
        )
    waypoints = degauss_waypoints(limits.actuators, middle, swing, steps, end)
    # A smaller cycle does not wipe the effect of wider swings.
    wipes = swing >= FULL_CYCLE * largest and steps >= DEGAUSS_STEPS_MIN
    return Move(Kind.DEGAUSS, end, waypoints, wipes, steps, duration)
