"""From the instrument's view of a map to the mirror surface frame (x right, y up, row 0 = top)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from dm_common import Bools, Floats
from dm_common.values import live_parameter, real, switch

#: Deviations from multiples of 90 degrees up to this are ignored [degrees]: no pixel of any camera moves by a tenth.
_EXACT = 1e-3


@dataclass(frozen=True)
class Orientation:
    """How the instrument's picture must be turned: first the flips, then the rotation about the map's centre.

    Multiples of 90 degrees permute pixels; other rotations interpolate between them.
    """

    flip_x: bool = live_parameter(switch(False), "Exchange left and right of the instrument's picture.")
    flip_y: bool = live_parameter(switch(False), "Exchange top and bottom of the instrument's picture.")
    rotate_deg: float = live_parameter(
        real(0.0, -360.0, 360.0, "deg"),
        "Rotate the flipped picture counter-clockwise. `./dm calibrate --plan poke-check` finds flips and angle.",
    )

    def apply(self, sag: Floats) -> Floats:
        """Return the map in the mirror frame, C-contiguous.

        The centre is preserved. Except for half turns a rotated map has another (height, width), so that no data are
        lost; places outside the original map are NaN.
        """
        if self.flip_x:
            sag = sag[:, ::-1]
        if self.flip_y:
            sag = sag[::-1]
        quarters = round(self.rotate_deg / 90.0)
        sag = np.rot90(sag, quarters % 4)
        rest = self.rotate_deg - 90.0 * quarters
        if abs(rest) >= _EXACT:
            from scipy import ndimage  # imported here: most benches need no rotation

            sag = resampled(sag, lambda values: ndimage.rotate(values, rest, order=1))
        return np.ascontiguousarray(sag, dtype=np.float64)

    def after(self, turn: float, mirrored: bool) -> Orientation:
        """The orientation that corrects maps which, with the present one, show the mirror mirrored left to right (if
        `mirrored`) and then turned counter-clockwise by `turn`, rad.
        """
        rotate = self.rotate_deg - math.degrees(turn)
        if mirrored:  # mirroring after a rotation is rotating the other way after mirroring
            rotate = -rotate
        flip_x, flip_y = self.flip_x != mirrored, self.flip_y
        if flip_y:  # the same as the other flip and half a turn
            flip_x, flip_y, rotate = not flip_x, False, rotate + 180.0
        return Orientation(flip_x, flip_y, (rotate + 180.0) % 360.0 - 180.0)


def resampled(sag: Floats, interpolate: Callable[[Floats], Floats]) -> Floats:
    """`sag` (height, width) at other places, by linear interpolation, which gives 0 outside the map.

    Wrong by the curvature over one pixel: less than 0.1 nm on a mirror that a camera of a few hundred pixels resolves.
    A pixel has data if those between which it lies have at least half of the weight; more would shrink the aperture.
    """
    seen = np.isfinite(sag)
    share = interpolate(seen.astype(np.float64))
    return np.where(share >= 0.5, interpolate(_continued(sag, seen)), np.nan)


def _continued(sag: Floats, seen: Bools) -> Floats:
    """`sag` with values for pixels beside those `seen`: the mean of the straight lines through two of these each.

    The mean of the pixels seen instead would flatten the rim, which looks like nanometres of spherical aberration.
    """
    from scipy import ndimage

    rows, columns = np.nonzero(ndimage.binary_dilation(seen, np.ones((3, 3))) & ~seen)
    wide = np.pad(np.where(seen, sag, np.nan), 2, constant_values=np.nan)
    lines = np.array(
        [
            2.0 * wide[rows + 2 + down, columns + 2 + right] - wide[rows + 2 + 2 * down, columns + 2 + 2 * right]
            for down, right in product((-1, 0, 1), repeat=2)
            if down or right
        ]
    )
    known, continued = np.isfinite(lines), wide[2:-2, 2:-2]
    with np.errstate(invalid="ignore"):
        continued[rows, columns] = np.where(known, lines, 0.0).sum(axis=0) / known.sum(axis=0)
    return continued
