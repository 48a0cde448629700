"""Regression of coefficients and sag at once, when single sampling points have no data."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.regression import Design, Regression, TooFewMapsError, least_squares
from dm_common.optics.piston_tilt import fill_gaps, remove_piston_tilt, weighted_fit
from dm_common.optics.zernike import basis

Floats = NDArray[np.float64]

#: Rounds in which sampling points without data are filled from the fit, and the change in m that ends them sooner.
GAP_ROUNDS = 60
GAP_TOLERANCE = 1e-11


def usable_sag(maps: MapSet, reasons: list[str]) -> Floats:
    """Sag of usable maps with piston and tilt removed; gaps still NaN, unusable maps zero.

    Args:
        reasons: (M,) why a map cannot be used; "" = it can.

    Returns:
        (M, P) m.

    Raises:
        TooFewMapsError: no map can be used.
    """
    usable = np.array([not reason for reason in reasons], dtype=bool)
    sag = np.zeros_like(maps.sag)
    if not usable.any():
        raise TooFewMapsError(f"none of the {len(maps)} maps is usable; the first: {maps.label[0]}: {reasons[0]}")
    sag[usable] = remove_piston_tilt(maps.sag[usable], maps.points)
    return sag


def regress(design: Design, maps: MapSet, sag: Floats) -> tuple[Regression, Floats]:
    """Regress coefficients and sag together; points without data are filled from the fit, round by round.

    That is the expectation-maximisation form of least squares with missing data; a gap converges as fast as the other
    maps, rather than its own, determine the fit there.

    Args:
        sag: (M, P) m, piston and tilt removed, NaN = no data.

    Returns:
        The regression, and its responses (M, K + P): coefficients and sag without gaps, m.
    """
    gaps = np.isnan(sag).any(axis=1)
    if not gaps.any():
        responses = np.hstack((maps.coefficients, sag))
        return least_squares(design, responses), responses
    modes = basis(maps.points.x, maps.points.y)
    filled = sag.copy()
    model = weighted_fit(sag[gaps], modes, maps.points.weight) @ modes.T
    projection = np.linalg.qr(design.matrix)[0]
    for _ in range(GAP_ROUNDS):
        before = filled[gaps]
        filled[gaps] = fill_gaps(sag[gaps], model, maps.points)
        if np.abs(filled[gaps] - before).max(initial=0.0) < GAP_TOLERANCE:  # NaN in the first round
            break
        model = projection[gaps] @ (projection.T @ filled)
    responses = np.hstack((maps.coefficients, filled))
    return least_squares(design, responses), responses
