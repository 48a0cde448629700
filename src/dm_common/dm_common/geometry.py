"""Where the actuators are, in the mirror surface frame (x right, y up, metres), and which are neighbours."""

import math

import numpy as np
from numpy.typing import NDArray

from dm_common import Floats, Ints

#: Two actuators closer than this times the smallest distance are neighbours: on a hexagonal grid these are the nearest
#: six; the next ones are sqrt(3) times that distance away.
NEIGHBOUR_DISTANCE_RATIO = 1.2


def ring_count(actuators: int) -> int:
    """Return the number of rings around the centre of a full hexagonal pattern of `actuators` actuators.

    Raises:
        ValueError: no full pattern has that number (1, 7, 19, 37, 61, ...).
    """
    rings = round((math.sqrt(max(0.0, 12 * actuators - 3)) - 3) / 6)
    if actuators < 1 or 1 + 3 * rings * (rings + 1) != actuators:
        raise ValueError(
            f"mirror.actuators = {actuators}: no full hexagonal pattern has that number (1, 7, 19, 37, 61, ...);"
            " give mirror.actuator_x and mirror.actuator_y"
        )
    return rings


def hexagonal_positions(
    actuators: int = 37,
    pitch: float = 4.3e-3,
    start_angle: float = 0.0,
    clockwise: bool = False,
    reflected: bool = False,
) -> tuple[Floats, Floats]:
    """Return (N,) x and (N,) y, m, of a full hexagonal pattern, numbered as OKO's PDM mirrors are.

    Actuator 1 is the centre, 2-7 the first ring, 8-19 the second, 20-37 the third; sequential in angle within a ring.
    The angle of the first one, the sense and the reflection differ from unit to unit.

    Args:
        actuators: 1, 7, 19, 37, ...
        pitch: distance of neighbours, m.
        start_angle: direction from the centre to the first actuator of every ring (a corner of its hexagon),
            counter-clockwise from x, rad.
        clockwise: numbers rise clockwise instead of counter-clockwise.
        reflected: the finished pattern is mirrored left-right (x to -x), as when seen from behind.
    """
    x, y = [np.zeros(1)], [np.zeros(1)]
    corner_angle = np.arange(7) * (math.pi / 3) * (-1.0 if clockwise else 1.0) + start_angle
    corner_x, corner_y = np.cos(corner_angle), np.sin(corner_angle)
    for ring in range(1, ring_count(actuators) + 1):
        along = np.arange(ring) / ring  # the sites of a side, from its first corner on
        for corners, ordinates in ((corner_x, x), (corner_y, y)):
            sides = corners[:-1, None] + (corners[1:] - corners[:-1])[:, None] * along
            ordinates.append(ring * pitch * sides.ravel())
    all_x, all_y = np.concatenate(x), np.concatenate(y)
    return (-all_x if reflected else all_x), all_y


def pitch(x: Floats, y: Floats) -> float:
    """Smallest distance between two actuators, in the unit of the positions (N,)."""
    return float(_distances(x, y)[1].min())


def _distances(x: Floats, y: Floats) -> tuple[NDArray[np.intp], Floats]:
    """The (P, 2) indices of all pairs, the smaller first, and their (P,) distances."""
    pairs = np.column_stack(np.triu_indices(x.size, k=1))
    return pairs, np.hypot(*(places[pairs[:, 0]] - places[pairs[:, 1]] for places in (x, y)))


def neighbour_pairs(x: Floats, y: Floats) -> NDArray[np.intp]:
    """Return the (P, 2) indices, the smaller first, of all pairs closer than 1.2 times the smallest distance.

    Args:
        x, y: (N,) positions in m.

    Raises:
        ValueError: two actuators at the same place.
    """
    pairs, distance = _distances(x, y)
    if len(pairs) == 0:
        return pairs
    smallest = distance.min()
    if smallest <= 0.0:
        a, b = pairs[distance.argmin()] + 1
        raise ValueError(f"mirror.actuator_x and mirror.actuator_y: actuators {a} and {b} are at the same place")
    return pairs[distance < NEIGHBOUR_DISTANCE_RATIO * smallest]


def rings(x: Floats, y: Floats) -> Ints:
    """Ring of each actuator: number of neighbour steps from the actuator nearest to the centroid (ring 0).

    Actuators that no chain of neighbours reaches get -1.
    """
    near = np.zeros((x.size, x.size), dtype=bool)
    first, second = neighbour_pairs(x, y).T
    near[first, second] = near[second, first] = True
    ring = np.full(x.size, -1)
    reached = np.arange(x.size) == np.argmin(np.hypot(x - x.mean(), y - y.mean()))
    for step in range(x.size):
        ring[reached] = step
        reached = near[reached].any(axis=0) & (ring < 0)
    return ring
