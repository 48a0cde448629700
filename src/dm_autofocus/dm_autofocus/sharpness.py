"""Sharpness of an image: one number that is largest in focus.

`tenengrad` is the mean squared Sobel gradient [22, 23], `laplacian` the mean squared Laplacian (both compared in [24]).
Both are divided by the squared mean grey level, so that exposure, gain and flicker drop out. The Laplacian answers to
finer detail and to noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

#: Left, top, width and height as shares 0..1 of the image.
Region = tuple[float, float, float, float]
WHOLE: Region = (0.0, 0.0, 1.0, 1.0)

#: Pixels that enter one figure at most; of larger regions only every n-th row counts.
PIXEL_BUDGET = 400_000
#: Smallest region [px along a side] that has a gradient.
SMALLEST = 3


def check_region(region: Sequence[float]) -> Region:
    """The region as a tuple.

    Raises:
        ValueError: not four numbers, or not inside the image.
    """
    if len(region) != 4:
        raise ValueError(f"region = {list(region)}: must be four numbers, left, top, width, height")
    left, top, width, height = (float(value) for value in region)
    inside = 0 <= left < 1 and 0 <= top < 1 and width > 0 and height > 0
    if not (inside and left + width <= 1 + 1e-9 and top + height <= 1 + 1e-9):
        raise ValueError(
            f"region = {list(region)}: left, top, width, height are shares of the image: they must lie from 0 to 1 "
            f"and the region inside it"
        )
    return left, top, width, height


def cut(image: NDArray, region: Region = WHOLE) -> NDArray:
    """View of the region of an image (H, W), at least SMALLEST pixels along each side.

    Raises:
        ValueError: the image or the region in it is too small.
    """
    left, top, width, height = region
    rows, columns = image.shape
    first_row, first_column = math.floor(top * rows), math.floor(left * columns)
    last_row = math.ceil(round((top + height) * rows, 6))
    last_column = math.ceil(round((left + width) * columns, 6))
    view = image[first_row:last_row, first_column:last_column]
    if min(view.shape) < SMALLEST:
        raise ValueError(
            f"region = {list(region)}: only {view.shape[1]} x {view.shape[0]} px of an image of {columns} x {rows} px; "
            f"at least {SMALLEST} x {SMALLEST} are needed"
        )
    return view


def tenengrad(image: NDArray, pixel_budget: int = PIXEL_BUDGET) -> float:
    """Mean squared Sobel gradient over the squared mean of an image (H, W) of any number type; no unit, 0 if black."""
    above, here, below = _rows(image, pixel_budget)
    smooth = above + 2 * here + below
    along_x = smooth[:, 2:] - smooth[:, :-2]
    step = below - above
    along_y = step[:, :-2] + 2 * step[:, 1:-1] + step[:, 2:]
    return _relative(_mean_square(along_x) + _mean_square(along_y), here)


def laplacian(image: NDArray, pixel_budget: int = PIXEL_BUDGET) -> float:
    """Mean squared Laplacian over the squared mean of an image (H, W) of any number type; no unit, 0 if black."""
    above, here, below = _rows(image, pixel_budget)
    value = above[:, 1:-1] + below[:, 1:-1] + here[:, :-2] + here[:, 2:] - 4 * here[:, 1:-1]
    return _relative(_mean_square(value), here)


METRICS: dict[str, Callable[[NDArray], float]] = {"tenengrad": tenengrad, "laplacian": laplacian}


def _rows(image: NDArray, pixel_budget: int) -> tuple[NDArray, NDArray, NDArray]:
    """Rows with their neighbours above and below, float32, thinned out to the budget; NaN counts as black."""
    stride = max(1, math.ceil((image.shape[0] - 2) * image.shape[1] / pixel_budget))
    rows = [image[start : image.shape[0] - 2 + start : stride].astype(np.float32) for start in (0, 1, 2)]
    if image.dtype.kind == "f":
        rows = [np.nan_to_num(part, copy=False, nan=0.0, posinf=0.0, neginf=0.0) for part in rows]
    return rows[0], rows[1], rows[2]


def _mean_square(values: NDArray) -> float:
    return float(np.vdot(values, values)) / values.size


def _relative(value: float, image: NDArray) -> float:
    mean = float(image.mean(dtype=np.float64))
    return value / mean**2 if mean != 0 else 0.0
