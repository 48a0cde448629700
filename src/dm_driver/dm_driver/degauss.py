"""The decaying cycle that wipes a piezo's hysteresis (docs/protocols.md, degauss)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dm_driver.safety_limiter import Shape


def degauss_waypoints(actuators: int, middle: float, amplitude: float, steps: int, end: Shape) -> Iterator[Shape]:
    """Yield the turning points: `middle` -r, +r, -r, ... with r falling linearly from `amplitude` to 0, then `end`.

    All actuators move together, so neighbours never differ between turning points. The points are for a ramp: the
    vendor's version steps from one to the next with no slew limit.

    Args:
        actuators: number of signals N.
        middle: signal in the middle of the cycle; with `amplitude` inside the limits.
        amplitude: first half-swing about the middle.
        steps: half-swings n; r = amplitude (1 - k / n) for k = 0 .. n.
        end: (N,) signals to end in.
    """
    for step in range(steps + 1):
        radius = amplitude * (1.0 - step / steps)
        yield np.full(actuators, middle + (radius if step % 2 else -radius))
    yield end
