"""Concentric regions on sampling points instead of pixels, for stored maps that hold the sag at some hundred points.

A point represents a share of the aperture's area (its weight). There are some ten rings of points for ten regions: to
count whole rings in or out would shift the boundary of a region by up to half a ring's width, or 7 % of the area. So
boundaries cut through the points' areas. The points of one radius together represent an annulus, which begins where the
area of all points further inside ends. A disc contains of each point the part of its annulus inside the disc. This is
exact for rings of edge-clustered points, and for uniform points, whose weights are equal.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from dm_common import Floats
from dm_common.errors import CodedError, ErrorCode
from dm_common.optics.sampling import SamplePoints

#: Shares of the aperture's area, 10 % to 100 % (Fig. 4 in [1]).
AREA_FRACTIONS: tuple[float, ...] = tuple(k / 10 for k in range(1, 11))
#: Squared radii that agree to this many decimals belong to one ring of points.
_RADIUS_DECIMALS = 9


class EmptyRegionError(CodedError, ValueError):
    """A region holds no data; the message names the map and the region."""

    error_code = ErrorCode.MAP_INSUFFICIENT


def check_regions(rms: Floats, area_fractions: Sequence[float] | Floats, labels: Sequence[str]) -> None:
    """Raise EmptyRegionError for the first NaN in `rms` (M, R)."""
    empty = np.argwhere(~np.isfinite(rms))
    if len(empty):
        row, region = empty[0]
        raise EmptyRegionError(
            f"{labels[row]}: the concentric region of {area_fractions[region]:.0%} of the area holds no valid data; "
            "measure the map again, or check centre and radius of the aperture"
        )


def disc_shares(points: SamplePoints) -> Floats:
    """(P, R): part of each point's own area, 0..1, that lies inside each concentric disc.

    Raises:
        ValueError: weights that are not positive or do not sum to 1.
    """
    weight = points.weight
    if not (weight > 0).all() or abs(weight.sum() - 1.0) > 1e-6:
        raise ValueError(
            f"weights of the sampling points: from {weight.min():g}, sum {weight.sum():g}; "
            "must be positive shares of the area that sum to 1"
        )
    _, ring = np.unique(np.round(points.x**2 + points.y**2, _RADIUS_DECIMALS), return_inverse=True)
    area = np.bincount(ring.ravel(), weight)
    outer = np.cumsum(area)
    inner = outer - area
    # The last ring must end at 1 without rounding error, so that the whole aperture contains it completely.
    outer[-1] = 1.0
    inside = (np.array(AREA_FRACTIONS) - inner[:, np.newaxis]) / (outer - inner)[:, np.newaxis]
    return np.asarray(np.clip(inside, 0.0, 1.0)[ring.ravel()])


def regional_rms(sag: Floats, points: SamplePoints, labels: Sequence[str] = ()) -> Floats:
    """Root mean square about zero of sag samples inside concentric discs, area-weighted: (M, R), all finite.

    Piston and tilt are removed once over the whole aperture, by the caller.

    Args:
        sag: (M, P) at the points, NaN = no data; the points with data then represent the region.
        labels: (M,) names of the maps for messages.

    Raises:
        EmptyRegionError: a region of some map has no sample.
        ValueError: shapes that disagree.
    """
    if sag.ndim != 2 or sag.shape[1] != len(points):
        raise ValueError(f"sag has the shape {sag.shape}: must be (maps, {len(points)} sampling points)")
    shares = points.weight[:, np.newaxis] * disc_shares(points)
    seen = np.isfinite(sag)
    energy = np.where(seen, np.square(sag), 0.0) @ shares
    area = seen.astype(float) @ shares
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.where(area > 0.0, np.sqrt(energy / area), np.nan)
    names = tuple(labels) or tuple(f"map {k + 1}" for k in range(len(sag)))
    check_regions(rms, AREA_FRACTIONS, names)
    return np.asarray(rms)


def point_weights(points: SamplePoints, weights: ArrayLike) -> Floats:
    """(P,) weight of each point: that of the smallest region that contains it.

    Where the boundary of a region cuts through a point's area, squared weights are averaged, since weights act squared.

    Args:
        weights: (R,) of the regions, from the innermost; their areas grow in R equal steps to the whole aperture.

    Raises:
        ValueError: weights not above 0, or not one per region.
    """
    w = np.asarray(weights, dtype=float)
    if w.shape != (len(AREA_FRACTIONS),) or not (np.isfinite(w) & (w > 0.0)).all():
        raise ValueError(
            f"weights = {w.tolist()}: must be {len(AREA_FRACTIONS)} finite numbers above 0, one per region"
        )
    ring_shares = np.diff(disc_shares(points), axis=1, prepend=0.0)
    return np.asarray(np.sqrt(ring_shares @ np.square(w)))


def command_row_weights(points: SamplePoints, weights: ArrayLike) -> Floats:
    """Row factors W of the command solve min |W(dC - G dS)|: place (b) of `dm_calibration.influence.weights`.

    Multiply the rows of the influence function (P, N) in sag and of the wanted sag (P,) by them. They include the
    points' areas; their squares sum to 1, as the areas do, so a ridge has the same effect as without weights.

    Args:
        weights: (R,) of the regions.

    Returns:
        (P,) above 0.
    """
    row = np.sqrt(points.weight) * point_weights(points, weights)
    return np.asarray(row / np.linalg.norm(row))
