"""The circular aperture on a map: found from the valid pixels, or configured."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dm_common import Bools, Floats, Ints
from dm_common.errors import CodedError, ErrorCode

#: Largest scatter of the rim about the fitted circle, relative to its radius, for which the region counts as a disc.
_ROUND = 0.02

#: A second region of valid pixels larger than this share of the largest one may be the mirror as well.
SECOND_SHARE = 0.3

#: End of the messages for both cases.
_SECOND_MIRROR = "is another mirror in view? Mask it, or choose one by aperture.radius and aperture.centre_*"

#: Fewest rim points for a circle fit.
_FEWEST_RIM_POINTS = 16


class InsufficientDataError(CodedError):
    """Too few valid pixels for the request; the message gives the numbers."""

    error_code = ErrorCode.MAP_INSUFFICIENT


class MapRejectedError(CodedError):
    """A readable map that does not belong to this bench, or whose phase steps cannot be corrected."""

    error_code = ErrorCode.MAP_REJECTED


@dataclass(frozen=True)
class Aperture:
    """A circle on a map.

    Attributes:
        centre_x_px: from the left edge, pixel centres at integers.
        centre_y_px: from the top edge.
        radius_px: pixels.
    """

    centre_x_px: float
    centre_y_px: float
    radius_px: float

    @classmethod
    def configured(
        cls, shape: tuple[int, int], pitch: float, radius: float, centre_x: float = 0.0, centre_y: float = 0.0
    ) -> Aperture:
        """Aperture from lengths in m: radius, and centre from the centre of the map of this shape (x right, y up)."""
        return cls((shape[1] - 1) / 2 + centre_x / pitch, (shape[0] - 1) / 2 - centre_y / pitch, radius / pitch)

    def disc(self, shape: tuple[int, int]) -> Bools:
        """(height, width): True for pixels whose centre lies inside or on the circle."""
        x = np.arange(shape[1]) - self.centre_x_px
        y = np.arange(shape[0]) - self.centre_y_px
        return x**2 <= self.radius_px**2 - y[:, None] ** 2

    def places(self, rows: Ints, columns: Ints) -> NDArray[np.complex128]:
        """x + iy of pixels relative to the centre, y up, in units of the radius."""
        return np.asarray((columns - self.centre_x_px + 1j * (self.centre_y_px - rows)) / self.radius_px)

    def pixels(self) -> int:
        """Number of pixel centres inside or on the circle, including those outside the map."""
        if self.radius_px > 1e5:  # far beyond any camera: not worth the memory of a count
            return round(math.pi * self.radius_px**2)
        rows = np.arange(
            math.ceil(self.centre_y_px - self.radius_px), math.floor(self.centre_y_px + self.radius_px) + 1
        )
        half = np.sqrt(np.maximum(self.radius_px**2 - (rows - self.centre_y_px) ** 2, 0))
        columns = np.floor(self.centre_x_px + half) - np.ceil(self.centre_x_px - half) + 1
        return int(columns.sum())


def find_aperture(valid: Bools) -> Aperture:
    """Find the aperture that the valid pixels fill.

    The largest connected region of valid pixels, with its holes filled, is taken as the mirror. A circle is fitted to
    its rim (halfway between valid and invalid neighbours) with a robust loss, so that dropouts and bumps at the rim do
    not bias it; where the border of the map cuts off the region there is no rim. If the region is not round (a
    rectangular field, say), its largest inscribed circle is taken instead.

    Args:
        valid: (height, width), True where there is data.

    Raises:
        InsufficientDataError: hardly any valid pixels, or two regions of similar size, even if they touch.
    """
    region = _filled_largest_region(valid)
    x, y = _rim(region)
    if len(x) >= _FEWEST_RIM_POINTS:
        circle, scatter = _fit_circle(x, y)
        far = circle.radius_px > math.hypot(*region.shape)  # the rim of a slanted straight edge, not of a circle
        if not far and scatter <= _ROUND * circle.radius_px:
            disc = circle.disc(region.shape)
            # Circle and region cover about the same pixels.
            if np.count_nonzero(disc & region) >= 0.8 * np.count_nonzero(disc | region):
                return circle
    circle = _inscribed_circle(region)
    if region[[0, -1]].any() or region[:, [0, -1]].any():  # cut off at the border, such as a rectangular field
        return circle
    other = _inscribed_circle(region & ~circle.disc(region.shape))
    if other.radius_px > max(1.0, math.sqrt(SECOND_SHARE) * circle.radius_px):
        raise InsufficientDataError(
            f"the outline of the map is not one disc: circles of {circle.radius_px:.0f} and {other.radius_px:.0f} "
            f"pixels radius fit into it side by side: {_SECOND_MIRROR}"
        )
    return circle


def _filled_largest_region(valid: Bools) -> Bools:
    labels, count = ndimage.label(valid)
    if count == 0:
        raise InsufficientDataError("the map has no valid pixel, so no aperture can be found")
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    second, largest = np.sort(sizes)[-2:]
    if second > SECOND_SHARE * largest:
        raise InsufficientDataError(f"the map shows two regions of {largest} and {second} pixels: {_SECOND_MIRROR}")
    region = labels == sizes.argmax()
    # Holes are the parts outside the region that do not touch the border; much faster than binary_fill_holes.
    gaps, _count = ndimage.label(np.pad(~region, 1, constant_values=True))
    return gaps[1:-1, 1:-1] != gaps[0, 0]


def _rim(region: Bools) -> tuple[Floats, Floats]:
    """Points halfway between a pixel of the region and a neighbour outside it, in pixels."""
    row_x, column_x = np.nonzero(region[:, 1:] != region[:, :-1])
    row_y, column_y = np.nonzero(region[1:] != region[:-1])
    return (
        np.concatenate([column_x + 0.5, column_y]).astype(float),
        np.concatenate([row_x, row_y + 0.5]).astype(float),
    )


def _fit_circle(x: Floats, y: Floats) -> tuple[Aperture, float]:
    """Robust circle through points, and the scatter of the points about it (median absolute distance, pixels)."""
    from scipy import optimize  # imported here: a node with a configured aperture starts without it

    # Start with an algebraic fit (Kasa), then minimise geometric distances with a loss that flattens beyond 5 % of the
    # radius at first, then beyond one pixel.
    centre = np.array([x.mean(), y.mean()])
    dx, dy = x - centre[0], y - centre[1]
    a, b, c = np.linalg.lstsq(np.column_stack([2 * dx, 2 * dy, np.ones_like(dx)]), dx**2 + dy**2, rcond=None)[0]
    solution = np.array([a, b, math.sqrt(max(c + a**2 + b**2, 1.0))])
    for scale in (max(0.05 * solution[2], 1.0), 1.0):
        solution = optimize.least_squares(
            lambda p: np.hypot(dx - p[0], dy - p[1]) - p[2], solution, loss="cauchy", f_scale=scale
        ).x
    distance = np.abs(np.hypot(dx - solution[0], dy - solution[1]) - solution[2])
    circle = Aperture(float(centre[0] + solution[0]), float(centre[1] + solution[1]), float(abs(solution[2])))
    return circle, float(np.median(distance))


def _inscribed_circle(region: Bools) -> Aperture:
    distance = ndimage.distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1]
    radius = distance.max()
    # In a rectangle all centres on a line are equally good: take the middle of the line.
    rows, columns = np.nonzero(distance >= radius - 0.5)
    row, column = rows.mean(), columns.mean()
    if distance[round(row), round(column)] < radius - 1:  # several separate maxima
        row, column = np.unravel_index(distance.argmax(), distance.shape)
    # The distance is to the centre of the first pixel outside; the rim is half a pixel closer.
    return Aperture(float(column), float(row), float(max(distance[round(row), round(column)] - 0.5, 0.5)))
