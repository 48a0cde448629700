"""Selection of the maps for the regression, with reasons for the others; options of the fit."""

from dataclasses import dataclass

import numpy as np

from dm_calibration.influence.maps import MapSet, StepKind
from dm_calibration.influence.weights import check_epsilon
from dm_common.errors import beside
from dm_common.values import live_parameter, real

#: Median absolute deviation to standard deviation, for normal errors.
MAD_TO_SIGMA = 1.4826
#: A map with a leverage above this determines an unknown alone, so its residual does not show whether it is good.
LEVERAGE_MAX = 0.95
#: Largest share of sampling points without data.
MISSING_POINTS_MAX = 0.2
#: Share of the pixels and of the sampling points that may be missing in a map beyond those missing in most maps. In a
#: larger gap (unlike scattered pixels, which cost no points) sag beyond the terms distorts the coefficients: by 10 to
#: 20 nm in random shapes, for a gap of a tenth. If more than the share GAPS_MAX of the maps have such gaps, all are
#: used; so are all maps of a run of pokes, since only a few of them show an actuator.
GAP_MAX, GAPS_MAX = 0.03, 0.25
#: No map with a smaller residual, m rms, is an outlier; with a hysteresis law, the limit is at least LAW_ERRORS times
#: the 95 % bound on the law's error of a coefficient.
RESIDUAL_FLOOR, LAW_ERRORS = 5e-9, 2.0
#: Largest share of the maps that may be dropped as outliers.
DROPPED_MAX = 0.25


@dataclass(frozen=True)
class FitOptions:
    """How to fit, and the thresholds beyond which maps and actuators are bad.

    Attributes:
        method: a name of METHODS.
        epsilon: m^2, above 0, the prior parameter of Eq. (8) for AZWreg; None = by cross-validation.
        residual_floor: m rms; no map with a smaller residual is an outlier.

    Raises:
        ValueError: fewer than 2 folds, or an epsilon that is not above 0.
    """

    method: str = "AZreg"
    folds: int = 10
    epsilon: float | None = None
    residual_floor: float = RESIDUAL_FLOOR
    valid_fraction_min: float = live_parameter(
        real(0.5, 0.0, 1.0), "Smallest share of valid pixels in the aperture for a map to be fitted, from any source."
    )
    outlier_sigmas: float = live_parameter(
        real(6.0, 3.0, 1e3), "Residual beyond which a map is dropped, in robust standard deviations above the median."
    )
    hysteresis_allowance: float = live_parameter(
        real(0.10, 0.0, 1.0),
        "Without a hysteresis law: share of its move by which hysteresis may make an actuator miss its target (half "
        "the loop, whose width is 7-15 % of the move) before the map is an outlier. 0 = no hysteresis: the error "
        "promised for moves is then that of held-out maps.",
    )
    dead_sigmas: float = live_parameter(
        real(3.0, 0.0, 1e3),
        "Dead if the rms response is below this many standard errors, and that of every point below twice as many.",
    )
    weak_sigmas: float = live_parameter(
        real(10.0, 0.0, 1e3), "Weak below this many standard errors, if the relative error exceeds twice the median."
    )
    weak_share: float = live_parameter(real(0.4, 0.0, 1.0), "Weak below this share of the median response of its ring.")

    def __post_init__(self) -> None:
        if self.folds < 2:
            raise ValueError(f"folds = {self.folds}: must be at least 2")
        if self.epsilon is not None:
            check_epsilon(self.epsilon)


def unusable(maps: MapSet, valid_fraction_min: float) -> list[str]:
    """For each map, the reason why it cannot enter a fit; "" = it can."""
    reasons = []
    seen, lacking = np.isfinite(maps.coefficients).all(axis=1), np.isnan(maps.sag).mean(axis=1)
    usual, gap = 0.0, np.zeros_like(seen)
    if seen.any() and StepKind.EXCITATION in maps.kind:
        usual = float(np.median(maps.valid_fraction[seen]))
        gap = seen & (maps.valid_fraction < usual - GAP_MAX) & (lacking > np.median(lacking[seen]) + GAP_MAX)
        gap &= gap.sum() <= GAPS_MAX * seen.sum()
    for coefficients, applied, sag, valid, missing, partial in zip(
        maps.coefficients, maps.applied, maps.sag, maps.valid_fraction, lacking, gap, strict=True
    ):
        reason = ""
        if not np.isfinite(coefficients).all():
            reason = "a Zernike coefficient is not finite"
        elif not np.isfinite(applied).all():
            reason = "an applied signal is not finite"
        elif np.isinf(sag).any():
            reason = "a sag sample is infinite"
        elif not valid >= valid_fraction_min:
            share = beside(".1%", valid, valid_fraction_min)
            reason = f"too few valid pixels: {share} of the aperture, at least {valid_fraction_min:.0%} are needed"
        elif partial:
            reason = f"a part of the surface is missing: {valid:.1%} of the aperture is valid, in most maps {usual:.1%}"
        elif missing > MISSING_POINTS_MAX:
            share = beside(".1%", missing, MISSING_POINTS_MAX)
            reason = f"{share} of the sampling points have no data: must be at most {MISSING_POINTS_MAX:.0%}"
        reasons.append(reason)
    return reasons
