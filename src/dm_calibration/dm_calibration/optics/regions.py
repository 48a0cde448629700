"""Concentric circular regions of the aperture (the paper's Fig. 4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .aperture import Aperture

#: Shares of the aperture's area, 10 % to 100 %.
AREA_FRACTIONS: tuple[float, ...] = tuple(k / 10 for k in range(1, 11))


class ConcentricRegions:
    """Concentric discs with given shares of the aperture's area, for maps of one shape and aperture."""

    def __init__(self, shape: tuple[int, int], aperture: Aperture, area_fractions: ArrayLike = AREA_FRACTIONS) -> None:
        """Find the region of every pixel.

        Args:
            shape: (height, width) of the maps.
            area_fractions: (R,) rising, above 0 and at most 1.

        Raises:
            ValueError: fractions out of range or order.
        """
        fractions = np.asarray(area_fractions, dtype=float)
        if not (fractions.size and (np.diff(fractions) > 0).all() and fractions[0] > 0 and fractions[-1] <= 1):
            raise ValueError(f"area_fractions = {fractions.tolist()}: must rise within 0 to 1")
        self.area_fractions = fractions
        # The ring between two discs, numbered from inside; one more number for everything outside.
        self._ring = np.searchsorted(fractions, aperture.squared_distance(shape)).astype(np.uint8).ravel()

    def rms(self, residual: NDArray[np.float64]) -> NDArray[np.float64]:
        """Root mean square (about zero) of a residual map inside each disc.

        Args:
            residual: (height, width), NaN = no data.

        Returns:
            (R,), in the unit of the residual; NaN for a disc without valid pixels.
        """
        squares = residual.ravel() ** 2
        valid = np.isfinite(squares)
        size = len(self.area_fractions) + 1
        energy = np.bincount(self._ring, np.where(valid, squares, 0.0), size)[:-1].cumsum()
        count = np.bincount(self._ring, valid, size)[:-1].cumsum()
        with np.errstate(invalid="ignore"):
            return np.sqrt(energy / count)
