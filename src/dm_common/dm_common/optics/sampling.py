"""Sampling points on the unit disc and the rule of [1], section 2.2, for reading a map at them."""

import math
from dataclasses import dataclass

import numpy as np

from dm_common import Floats

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))

#: Distance [pixels] below which a point and a pixel coincide.
_COINCIDENT = 1e-9


@dataclass(frozen=True, eq=False)
class SamplePoints:
    """Points of the unit disc.

    Attributes:
        x, y: (P,), x right, y up.
        weight: (P,), share of the disc's area that each point stands for; sums to 1.
    """

    x: Floats
    y: Floats
    weight: Floats

    def __len__(self) -> int:
        return len(self.x)


def edge_clustered_points(count: int = 500) -> SamplePoints:
    """Points that crowd towards the rim as Chebyshev nodes do, which suppresses ringing of polynomial fits there.

    Rings at r = sin(pi/2 (k - 1/2)/K) lie between circles at sin(pi/2 k/K). The number of points of a ring is
    proportional to its circumference; they share the area between its two circles. Deterministic. After [5].

    Raises:
        ValueError: count below 8.
    """
    if count < 8:
        raise ValueError(f"count = {count}: must be at least 8")
    rings = round(math.sqrt(count) / 2)  # equal mean spacing radially and along the rings
    radius = np.sin(np.pi / 2 * (np.arange(rings) + 0.5) / rings)
    edges = np.sin(np.pi / 2 * np.arange(rings + 1) / rings)
    wanted = count * radius / radius.sum()
    on_ring = np.floor(wanted).astype(int)
    largest_remainders = np.argsort(on_ring - wanted, kind="stable")[: count - on_ring.sum()]
    on_ring[largest_remainders] += 1
    ring = np.repeat(np.arange(rings), on_ring)
    place = np.concatenate([np.arange(n) for n in on_ring])
    # Successive rings are turned by the golden angle, so that their points do not line up along rays.
    angle = 2 * np.pi * place / on_ring[ring] + GOLDEN_ANGLE * ring
    return SamplePoints(
        x=radius[ring] * np.cos(angle),
        y=radius[ring] * np.sin(angle),
        weight=(np.diff(edges**2) / on_ring)[ring],
    )


def sample_map(sag: Floats, centre_x_px: float, centre_y_px: float, radius_px: float, points: SamplePoints) -> Floats:
    """Read a map at the sampling points by the four-neighbour rule of section 2.2: (P,), in the unit of the sag.

    A point on a pixel takes the pixel's value; a point on the line between two adjacent pixels, the mean of the two;
    any other point, the mean of its four neighbours. Neighbours without data or beyond the map's border do not count;
    when none is left, the result is NaN.

    Args:
        sag: (height, width), row 0 = top, NaN = no data.
        centre_x_px, centre_y_px: centre of the aperture from the left and top pixel's centre.
        radius_px: radius of the aperture.
    """
    x = _snapped(centre_x_px + radius_px * points.x)
    y = _snapped(centre_y_px - radius_px * points.y)  # rows count downwards
    # On a pixel row or column, floor and ceil name the same neighbours twice: the mean of four is then the mean of two
    # (or one) that the rule asks for.
    columns = np.stack([np.floor(x), np.ceil(x), np.floor(x), np.ceil(x)]).astype(int)
    rows = np.stack([np.floor(y), np.floor(y), np.ceil(y), np.ceil(y)]).astype(int)
    height, width = sag.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    values = sag[np.where(inside, rows, 0), np.where(inside, columns, 0)]
    good = inside & np.isfinite(values)
    count = good.sum(axis=0)
    total = np.where(good, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _snapped(position: Floats) -> Floats:
    """Positions in pixels; those that coincide with a pixel row or column are put exactly there."""
    nearest = np.rint(position)
    return np.where(np.abs(position - nearest) <= _COINCIDENT, nearest, position)


def on_disc(values: Floats, points: SamplePoints, pixels: int) -> Floats:
    """Interpolate `values` (Q, P) at the points onto square maps (Q, pixels, pixels), NaN outside the unit disc.

    Thin-plate splines through all points; row 0 = bottom.
    """
    from scipy.interpolate import RBFInterpolator  # for pictures: no node loads it

    axis = np.linspace(-1.0, 1.0, pixels)
    x, y = np.meshgrid(axis, axis)
    inside = np.hypot(x, y) <= 1.0
    spline = RBFInterpolator(np.column_stack((points.x, points.y)), values.T, kernel="thin_plate_spline")
    maps = np.full((len(values), pixels, pixels), np.nan)
    maps[:, inside] = spline(np.column_stack((x[inside], y[inside]))).T
    return maps
