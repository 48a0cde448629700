"""Sharpness of an image: one number that is largest in focus.

`tenengrad` is the mean squared Sobel gradient [22, 23], `laplacian` the mean squared Laplacian (both compared in [24]).
Both are divided by the squared mean grey level, so that exposure, gain and flicker drop out. The Laplacian answers to
finer detail and to noise.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

#: Left, top, width and height as shares 0..1 of the image.
Region = tuple[float, float, float, float]
WHOLE: Region = (0.0, 0.0, 1.0, 1.0)

#: Most pixels that enter one figure; of larger regions only every n-th row is used.
PIXEL_BUDGET = 400_000
#: Smallest mean of grey levels relative to that of their absolute values: below it, negative levels cancel the others.
CANCELLED = 0.5
#: Smallest region [px along a side] that has a gradient.
SMALLEST = 3


def check_region(region: Sequence[float]) -> Region:
    """The region as a tuple. Raises ValueError if it is not four numbers, or not inside the image."""
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


def region_of(roi: Any, width: int, height: int) -> Region:
    """The region of a `sensor_msgs/RegionOfInterest` in an image of this size in pixels; all zeros = the whole image.

    Raises:
        ValueError: it is not inside the image.
    """
    if not (roi.x_offset or roi.y_offset or roi.width or roi.height):
        return WHOLE
    right, below = roi.x_offset + roi.width, roi.y_offset + roi.height
    if not (0 <= roi.x_offset < right <= width and 0 <= roi.y_offset < below <= height):
        raise ValueError(
            f"x_offset, y_offset, width, height = {roi.x_offset}, {roi.y_offset}, {roi.width}, {roi.height}: must lie "
            f"in an image of {width} x {height} px"
        )
    # If a share were rounded down, `cut` would begin one pixel earlier.
    left, top = math.nextafter(roi.x_offset / width, 1), math.nextafter(roi.y_offset / height, 1)
    return left, top, roi.width / width, roi.height / height


def cut(image: NDArray, region: Region = WHOLE) -> NDArray:
    """View of the region of an image (H, W). Raises ValueError if it has less than SMALLEST pixels along a side."""
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
    along_x, along_y = _sobel(above, here, below)
    return _relative(here, along_x, along_y)


def local_tenengrad(image: NDArray, cell: int) -> NDArray[np.float32]:
    """`tenengrad` around each cell of an image (H, W), three by three cells wide; of the shape (H / cell, W / cell).

    The mean grey level is that of the whole image. Cells at the right and lower edge may be smaller than others.
    """
    framed = np.pad(_finite(image), 1, mode="edge")
    along_x, along_y = _sobel(framed[:-2], framed[1:-1], framed[2:])
    value = along_x**2 + along_y**2
    for axis, side in enumerate(image.shape):
        starts = np.arange(0, side, cell)
        sizes = np.diff(starts, append=side).astype(np.float32)
        value = np.add.reduceat(value, starts, axis) / np.expand_dims(sizes, 1 - axis)
    mean = float(framed.mean(dtype=np.float64))
    around = sliding_window_view(np.pad(value, 1, mode="edge"), (3, 3)).mean((2, 3))
    return around / np.float32(mean**2) if mean != 0 else around


def laplacian(image: NDArray, pixel_budget: int = PIXEL_BUDGET) -> float:
    """Mean squared Laplacian over the squared mean of an image (H, W) of any number type; no unit, 0 if black."""
    above, here, below = _rows(image, pixel_budget)
    value = above[:, 1:-1] + below[:, 1:-1] + here[:, :-2] + here[:, 2:] - 4 * here[:, 1:-1]
    return _relative(here, value)


METRICS: dict[str, Callable[[NDArray], float]] = {"tenengrad": tenengrad, "laplacian": laplacian}


def _rows(image: NDArray, pixel_budget: int) -> tuple[NDArray, NDArray, NDArray]:
    """Rows with their neighbours above and below, float32, thinned out to the budget; NaN counts as black."""
    if image.dtype.kind == "f":
        image = _finite(image)
    stride = max(1, math.ceil((image.shape[0] - 2) * image.shape[1] / pixel_budget))
    above, here, below = (image[start : image.shape[0] - 2 + start : stride] for start in (0, 1, 2))
    return above.astype(np.float32), here.astype(np.float32), below.astype(np.float32)


def _finite(image: NDArray) -> NDArray[np.float32]:
    """As float32, non-finite numbers as black; floats scaled by a power of two to below 1, lest squares overflow.

    Raises ValueError where their mean says nothing of the exposure, as after a background was subtracted.
    """
    values = image.astype(np.float32)
    if image.dtype.kind != "f":
        return values
    np.nan_to_num(values, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
    sizes = np.abs(values)
    mean, size = (float(each.mean(dtype=np.float64)) for each in (values, sizes))
    if mean < CANCELLED * size:
        raise ValueError(
            f"negative grey levels cancel the positive ones: the mean is {mean / size:.0%} of the mean absolute value"
        )
    return np.ldexp(values, -np.frexp(sizes.max())[1])


def _sobel(above: NDArray, here: NDArray, below: NDArray) -> tuple[NDArray, NDArray]:
    """Gradients along x and y of rows (H, W) by their neighbours, (H, W - 2)."""
    smooth = above + 2 * here + below
    step = below - above
    return smooth[:, 2:] - smooth[:, :-2], step[:, :-2] + 2 * step[:, 1:-1] + step[:, 2:]


def _relative(image: NDArray, *parts: NDArray) -> float:
    """Sum of the mean squares of `parts` over the squared mean of the image."""
    mean = float(image.mean(dtype=np.float64))
    return sum(float(np.vdot(part, part)) / part.size for part in parts) / mean**2 if mean != 0 else 0.0
