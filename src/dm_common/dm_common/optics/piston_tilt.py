"""Piston and tilt of a map: what the interferometer's alignment adds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def fit_plane(sag: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least-squares plane through the valid pixels.

    Args:
        sag: (height, width), NaN = no data.

    Returns:
        (piston at the map's centre, slope per column, slope per row), in the unit of the sag. A slope that the valid
        pixels cannot tell (a single row or column) is 0.
    """
    valid = np.isfinite(sag)
    if not valid.any():
        raise ValueError("the map has no valid pixel")
    height, width = sag.shape
    x = np.arange(width) - (width - 1) / 2
    y = np.arange(height) - (height - 1) / 2
    filled = np.where(valid, sag, 0.0)
    in_column, in_row = valid.sum(axis=0), valid.sum(axis=1)
    xy = y @ (valid @ x)
    gram = np.array(
        [
            [in_column.sum(), in_column @ x, in_row @ y],
            [in_column @ x, in_column @ x**2, xy],
            [in_row @ y, xy, in_row @ y**2],
        ],
        dtype=float,
    )
    moments = np.array([filled.sum(), filled.sum(axis=0) @ x, filled.sum(axis=1) @ y])
    return np.linalg.lstsq(gram, moments, rcond=1e-12)[0]


def remove_piston_tilt(sag: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the map minus its least-squares plane; NaN stays NaN."""
    piston, slope_x, slope_y = fit_plane(sag)
    height, width = sag.shape
    plane_x = piston + slope_x * (np.arange(width) - (width - 1) / 2)
    plane_y = slope_y * (np.arange(height) - (height - 1) / 2)
    return sag - plane_x - plane_y[:, None]
