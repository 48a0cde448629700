"""Phase steps: regions of a map that are off by whole fringes because the instrument lost count of fringes.

An instrument follows less than half a fringe from pixel to pixel. A larger difference between neighbours is the border
of a region; the height difference to the adjacent region gives the number of fringes lost.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dm_calibration.optics.aperture import MapRejectedError
from dm_common import Floats

#: Smallest region, as a share of the valid pixels; smaller ones are specks.
SPECK = 1e-3
#: Largest deviation of a step from whole fringes, in fringes.
WHOLE = 0.25
#: Largest distance, in pixels, between regions whose heights are compared.
GAP = 4.0


def mend_phase_steps(sag: Floats, fringe: float) -> tuple[Floats, int]:
    """The map (height, width), m, with all regions on the fringe of the largest, and the number of regions corrected.

    Args:
        fringe: m of sag, half a wavelength.

    Raises:
        MapRejectedError: a step is not of whole fringes.
    """
    valid = np.isfinite(sag)
    inside = valid.copy()
    inside[1:] &= ~(np.abs(np.diff(sag, axis=0)) > 0.5 * fringe)
    inside[:, 1:] &= ~(np.abs(np.diff(sag, axis=1)) > 0.5 * fringe)
    labels, count = ndimage.label(inside)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    regions = np.flatnonzero(sizes >= SPECK * np.count_nonzero(valid))
    if len(regions) < 2:
        return sag, 0
    labels[~np.isin(labels, regions)] = 0
    distance, nearest = ndimage.distance_transform_edt(labels == 0, return_indices=True)
    steps = _steps(sag, labels, nearest, distance, fringe)
    largest = int(sizes.argmax())
    lost, waiting = {largest: 0}, [largest]
    while waiting:
        known = waiting.pop()
        for (one, other), step in steps.items():
            if one == known and other not in lost:
                lost[other] = lost[known] + _whole(step, np.argwhere(labels == other).mean(axis=0))
                waiting.append(other)
    fringes = np.zeros(count + 1)
    fringes[list(lost)] = list(lost.values())
    # Corrected height at the nearest pixel of a region: reference for the pixels that belong to none.
    level = sag[tuple(nearest)] - fringe * fringes[labels[tuple(nearest)]]
    off = np.where(labels > 0, fringes[labels], (sag - level) / fringe)
    near = np.abs(off - np.round(off)) < WHOLE  # False where there are no data
    mended = sag - fringe * np.where(near, np.round(off), 0.0)
    return mended, int(np.count_nonzero(fringes))


def _steps(
    sag: Floats, labels: NDArray[np.int_], nearest: NDArray[np.int_], distance: Floats, fringe: float
) -> dict[tuple[int, int], float]:
    """Median height of one region above another, fringes, for all pairs of adjacent regions in both orders.

    The slope at either side is extrapolated to the other side, as far as it is known.

    Args:
        nearest: (2, height, width), row and column of the nearest pixel that belongs to a region.
        distance: to that pixel, pixels.
    """
    owner = labels[tuple(nearest)]
    found: list[tuple[NDArray[np.int_], Floats]] = []
    for axis, (before, after) in enumerate(((np.s_[:-1, :], np.s_[1:, :]), (np.s_[:, :-1], np.s_[:, 1:]))):
        beside = (owner[before] != owner[after]) & (distance[before] + distance[after] <= GAP)
        one, other = (nearest[:, *where][:, beside] for where in (before, after))
        slope = 0.5 * (_slope(sag, one, axis, -1, fringe) + _slope(sag, other, axis, 1, fringe))
        rise = sag[tuple(other)] - sag[tuple(one)] - (other[axis] - one[axis]) * slope
        found.append((np.column_stack((owner[before][beside], owner[after][beside])), rise / fringe))
    pair, height = (np.concatenate(each) for each in zip(*found, strict=True))
    both, height = np.concatenate((pair, pair[:, ::-1])), np.concatenate((height, -height))
    return {
        (int(one), int(other)): float(np.median(height[(both == (one, other)).all(axis=1)]))
        for one, other in np.unique(both, axis=0)
    }


def _slope(sag: Floats, at: NDArray[np.int_], axis: int, way: int, fringe: float) -> Floats:
    """m per pixel along `axis` at the pixels `at` (2, B), to the neighbour in direction `way`; 0 at steps and gaps."""
    beside = at.copy()
    beside[axis] = np.clip(beside[axis] + way, 0, sag.shape[axis] - 1)
    slope = way * (sag[tuple(beside)] - sag[tuple(at)])
    return np.where(np.abs(slope) < 0.5 * fringe, slope, 0.0)


def _whole(fringes: float, middle: Floats) -> int:
    """`fringes` as an integer; `middle`: row and column of the region, for the message of MapRejectedError."""
    if abs(fringes - round(fringes)) >= WHOLE:
        row, column = np.round(middle).astype(int)
        raise MapRejectedError(
            f"the region about column {column}, row {row} is {fringes:+.2f} fringes off its surroundings, but phase "
            "steps are whole fringes: is a second surface in view?"
        )
    return round(fringes)
