"""Phase steps: regions of a map that stand whole fringes off, since the instrument lost count there.

An instrument follows less than half a fringe from pixel to pixel. Where neighbours differ by more a region ends, and
what it differs from the one beside it tells how many fringes were lost.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dm_calibration.optics.aperture import MapRejectedError
from dm_common import Floats

#: Share of the valid pixels below which a region is a speck.
SPECK = 1e-3
#: A step differs from whole fringes by less than this, in fringes.
WHOLE = 0.25
#: Regions further from each other than this, in pixels, say nothing of each other.
GAP = 4.0


def mend_phase_steps(sag: Floats, fringe: float) -> tuple[Floats, int]:
    """The map (height, width), m, with all its regions on the fringes of the largest, and how many stood off.

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
    # What a pixel of no region should be near to.
    level = sag[tuple(nearest)] - fringe * fringes[labels[tuple(nearest)]]
    off = np.where(labels > 0, fringes[labels], (sag - level) / fringe)
    near = np.abs(off - np.round(off)) < WHOLE  # not, where there are no data
    mended = sag - fringe * np.where(near, np.round(off), 0.0)
    return mended, int(np.count_nonzero(fringes))


def _steps(
    sag: Floats, labels: NDArray[np.int_], nearest: NDArray[np.int_], distance: Floats, fringe: float
) -> dict[tuple[int, int], float]:
    """Median height of a second region above a first, fringes, both ways, of all that lie beside each other.

    The slope on either side is followed to the other, as far as there is one to be seen.

    Args:
        nearest: (2, height, width), row and column of the pixel of a region that is nearest to each.
        distance: from it, pixels.
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
    """m per pixel along `axis` at the pixels `at` (2, B), to their neighbour one `way`; 0 where it is of no region."""
    beside = at.copy()
    beside[axis] = np.clip(beside[axis] + way, 0, sag.shape[axis] - 1)
    slope = way * (sag[tuple(beside)] - sag[tuple(at)])
    return np.where(np.abs(slope) < 0.5 * fringe, slope, 0.0)


def _whole(fringes: float, middle: Floats) -> int:
    """`fringes` as a whole number; of a region about `middle`, row and column."""
    if abs(fringes - round(fringes)) >= WHOLE:
        row, column = np.round(middle).astype(int)
        raise MapRejectedError(
            f"the region about column {column}, row {row} stands {fringes:+.2f} fringes off what is beside it: phase "
            "steps are of whole fringes; is a second surface in view?"
        )
    return round(fringes)
