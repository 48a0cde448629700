"""Searches for the sharpest focus that use only the sharpness of images, written for the comparison.

Each is a generator: it yields the curvature of the next image [1/m], is sent the sharpness there, and returns the best
curvature, or None if it finds no focus. `step` is the coarse step and `fine` the finest [1/m].
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

#: Yields a curvature, is sent a sharpness, returns the place found.
Search = Generator[float, float, float | None]


@dataclass(frozen=True)
class Task:
    """What every search is given: range, start, coarse and finest step [1/m]."""

    low: float
    high: float
    start: float
    step: float
    fine: float

    def clip(self, place: float) -> float:
        """The place inside the range."""
        return float(np.clip(place, self.low, self.high))


def full_sweep(task: Task) -> Search:
    """An image at every second finest step of the whole range, and the parabola through the best and its neighbours."""
    places = np.linspace(task.low, task.high, 1 + round((task.high - task.low) / (2 * task.fine)))
    seen = np.empty(len(places))
    for number, place in enumerate(places):
        seen[number] = yield float(place)
    return _vertex(places, seen, int(seen.argmax()))


def hill_climb(task: Task) -> Search:
    """Step towards greater sharpness; reverse with a smaller step where it falls [25]."""
    place, step = task.start, task.step
    here = yield place
    turned = 0
    visited = {place: here}
    while True:
        wanted = task.clip(place + step)
        there = (yield wanted) if wanted != place else -np.inf
        visited[wanted] = max(there, visited.get(wanted, there))
        if there > here:
            place, here, turned = wanted, there, 0
            continue
        step, turned = -step, turned + 1
        if turned < 2:
            continue
        if abs(step) <= task.fine:
            places = np.array(sorted(visited))
            seen = np.array([visited[key] for key in places])
            return _vertex(places, seen, int(seen.argmax()))
        step, turned = step / 3, 0


def fibonacci_search(task: Task) -> Search:
    """Narrow the range down by the Fibonacci numbers: the fewest images for a hill without noise [23]."""
    numbers = [1, 1]
    while numbers[-1] < (task.high - task.low) / task.fine:
        numbers.append(numbers[-1] + numbers[-2])
    low, high = task.low, task.high
    count = len(numbers) - 1
    left = low + numbers[count - 2] / numbers[count] * (high - low)
    right = low + high - left
    at_left = yield left
    at_right = yield right
    while count > 3:
        count -= 1
        if at_left < at_right:
            low, left, at_left = left, right, at_right
            right = low + high - left
            at_right = yield right
        else:
            high, right, at_right = right, left, at_left
            left = low + high - right
            at_left = yield left
    return left if at_left > at_right else right


def contrast_rules(task: Task) -> Search:
    """Rules as in libcamera's contrast autofocus (rpi `af.cpp` [35]), without its phase detection.

    Scan in coarse steps from the present position until the contrast has fallen to three quarters of its maximum; turn
    round if the first image was not below that yet; then scan back over the peak in steps a quarter as large. The
    range is 12 coarse steps, as in libcamera. In focus = the contrast at the end is at least three quarters of the
    maximum, and the lowest contrast of the scan is at most that.
    """
    ratio, coarse = 0.75, (task.high - task.low) / 12
    if task.start <= task.low + 2 * coarse:
        place, step, first = task.low, coarse, False
    elif task.start >= task.high - 2 * coarse:
        place, step, first = task.high, -coarse, False
    else:
        place, step, first = task.start, -coarse, True
    highest, lowest = 0.0, np.inf
    fine = False
    places: list[float] = []
    seen: list[float] = []
    top = 0
    while True:
        sharpness = yield place
        if not places or sharpness > highest:
            highest, top = sharpness, len(places)
        lowest = min(lowest, sharpness)
        places.append(place)
        seen.append(sharpness)
        at_end = (step > 0 and place >= task.high) or (step < 0 and place <= task.low)
        if not (at_end or (fine and len(places) >= 3) or sharpness < ratio * highest):
            place = task.clip(place + step)
            continue
        order = np.argsort(places)
        best = _vertex(np.array(places)[order], np.array(seen)[order], int(np.where(order == top)[0][0]))
        if first and seen[0] >= ratio * highest:
            step, place, first = -step, task.clip(place - step), False
        elif fine:
            last = yield best
            return best if last >= ratio * highest and lowest <= ratio * highest else None
        else:
            step = -np.sign(step) * coarse / 4
            place, fine, first = task.clip(best - step), True, False
        places, seen, top = [], [], 0


def _vertex(places: np.ndarray, seen: np.ndarray, top: int) -> float:
    """Vertex of the parabola through a value and its two neighbours; the value's own place if there is no maximum."""
    if len(places) < 3:
        return float(places[top])
    middle = min(max(top, 1), len(places) - 2)
    x, y = places[middle - 1 : middle + 2] - places[middle], seen[middle - 1 : middle + 2]
    square, slope, _constant = np.polyfit(x, y, 2)
    if square >= 0:
        return float(places[top])
    return float(places[middle] + np.clip(-slope / (2 * square), x[0], x[-1]))


BASELINES = {
    "full sweep": full_sweep,
    "hill climbing": hill_climb,
    "Fibonacci search": fibonacci_search,
    "contrast rules": contrast_rules,
}
