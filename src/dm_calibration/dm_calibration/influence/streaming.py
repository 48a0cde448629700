"""The influence function at every pixel, from maps that pass by one at a time.

Eq. (6) is linear in the maps: with the design A (M, p) known before the first map arrives, the coefficients of all
pixels are ``A⁺ Z`` for the maps Z (M, V) of V pixels, one product of a thin and a wide matrix. The row of A that
belongs to a map says how it enters, so the sum can grow map by map: ``Σ A⁺[:, m] Z[m]``, in (p, V) whatever M is.

Adding one map is an update of rank 1, which reads and writes the whole sum. Done for some maps at once it does so once
for all of them: maps wait in a buffer of fixed size until one product adds them all in place. The loop of dmlib
(J. Antonello) keeps a sum of the same size by updates of rank 1, from normal equations, which square the condition
number of the commands.

A pixel without data in some map has no influence function: least squares there would need a design of its own. Pixels
do not mix, so NaN in a map is NaN in the result at that pixel and nowhere else. Piston and tilt that change from map to
map belong to the interferometer; remove them before (:func:`~dm_common.optics.piston_tilt.remove_plane`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.blas import dgemm

Floats = NDArray[np.float64]

#: Smallest singular value of the design, relative to the largest, that still tells its columns apart.
RANK_TOLERANCE = 1e-7
#: Maps that enter the sum together. Each costs as much memory as an unknown; more would save little time.
BUFFERED_MAPS = 25


class InfluenceAccumulator:
    """Least-squares coefficients of all pixels of maps that are given one after the other.

    Attributes:
        unknowns: p, columns of the design.
        maps: M, rows of the design.
        added: maps given so far.
    """

    def __init__(self, design: ArrayLike, shape: tuple[int, int]) -> None:
        """Prepare for the maps of one run.

        Args:
            design: (M, p) what was applied in each map: normalised signals, and columns of the figure at rest.
            shape: (height, width) of the maps.

        Raises:
            ValueError: the design is not finite, has fewer rows than columns, or does not tell its columns apart.
        """
        rows = np.asarray(design, dtype=float)
        if rows.ndim != 2 or not np.isfinite(rows).all() or not 0 < rows.shape[1] <= rows.shape[0]:
            raise ValueError(f"design of shape {rows.shape}: must be finite, with at least as many maps as unknowns")
        left, singular, right = np.linalg.svd(rows, full_matrices=False)
        if singular[-1] < RANK_TOLERANCE * singular[0]:
            raise ValueError(
                f"design: the smallest singular value is {singular[-1] / singular[0]:.1e} of the largest: must be at "
                f"least {RANK_TOLERANCE:g}, or the maps do not tell the actuators apart"
            )
        self._inverse = (right.T / singular) @ left.T  # (p, M)
        self.maps, self.unknowns = rows.shape
        self.added = 0
        self._shape = shape
        pixels = shape[0] * shape[1]
        self._sum = np.zeros((self.unknowns, pixels))
        self._buffer = np.empty((min(BUFFERED_MAPS, self.maps), pixels))
        self._filled = 0

    def add(self, sag: Floats) -> None:
        """Take the next map, in the order of the rows of the design.

        Args:
            sag: (height, width) m, NaN = no data.

        Raises:
            ValueError: another shape, or more maps than the design has rows.
        """
        if sag.shape != self._shape:
            raise ValueError(f"map {self.added + 1} has the shape {sag.shape}: must be {self._shape}")
        if self.added == self.maps:
            raise ValueError(f"map {self.added + 1}: the design has only {self.maps} rows")
        self._buffer[self._filled].reshape(self._shape)[...] = sag
        self._filled += 1
        self.added += 1
        if self._filled == len(self._buffer):
            self._flush()

    def _flush(self) -> None:
        """Add the buffered maps to the sum."""
        share = np.ascontiguousarray(self._inverse[:, self.added - self._filled : self.added])
        # sum += share @ maps in place, which NumPy cannot; BLAS sees the transposed, column by column.
        dgemm(1.0, self._buffer[: self._filled].T, share.T, 1.0, self._sum.T, overwrite_c=1)
        self._filled = 0

    def result(self) -> Floats:
        """(p, height, width) coefficients in the unit of the maps per unit of the design; NaN = no data.

        Raises:
            ValueError: maps are missing.
        """
        if self.added != self.maps:
            raise ValueError(f"{self.added} maps were added: the design has {self.maps} rows")
        if self._filled:
            self._flush()
        return self._sum.reshape(self.unknowns, *self._shape)
