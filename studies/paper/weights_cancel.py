"""Eq. (7) against Eq. (6) in [1]: weights on the rows of dC - G dS have no effect while all of G is free."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dm_common import Floats

#: Smallest singular value, relative to the largest, at which a least-squares problem still counts as determined.
RANK_TOLERANCE = 1e-7


def weights_cancel_max_abs(delta_c: Floats, delta_s: Floats, weights: ArrayLike) -> float:
    """Largest difference between the G of Eq. (7), with weights on the rows, and the G of Eq. (6): only rounding.

    Eq. (7) is solved as one problem in all K N unknowns of G at once, without using the independence of its rows.

    Args:
        delta_c: (K, M) changes of the coefficients, m.
        delta_s: (N, M) changes of the signals.
        weights: (K,) diagonal of W, above 0.

    Returns:
        max |G7 - G6|, m per unit signal.

    Raises:
        ValueError: shapes that disagree, weights not above 0, or signals that do not determine G.
    """
    w = np.asarray(weights, dtype=float)
    rows, maps = delta_c.shape
    actuators = delta_s.shape[0]
    if delta_s.shape != (actuators, maps):
        raise ValueError(f"delta_s has the shape {delta_s.shape}, delta_c {delta_c.shape}: as many columns are needed")
    if w.shape != (rows,) or not (np.isfinite(w) & (w > 0.0)).all():
        raise ValueError(f"weights: must be {rows} finite numbers above 0, one per row of delta_c")
    if maps < actuators:
        raise ValueError(f"{maps} surfaces for {actuators} unknowns per row of G: at least {actuators} are needed")
    solution, _, rank, _ = np.linalg.lstsq(delta_s.T, delta_c.T, rcond=RANK_TOLERANCE)
    if rank < actuators:
        raise ValueError(
            f"the signals span {rank} of {actuators} directions: some actuators never move, or only together with "
            "others; add surfaces that move each on its own"
        )
    # Row-major vectors: vec(W G S) = kron(W, S^T) vec(G). QR of the whole, scaled columns for its conditioning.
    whole = np.kron(np.diag(w), delta_s.T)
    scale = np.linalg.norm(whole, axis=0)
    q, r = np.linalg.qr(whole / scale)
    weighted = np.linalg.solve(r, q.T @ (w[:, np.newaxis] * delta_c).ravel()) / scale
    return float(np.abs(weighted.reshape(rows, actuators) - solution.T).max())
