"""Cells around actuators that stand anywhere: hexagons on a hexagonal grid, and never one over another elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Distance from the middle to a side of a lone actuator's cell, mm.
ALONE = 2.0


@lru_cache(maxsize=8)
def outlines(places: tuple[tuple[float, float], ...]) -> list[Floats]:
    """Corners (K, 2) of each actuator's cell, in the unit of `places`.

    Each is a regular hexagon that reaches half way to the nearest other actuator and has a side towards it, cut off
    where another actuator is nearer.
    """
    points = np.array(places, dtype=np.float64).reshape(-1, 2)
    cells = []
    for k, point in enumerate(points):
        to_others = np.delete(points, k, axis=0) - point
        distance = np.hypot(*to_others.T)
        to_others, distance = to_others[distance > 0.0], distance[distance > 0.0]
        apothem, turned = ALONE, 0.0
        if distance.size:
            nearest = to_others[np.argmin(distance)]
            apothem, turned = float(distance.min()) / 2.0, float(np.arctan2(nearest[1], nearest[0]))
        corner = turned + np.pi / 6 + np.arange(6) * np.pi / 3
        radius = apothem / np.cos(np.pi / 6)
        cell = radius * np.column_stack([np.cos(corner), np.sin(corner)])
        for other in to_others[distance < 2.0 * radius]:
            cell = cut(cell, other)
        cells.append(cell + point)
    return cells


def cut(polygon: Floats, other: Floats) -> Floats:
    """The part of a convex `polygon` (K, 2) around the origin that is nearer to the origin than to `other` (2,)."""
    beyond = polygon @ other - 0.5 * float(other @ other)
    if (beyond <= 1e-9 * float(other @ other)).all():
        return polygon
    kept: list[Floats] = []
    for here, there, a, b in zip(polygon, np.roll(polygon, -1, axis=0), beyond, np.roll(beyond, -1), strict=True):
        if a <= 0.0:
            kept.append(here)
        if (a < 0.0 < b) or (b < 0.0 < a):
            kept.append(here + (there - here) * a / (a - b))
    return np.array(kept)


def sizes(cells: Sequence[Floats], places: Sequence[tuple[float, float]]) -> list[float]:
    """For each cell, how far it reaches from its actuator to its nearest side."""
    result = []
    for cell, place in zip(cells, places, strict=True):
        here = cell - np.asarray(place)
        along = np.roll(here, -1, axis=0) - here
        cross = here[:, 0] * along[:, 1] - here[:, 1] * along[:, 0]
        result.append(float(np.min(np.abs(cross) / np.hypot(*along.T))))
    return result
