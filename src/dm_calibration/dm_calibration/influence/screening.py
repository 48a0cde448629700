"""Which maps are fit for the regression, and why the others are not."""

import numpy as np

from dm_calibration.influence.maps import MapSet
from dm_common import Floats

#: Median absolute deviation to standard deviation, for normal errors.
MAD_TO_SIGMA = 1.4826
#: Maps with a leverage above this fix something alone: their own residual says nothing about them.
LEVERAGE_MAX = 0.95
#: Largest share of sampling points without data.
MISSING_POINTS_MAX = 0.2
#: No map with a smaller residual is an outlier, m rms.
RESIDUAL_FLOOR = 5e-9
#: Largest share of the maps that may be dropped as outliers.
DROPPED_MAX = 0.25


def unusable(maps: MapSet, valid_fraction_min: float) -> list[str]:
    """Reason for which each map cannot enter a fit; "" = it can."""
    reasons = []
    for coefficients, applied, sag, valid in zip(
        maps.coefficients, maps.applied, maps.sag, maps.valid_fraction, strict=True
    ):
        reason, missing = "", np.isnan(sag).mean()
        if not np.isfinite(coefficients).all():
            reason = "a Zernike coefficient is not finite"
        elif not np.isfinite(applied).all():
            reason = "an applied signal is not finite"
        elif np.isinf(sag).any():
            reason = "a sag sample is infinite"
        elif not valid >= valid_fraction_min:
            reason = f"too few valid pixels: {valid:.1%} of the aperture, at least {valid_fraction_min:.0%} are needed"
        elif missing > MISSING_POINTS_MAX:
            reason = f"{missing:.1%} of the sampling points have no data, at most {MISSING_POINTS_MAX:.0%} may"
        reasons.append(reason)
    return reasons


def worst_outlier(
    residual_rms: Floats,
    leverage: Floats,
    moved: Floats,
    response: Floats,
    outlier_sigmas: float,
    hysteresis_allowance: float,
) -> tuple[int, str] | None:
    """The map that stands out most from the fit, with the reason; None when none does.

    A fit follows a map the more, the greater the map's leverage; residual / sqrt(1 - leverage) makes up for that. A map
    is an outlier when this exceeds the median by `outlier_sigmas` robust sigmas *and* what hysteresis can explain: an
    allowance for the actuators moved, added up without coherence. A small move carries the remanence of larger ones
    before it, so the largest move up to then counts.

    Args:
        residual_rms: (M,) m.
        leverage: (M,).
        moved: (M, N) signals from where the mirror rests, normalised.
        response: (N,) rms sag per unit signal, m.
    """
    judged = leverage < LEVERAGE_MAX
    if judged.sum() < 3:
        return None
    scaled = np.where(judged, residual_rms / np.sqrt(np.maximum(1.0 - leverage, 1.0 - LEVERAGE_MAX)), 0.0)
    median = float(np.median(scaled[judged]))
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(scaled[judged] - median)))
    move = np.sqrt(np.square(moved) @ np.square(response))
    allowance = hysteresis_allowance * np.maximum.accumulate(move)
    limit = np.maximum(np.maximum(median + outlier_sigmas * sigma, RESIDUAL_FLOOR), allowance)
    outside = scaled > limit
    if not outside.any():
        return None
    # The square of this is what leaving the map out takes off the sum of squares. A bad map of great leverage pulls
    # good ones out of their (narrower) limits, but takes off most itself.
    worst = int(np.argmax(np.where(outside, scaled, 0.0)))
    return worst, (
        f"outlier: {scaled[worst] * 1e9:.1f} nm rms from what the maps together say, limit {limit[worst] * 1e9:.1f} nm"
    )
