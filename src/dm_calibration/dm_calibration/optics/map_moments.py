"""Moments of a map, and of a mask, against products of polynomials: the kernels of the full-map fit.

**Of a map.** With the polynomials of the rows in P (h, d) and of the columns in Q (w, d), all d x d moments of a map Z
are two thin products, P^T Z Q. The time is limited by memory access, not by arithmetic: pixels without data must become
0 first, which costs a copy of the map, and each further pass over the copy costs as much as reading it. So the map is
taken in blocks of rows that fit in the processor's second-level cache. While a block is in the cache it is copied, its
unused pixels are set to 0, and it is added to the energy and to P^T Z; main memory is read once and never written.
Rows are copied as a whole, even if the aperture fills only part of them: prefetching works only on contiguous memory.

**Of a mask.** A row of a mask is a few runs of pixels, and the sum of a polynomial over a run is a difference of two
cumulative sums. One look-up per end of a run replaces a product over all pixels. Scattered dropouts are runs too; from
about one pixel in 32 on there are so many runs that the plain product is faster.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dgemm
from scipy.sparse import csr_array

from dm_common import Bools, Floats

#: Bytes of a block: with the data read meanwhile it fits in a second-level cache of 0.5 to 1 MB.
_BLOCK_BYTES = 384 * 1024
#: The same for the mask, which shares the cache with little else.
_MASK_BLOCK_BYTES = 64 * 1024
#: Pixels per run of a mask below which the plain product is faster than looking up the ends of the runs.
_PIXELS_PER_RUN = 32


@dataclass(frozen=True, eq=False)
class _Block:
    """Rows from start to stop. Unused are the columns before `first` and from `last` on, and flat indices `unused`."""

    start: int
    stop: int
    first: int
    last: int
    unused: NDArray[np.intp]
    rows_basis: Floats  # (stop - start, d), column-major as BLAS takes it


class MaskedMoments:
    """Moments and energy of maps over the pixels of one mask."""

    def __init__(self, mask: Bools, rows_basis: Floats, columns_basis: Floats) -> None:
        """Find the unused pixels of each block.

        Args:
            mask: (h, w), True where a pixel counts.
            rows_basis: (h, d) polynomials at the rows.
            columns_basis: (w, d) polynomials at the columns.
        """
        height, width = mask.shape
        self._columns_basis = columns_basis
        size = max(_BLOCK_BYTES // (8 * max(width, 1)), 1)
        self._work = np.zeros((min(size, height), width))
        self._blocks = []
        for start in range(0, height, size):
            stop = min(start + size, height)
            part = mask[start:stop]
            filled = np.flatnonzero(part.any(axis=0))
            first, last = (int(filled[0]), int(filled[-1]) + 1) if filled.size else (width, width)
            unused = ~part
            unused[:, :first] = unused[:, last:] = False
            basis = np.asfortranarray(rows_basis[start:stop])
            self._blocks.append(_Block(start, stop, first, last, np.flatnonzero(unused), basis))

    def of(self, sag: Floats) -> tuple[Floats, float]:
        """Moments and sum of squares of a map.

        Args:
            sag: (h, w); pixels outside the mask may hold anything.

        Returns:
            (d, d) moments [polynomial of the rows, of the columns], and the energy; the energy is not finite when a
            pixel under the mask is not.
        """
        sums = np.zeros((self._columns_basis.shape[0], self._columns_basis.shape[1]), order="F")
        energy = 0.0
        for block in self._blocks:
            work = self._work[: block.stop - block.start]
            flat = work.reshape(-1)
            work[...] = sag[block.start : block.stop]
            work[:, : block.first] = 0.0
            work[:, block.last :] = 0.0
            flat[block.unused] = 0.0
            energy += float(np.dot(flat, flat))
            sums = dgemm(1.0, work.T, block.rows_basis, 1.0, sums, overwrite_c=1)
        if not math.isfinite(energy):
            return np.full((sums.shape[1], sums.shape[1]), math.nan), energy
        return sums.T @ self._columns_basis, energy


def mask_moments(mask: Bools, rows_basis: Floats, columns_basis: Floats) -> Floats:
    """(d, d) sums over the pixels of a mask (h, w) of the products of polynomials (h, d) and (w, d)."""
    height, width = mask.shape
    rows = max(_MASK_BLOCK_BYTES // max(width, 1), 1)
    bordered = np.zeros((min(rows, height), width + 2), dtype=bool)
    found = []
    for start in range(0, height, rows):
        part = bordered[: min(rows, height - start)]
        part[:, 1:-1] = mask[start : start + rows]
        found.append(np.flatnonzero(part[:, 1:] != part[:, :-1]) + start * (width + 1))
    ends = np.concatenate(found)  # start, stop, start, stop, ... row by row
    if ends.size * _PIXELS_PER_RUN > 2 * mask.size:
        result: Floats = rows_basis.T @ (mask.astype(float) @ columns_basis)
        return result
    row, column = np.divmod(ends, width + 1)
    sign = np.ones(ends.size)
    sign[::2] = -1.0
    first_of_row = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=height))])
    signed_ends = csr_array((sign, column, first_of_row), shape=(height, width + 1))
    running = np.vstack([np.zeros(columns_basis.shape[1]), np.cumsum(columns_basis, axis=0)])
    return np.asarray(rows_basis.T @ (signed_ends @ running))
