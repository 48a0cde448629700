"""Sag vectors at the sampling points: piston and tilt, which no interferometer knows, and points without data."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dm_common.optics.sampling import SamplePoints

Floats = NDArray[np.float64]


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
    # The pseudo-inverse serves maps with too few points as well; screening drops those.
    return np.einsum("mij,mj->mi", np.linalg.pinv(gram, hermitian=True), right)


def remove_piston_tilt(sag: Floats, points: SamplePoints) -> Floats:
    """Rows of `sag` (M, P) less their area-weighted best plane; NaN stays NaN."""
    plane = np.column_stack((np.ones_like(points.x), points.x, points.y))
    return np.asarray(sag - weighted_fit(sag, plane, points.weight) @ plane.T)


def fill_gaps(sag: Floats, model: Floats, points: SamplePoints) -> Floats:
    """Put `model` (M, P), fitted to each map in piston and tilt, where `sag` (M, P) is NaN; piston and tilt removed."""
    plane = np.column_stack((np.ones_like(points.x), points.x, points.y))
    departure = sag - model
    shifted = model + weighted_fit(departure, plane, points.weight) @ plane.T
    return remove_piston_tilt(np.where(np.isfinite(sag), sag, shifted), points)


def rms(sag: Floats, weight: Floats) -> Floats:
    """Area-weighted rms of each row of `sag` (..., P), m."""
    return np.asarray(np.sqrt(np.square(sag) @ weight))
