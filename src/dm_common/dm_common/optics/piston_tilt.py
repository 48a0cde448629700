"""Fit and removal of piston and tilt, which depend on the interferometer's alignment, in maps and in sag samples."""

import numpy as np

from dm_common import Floats
from dm_common.optics.sampling import SamplePoints


def fit_plane(sag: Floats) -> Floats:
    """Least-squares plane through the valid pixels.

    Args:
        sag: (height, width), NaN = no data.

    Returns:
        (piston at the map's centre, slope per column, slope per row), in the unit of the sag. A slope that the valid
        pixels do not determine (a single row or column) is 0.
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


def remove_plane(sag: Floats) -> Floats:
    """Return the map minus its least-squares plane; NaN stays NaN."""
    piston, slope_x, slope_y = fit_plane(sag)
    height, width = sag.shape
    plane_x = piston + slope_x * (np.arange(width) - (width - 1) / 2)
    plane_y = slope_y * (np.arange(height) - (height - 1) / 2)
    return sag - plane_x - plane_y[:, None]


def weighted_fit(sag: Floats, modes: Floats, weight: Floats) -> Floats:
    """Weighted least-squares coefficients of `modes` (P, J) in each row of `sag` (M, P); NaN points are left out.

    Returns (M, J), in the unit of `sag` per unit of the modes.
    """
    seen = np.isfinite(sag)
    if seen.all():
        weighted = modes * weight[:, None]
        return np.asarray(np.linalg.solve(weighted.T @ modes, weighted.T @ sag.T).T)
    shares = seen * weight
    products = modes[:, :, None] * modes[:, None, :]
    gram = (shares @ products.reshape(modes.shape[0], -1)).reshape(len(sag), modes.shape[1], modes.shape[1])
    right = (shares * np.where(seen, sag, 0.0)) @ modes
    # The pseudo-inverse also handles maps with too few points; screening drops those.
    return np.einsum("mij,mj->mi", np.linalg.pinv(gram, hermitian=True), right)


def remove_piston_tilt(sag: Floats, points: SamplePoints) -> Floats:
    """Rows of `sag` (M, P) less their area-weighted best plane; NaN stays NaN."""
    plane = np.column_stack((np.ones_like(points.x), points.x, points.y))
    return np.asarray(sag - weighted_fit(sag, plane, points.weight) @ plane.T)


def fill_gaps(sag: Floats, model: Floats, points: SamplePoints) -> Floats:
    """Fill NaN in `sag` (M, P) with `model` (M, P), fitted to each map in piston and tilt; remove piston and tilt."""
    plane = np.column_stack((np.ones_like(points.x), points.x, points.y))
    departure = sag - model
    shifted = model + weighted_fit(departure, plane, points.weight) @ plane.T
    return remove_piston_tilt(np.where(np.isfinite(sag), sag, shifted), points)


def rms(sag: Floats, weight: Floats) -> Floats:
    """Area-weighted rms of each row of `sag` (..., P), m."""
    return np.asarray(np.sqrt(np.square(sag) @ weight))
