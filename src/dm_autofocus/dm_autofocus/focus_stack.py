"""A stack of images over focus: an image that is sharp everywhere, and where each part of it is in focus.

Shape from focus [33]: a cell of the image is in focus where its sharpness is largest. The reciprocal of the sharpness
is nearly a parabola over focus, whose vertex follows from the three images around the largest value. Cells whose
sharpness does not rise above its noise have no focus. The image shows each cell as it was when it was sharpest.
"""

import numpy as np
from numpy.typing import NDArray

from dm_autofocus.search.peak_search import SIGNIFICANCE, is_hill
from dm_autofocus.sharpness import local_tenengrad
from dm_common import Floats

#: Fewest images of a stack.
FEWEST = 5
#: Standard deviation of the sharpness of a cell of white noise, relative to its mean, times the cell's side [px].
NOISE = 0.6


class ImageStack:
    """A stack to which images are added one by one; of each, only the sharpness of its cells is kept.

    Args:
        cell: side of a cell [px of the grey levels]; its sharpness is the mean over three by three cells.

    Attributes:
        positions: of the focus in the images so far [1/m].
        image: each cell from the image that was sharpest there, of the shape and type of the pixels added.
    """

    def __init__(self, cell: int) -> None:
        self.positions: list[float] = []
        self.image: NDArray = np.empty(0)
        self._cell = self._side = cell
        self._sharpness: list[NDArray[np.float32]] = []
        self._sharpest: NDArray[np.float32] = np.empty(0, np.float32)

    def add(self, position: float, grey: NDArray, pixels: NDArray) -> None:
        """Add an image.

        Args:
            position: of the focus [1/m]; positions rise by equal steps.
            grey: grey levels, (H, W).
            pixels: the pixels to show, (kH, kW, ...) with an integer k.

        Raises:
            ValueError: it is of another size than those before.
        """
        if pixels.shape[2:] == (2,):
            self._cell += self._cell % 2  # even, since in YUV 4:2:2 two neighbouring pixels share their colours
        sharpness = local_tenengrad(grey, self._cell)
        if not self.positions:
            self._side = self._cell * (len(pixels) // len(grey))
            self.image, self._sharpest = pixels.copy(), sharpness
        elif pixels.shape != self.image.shape or sharpness.shape != self._sharpest.shape:
            raise ValueError("the images changed their size")
        else:
            sharper = self.enlarge(sharpness > self._sharpest)
            self.image[sharper] = pixels[sharper]
            self._sharpest = np.maximum(self._sharpest, sharpness)
        self.positions.append(position)
        self._sharpness.append(sharpness)

    def enlarge(self, cells: NDArray) -> NDArray:
        """One value for each pixel of the image from one for each cell."""
        sides = zip(self.image.shape, cells.shape, strict=False)
        rows, columns = (np.minimum(np.arange(side) // self._side, count - 1) for side, count in sides)
        return cells[rows[:, None], columns]

    def in_focus(self, least_contrast: float) -> Floats:
        """Curvature at which each cell is in focus [1/m]: NaN = none, -inf or inf = beyond the first or last position.

        Args:
            least_contrast: of a cell's sharpness over the stack, relative to its largest, 0..1.

        Raises:
            ValueError: fewer than FEWEST images.
        """
        count = len(self.positions)
        if count < FEWEST:
            raise ValueError(f"{count} images: a stack needs at least {FEWEST}")
        seen = np.array(self._sharpness)
        best = seen.argmax(0)
        around = np.clip(best, 1, count - 2) + np.array([-1, 0, 1])[:, None, None]
        below, here, above = 1 / np.maximum(np.take_along_axis(seen, around, 0), np.finfo(np.float32).tiny).astype(
            float
        )
        bend = below - 2 * here + above
        offset = (below - above) / np.where(bend > 0, 2 * bend, np.inf)
        step = self.positions[1] - self.positions[0]
        place = self.positions[0] + step * (best + np.clip(offset, -0.5, 0.5))
        place = np.select([best == 0, best == count - 1], [-np.inf, np.inf], place)
        rise = 1 + SIGNIFICANCE * NOISE / self._cell
        hill = is_hill(seen, least_contrast) & (seen.max(0) > rise * np.median(seen, axis=0))
        return np.where(hill, place, np.nan)
