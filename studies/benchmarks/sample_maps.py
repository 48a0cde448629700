"""Maps for benchmarks: a surface of all 21 terms, print-through beyond them, noise, and pixels without data."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dm_calibration.optics.aperture import Aperture
from dm_common import Floats
from dm_common.optics.zernike import TERMS, basis

#: Side of the camera's map, pixels.
CAMERA = 944
#: Share of the aperture's pixels without data.
DROPOUTS = 0.01


def full_aperture(pixels: int) -> Aperture:
    """The largest circle on a square map."""
    return Aperture((pixels - 1) / 2, (pixels - 1) / 2, pixels / 2)


def mask_of(pixels: int, generator: np.random.Generator) -> NDArray[np.bool_]:
    """(pixels, pixels): inside the largest circle, except for single pixels at random."""
    return full_aperture(pixels).disc((pixels, pixels)) & (generator.random((pixels, pixels)) >= DROPOUTS)


def surface(pixels: int, generator: np.random.Generator) -> Floats:
    """(pixels, pixels) m: about a micrometre of every term, and 40 nm of waves that no term describes."""
    axis = (np.arange(pixels) - (pixels - 1) / 2) / (pixels / 2)
    coefficients = generator.normal(size=len(TERMS)) * 1e-6
    # One row of the map at a time: all terms of a map of 4096 x 4096 pixels would take 3 GB.
    sag = np.stack([basis(axis, np.full(pixels, y)) @ coefficients for y in -axis])
    return sag + 40e-9 * np.cos(23 * axis) * np.cos(19 * axis)[:, None]


def maps(pixels: int, count: int, generator: np.random.Generator) -> tuple[list[Floats], NDArray[np.bool_]]:
    """`count` maps (pixels, pixels) m with the same mask, NaN = no data, and the mask."""
    mask = mask_of(pixels, generator)
    sag = np.where(mask, surface(pixels, generator), np.nan)
    return [sag + 1e-9 * generator.normal(size=sag.shape) for _ in range(count)], mask


class CyclicMaps:
    """Gives the next of some maps at every call: too many to fit in the caches, so that each comes from memory."""

    def __init__(self, items: list[Floats], start: int = 0) -> None:
        self._items, self._next = items, start

    def __call__(self) -> Floats:
        self._next = (self._next + 1) % len(self._items)
        return self._items[self._next]
