"""Runs of several parts: each begins with a degauss, from which on the history of the actuators is known again.

What the actuators did between two parts is not known. A degauss wipes their hysteresis; their creep before it fades
in a pattern that is unknown, as it is before the first part, and the mirror may have drifted meanwhile.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dm_calibration.hysteresis.features import relaxation
from dm_common import Floats

#: Time between the end of a degauss and the first map, s, where it is not known; creep of that age is gone soon.
BEFORE_FIRST_MAP_S = 1.0
#: A step of the figure is this much more likely than fading creep to explain few maps.
_FADING_SCALE = 0.1


def parts_of(segment: NDArray[np.int64]) -> list[slice]:
    """Rows of each part, in order; `segment` (M,) changes where a part begins."""
    bounds = [0, *(np.flatnonzero(np.diff(segment)) + 1).tolist(), len(segment)]
    return [slice(begin, end) for begin, end in pairwise(bounds)]


def starts_of(parts: list[slice], first: float, time: Floats, moved: Floats | None) -> list[float]:
    """When the degauss before each part had ended, s.

    Args:
        first: s, that before the first.
        time, moved: (M,) s, as in a run.
    """
    stood = time if moved is None else moved
    return [first, *(float(stood[part.start]) - BEFORE_FIRST_MAP_S for part in parts[1:])]


def in_parts(parts: list[slice], starts: list[float], work: Callable[[slice, float], Floats]) -> Floats:
    """What `work` makes of each part and its start, s, one after the other."""
    made = [work(part, start) for part, start in zip(parts, starts, strict=True)]
    return made[0] if len(made) == 1 else np.concatenate(made)


def figure_columns(time: Floats, parts: list[slice], starts: list[float]) -> Floats:
    """(M, 1 + 2 parts) columns of the figure: constant, old creep that fades, drift; a step and fading for each part.

    Args:
        time: (M,) s.
        starts: s, of all parts.
    """
    running = np.concatenate([[0.0], np.cumsum(np.diff(time) * (~_begins(parts, len(time)))[1:])])
    first = np.zeros(len(time))
    first[parts[0]] = relaxation(time[parts[0]], starts[0])
    columns = [np.ones(len(time)), first, (running + time[0] - starts[0]) / max(float(np.ptp(running)), 1e-9)]
    for part, start in zip(parts[1:], starts[1:], strict=True):
        step, fading = np.zeros(len(time)), np.zeros(len(time))
        step[part] = 1.0
        fading[part] = _FADING_SCALE * relaxation(time[part], start)
        columns += [step, fading]
    return np.column_stack(columns)


def basis_of(columns: Floats) -> Floats:
    """Orthonormal columns that span `columns`, which may be 0 or alike in the rows at hand."""
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, size > 1e-9 * size[0]])


def without(rows: Floats, free: Floats) -> Floats:
    """`rows` (M, ...) less what the orthonormal columns `free` (M, C) explain."""
    return rows - np.tensordot(free, np.tensordot(free.T, rows, 1), 1)


def _begins(parts: list[slice], count: int) -> NDArray[np.bool_]:
    begins = np.zeros(count, dtype=bool)
    begins[[part.start for part in parts]] = True
    return begins
