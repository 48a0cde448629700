"""Where the actuators are, in the mirror surface frame (x right, y up, metres), and which are neighbours."""

import math

import numpy as np
from numpy.typing import NDArray

from dm_common import Bools, Floats, Ints

#: A third actuator stands between two, which are then no neighbours, if they are seen from there at a right angle or a
#: larger one. By this share the squares of the two sides may exceed that of the distance, so that the diagonals of a
#: square grid join no neighbours where positions are rounded either.
RIGHT_ANGLE_SLACK = 0.05
#: Relative difference of squared distances up to which they count as equal, as those of a ring from its centre are.
_ROUNDING = 1e-9


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
    corner_angle = np.arange(7) * (math.pi / 3) * (-1.0 if clockwise else 1.0) + start_angle
    corners = np.cos(corner_angle) + 1j * np.sin(corner_angle)
    places = [np.zeros(1, dtype=np.complex128)]
    for ring in range(1, ring_count(actuators) + 1):
        along = np.arange(ring) / ring  # the sites of a side, from its first corner on
        places.append(ring * pitch * (corners[:-1, None] + np.diff(corners)[:, None] * along).ravel())
    place = np.concatenate(places)
    return (-place.real if reflected else place.real), place.imag


def pitch(x: Floats, y: Floats) -> float:
    """Smallest distance between two actuators, in the unit of the positions (N,)."""
    first, second = np.triu_indices(x.size, k=1)
    return float(np.hypot(x[first] - x[second], y[first] - y[second]).min())


def neighbour_pairs(x: Floats, y: Floats) -> NDArray[np.intp]:
    """Return the (P, 2) indices, the smaller first and in rising order, of all pairs without an actuator between them.

    These are the edges of the Gabriel graph: no third actuator lies in the circle whose diameter joins the two. On a
    hexagonal grid they are the nearest six, on a square grid the nearest four; with several actuators every one has a
    neighbour, however uneven their distances, and neighbours connect all of them.

    Args:
        x, y: (N,) positions in m.

    Raises:
        ValueError: two actuators at the same place.
    """
    places = x + 1j * y
    pairs: list[tuple[int, int]] = []
    for actuator in range(x.size):
        order = np.argsort(np.abs(places - places[actuator]), kind="stable")
        away = places[order] - places[actuator]  # nearest first, after the actuator itself
        if x.size > 1 and away[1] == 0.0:
            a, b = np.sort(order[:2]) + 1
            raise ValueError(f"mirror.actuator_x and mirror.actuator_y: actuators {a} and {b} are at the same place")
        left = np.flatnonzero(order > actuator)  # each pair once
        while left.size:
            other, left = left[0], left[1:]
            if not _between(away[1:other], away[other]).any():
                pairs.append((actuator, int(order[other])))
            left = left[~_between(away[other], away[left])]
    return np.array(sorted(pairs), dtype=np.intp).reshape(-1, 2)


def _between(third: NDArray[np.complex128], other: NDArray[np.complex128]) -> Bools:
    """Whether actuators at `third` stand between one at 0 and others at `other`, which broadcast."""
    near, far, across = (np.square(away.real) + np.square(away.imag) for away in (third, other - third, other))
    # Only an actuator nearer to both than they are to each other: the slack separates no nearest neighbours.
    nearer = np.maximum(near, far) < (1.0 - _ROUNDING) * across
    return np.asarray(nearer & (near + far <= (1.0 + RIGHT_ANGLE_SLACK) * across))


def rings(x: Floats, y: Floats) -> Ints:
    """Ring of each actuator: number of neighbour steps from the actuator nearest to the centroid (ring 0)."""
    near = np.zeros((x.size, x.size), dtype=bool)
    first, second = neighbour_pairs(x, y).T
    near[first, second] = near[second, first] = True
    ring = np.full(x.size, -1)
    reached = np.arange(x.size) == np.argmin(np.hypot(x - x.mean(), y - y.mean()))
    for step in range(x.size):
        ring[reached] = step
        reached = near[reached].any(axis=0) & (ring < 0)
    return ring
