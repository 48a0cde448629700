"""Fit the influence function to the maps of a calibration, with figures of its quality.

The model is ``c = c0 + G s`` for the Zernike coefficients (Eq. 6 in [1]) and ``z = z0 + H s`` for the sag at the
sampling points. Both are regressions on the same design: the applied signals and a figure that drifts from reference
frame to reference frame (see :mod:`~dm_calibration.influence.regression`). An interferometer does not know piston and
tilt, so they are removed, area-weighted, from every sag vector before the fit and from every residual that is reported.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dm_calibration.influence import quality, screening
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.region_weighting import choose_weighting, weighted_coefficients
from dm_calibration.influence.regression import (
    METHODS,
    Design,
    Regression,
    TooFewMapsError,
    least_squares,
    make_design,
    regress,
    variance_at_points,
)
from dm_calibration.influence.screening import FitOptions
from dm_common import Bools, Floats, Ints
from dm_common.errors import unknown_name
from dm_common.limits import Limits
from dm_common.optics.piston_tilt import rms
from dm_common.optics.sampling import SamplePoints
from dm_common.optics.zernike import PISTON_TILT


@dataclass(frozen=True)
class InfluenceFit:
    """An influence function with its quality. N actuators, K Zernike terms, P sampling points, M maps.

    Attributes:
        influence_zernike: (K, N) m per unit signal; columns of actuators that never moved are 0.
        zernike_offset: (K,) m, figure at zero signals, averaged over the run.
        influence_sag: (P, N) m per unit signal, piston and tilt removed.
        sag_offset: (P,) m, piston and tilt removed.
        signal_min, signal_max: range of applied signals in the maps used.
        used: (M,) which maps entered the fit.
        reasons: (M,) why not; "" for those used.
        map_residual: (M,) rms sag left by the fit, m; NaN for maps not used.
        in_sample_rms: rms sag over all maps used, m.
        held_out_rms: the same for maps predicted from a fit that has not seen them, m.
        held_out_max_zernike: 95th percentile over held-out maps of the largest coefficient error without piston and
            tilt, m; plus the joint error of all actuators if the maps show hysteresis that no law describes.
        condition_number: of influence_zernike without piston (and without tilt when the maps do not show it).
        response: (N,) rms sag of a unit signal, m.
        standard_error: (N,) of the response, m.
        signal_covariance: (N, N) covariance of each row of G, for coefficients of unit variance.
        grades: (N,) quality.GRADE_*.
        drift_rms: rms sag of the figure about its mean over the run, m.
        limitations: sentences a user of the result must know.
    """

    method: str
    influence_zernike: Floats
    zernike_offset: Floats
    influence_sag: Floats
    sag_offset: Floats
    points: SamplePoints
    signal_min: float
    signal_max: float
    used: Bools
    reasons: tuple[str, ...]
    map_residual: Floats
    in_sample_rms: float
    held_out_rms: float
    held_out_max_zernike: float
    condition_number: float
    response: Floats
    standard_error: Floats
    signal_covariance: Floats
    grades: NDArray[np.uint8]
    drift_rms: float
    limitations: tuple[str, ...]

    @property
    def actuators(self) -> int:
        return int(self.influence_zernike.shape[1])


def fit_influence(
    maps: MapSet,
    options: FitOptions | None = None,
    *,
    rings: Ints | None = None,
    limits: Limits | None = None,
    exclude: Collection[str] = (),
) -> InfluenceFit:
    """Fit the influence function to `maps`.

    Args:
        rings: (N,) ring of each actuator, for the grades; None = all are compared with each other.
        limits: of the signals. If given, the error includes hysteresis that no law describes; None = it does not.

    Raises:
        UnknownNameError: an unknown method or label, listing the near ones.
        TooFewMapsError: the good maps do not determine the unknowns.
        EmptyRegionError: the method needs region weights, and some map has no data in a region.
        ValueError: the method needs region weights, and the maps determine none.
    """
    options = options or FitOptions()
    if options.method not in METHODS:
        raise unknown_name("method", options.method, METHODS)
    for label in exclude:
        if label not in maps.label:
            raise unknown_name("map label", label, maps.label)
    reasons = screening.unusable(maps, options.valid_fraction_min)
    reasons = ["excluded by request" if label in exclude else r for label, r in zip(maps.label, reasons, strict=True)]
    if all(reasons):
        rejected = maps.rejected(reasons)
        if not rejected:
            raise TooFewMapsError("no command has a map")
        raise TooFewMapsError(f"none of the {len(rejected)} maps is usable; the first: {': '.join(rejected[0])}")
    fitted = _fit_good(maps, reasons)
    for _ in range(int(screening.DROPPED_MAX * len(maps))):
        outlier = fitted.worst_outlier(options)
        if outlier is None:
            break
        index = maps.label.index(fitted.maps.label[outlier[0]])
        reasons[index] = outlier[1]
        try:
            fitted = _fit_good(maps, reasons)
        except TooFewMapsError:  # a doubtful map is better than none
            reasons[index] = ""
            break
    remarks = []
    if options.method == "AZWreg":
        # The weights do not change which maps are outliers: these are found in the sag, without weights.
        filled = fitted.responses[:, maps.terms :]
        weighting = choose_weighting(fitted.design, fitted.maps, filled, options.folds, options.epsilon)
        responses = np.hstack((weighted_coefficients(fitted.maps, filled, weighting.weights), filled))
        fitted = fitted._replace(regression=least_squares(fitted.design, responses), responses=responses)
        remarks.append(weighting.sentence())
    if fitted.worst_outlier(options) is not None:
        remarks.append(
            f"More than {screening.DROPPED_MAX:.0%} of the maps look like outliers; not all of them were dropped. "
            "This calibration is doubtful."
        )
    return _result_of(maps, options, rings, limits, reasons, fitted, remarks)


class _Fitted(NamedTuple):
    """Which of M maps are used, those maps, and the design, result and responses of their regression."""

    used: Bools
    maps: MapSet
    design: Design
    regression: Regression
    responses: Floats

    def worst_outlier(self, options: FitOptions) -> tuple[int, str] | None:
        """The map that stands out most from the fit, with the reason; None when none does.

        A fit follows maps of high leverage more closely; residual / sqrt(1 - leverage) compensates for that. A map is
        an outlier when this exceeds the median by `outlier_sigmas` robust sigmas *and* what hysteresis can explain: an
        allowance for each moved actuator, added in quadrature. A small move carries the remanence of larger ones before
        it, so the largest move so far counts.
        """
        maps, regression, weight = self.maps, self.regression, self.maps.points.weight
        judged = regression.leverage < screening.LEVERAGE_MAX
        if judged.sum() < 3:
            return None
        residual = quality.seen_rms(regression.residual[:, maps.terms :], maps.sag, weight)
        own = np.sqrt(np.maximum(1.0 - regression.leverage, 1.0 - screening.LEVERAGE_MAX))
        scaled = np.where(judged, residual / own, 0.0)
        median = float(np.median(scaled[judged]))
        sigma = screening.MAD_TO_SIGMA * float(np.median(np.abs(scaled[judged] - median)))
        response = np.zeros(maps.actuators)
        response[self.design.excited] = rms(regression.coefficients[self.design.drift :, maps.terms :], weight)
        rest = maps.applied[maps.reference].mean(axis=0) if maps.reference.any() else 0.0
        move = np.sqrt(np.square(maps.applied - rest) @ np.square(response))
        allowance = options.hysteresis_allowance * np.maximum.accumulate(move)
        limit = np.maximum(max(median + options.outlier_sigmas * sigma, options.residual_floor), allowance)
        outside = scaled > limit
        if not outside.any():
            return None
        # The sum of squares falls by the square of `scaled` when a map is removed. A bad map of high leverage pushes
        # good ones beyond their (narrower) limits, but its own removal reduces the sum most.
        worst = int(np.argmax(np.where(outside, scaled, 0.0)))
        size, most = 1e9 * scaled[worst], 1e9 * limit[worst]
        return worst, f"outlier: {size:.1f} nm rms from the fit to all maps, limit {most:.1f} nm"


def _fit_good(maps: MapSet, reasons: list[str]) -> _Fitted:
    used = np.array([not reason for reason in reasons], dtype=bool)
    good = maps.select(used)
    design = make_design(good)
    return _Fitted(used, good, design, *regress(design, good))


def _result_of(
    maps: MapSet,
    options: FitOptions,
    rings: Ints | None,
    limits: Limits | None,
    reasons: list[str],
    fitted: _Fitted,
    remarks: list[str],
) -> InfluenceFit:
    """Compute the result and its quality figures."""
    used, good, design, regression, responses = fitted
    terms, weight = maps.terms, maps.points.weight
    coefficients = np.zeros((maps.actuators, responses.shape[1]))
    coefficients[design.excited] = regression.coefficients[design.drift :]
    figure = regression.coefficients[: design.drift]

    residual = regression.residual
    counted = np.hstack((np.ones((len(good), terms), dtype=bool), np.isfinite(good.sag)))
    freedom = np.maximum(counted.sum(axis=0) - design.matrix.shape[1], 1)
    variance = (np.square(residual) * counted).sum(axis=0) / freedom
    scatter = float(np.sqrt(variance[terms:] @ weight / (weight @ counted[:, terms:].any(axis=0))))
    covariance = np.zeros((maps.actuators, maps.actuators))
    covariance[np.ix_(design.excited, design.excited)] = regression.covariance[design.drift :, design.drift :]
    standard_error = scatter * np.sqrt(np.diag(covariance))

    held = ~good.reference
    fold = quality.folds_of(good.step, held, options.folds)
    held_out, tested = quality.held_out_residual(design, responses, fold)
    judged = tested if tested.any() else held
    left = quality.seen_rms(held_out[:, terms:], good.sag, weight)[judged]
    in_sample = quality.seen_rms(residual[:, terms:], good.sag, weight)
    map_residual = np.full(len(maps), np.nan)
    map_residual[used] = in_sample
    error = float(np.percentile(np.abs(held_out[judged, PISTON_TILT:terms]).max(axis=1, initial=0.0), 95.0))
    if limits is not None and tested.any():
        moved = (good.applied - limits.middle) @ coefficients[:, terms:]
        share = quality.loop_share(held_out[:, terms:], moved, weight, tested, options.hysteresis_allowance)
        error, more = quality.with_loops(error, share, coefficients[:, :terms].T, limits)
        remarks += more
    tilt = coefficients[:, 1:PISTON_TILT]
    tilt_error = np.sqrt(np.diag(covariance)[:, None] * variance[1:PISTON_TILT])
    tilt_known = bool(np.all(np.linalg.norm(tilt, axis=0) > 3.0 * np.linalg.norm(tilt_error, axis=0)))

    response = rms(coefficients[:, terms:], weight)
    # A point that scatters more than others, or has data in fewer maps, counts for less.
    sag_variance = variance_at_points(design, counted[:, terms:])[design.drift :]
    sag_variance *= np.maximum(variance[terms:], max(scatter**2, np.finfo(float).tiny))
    peak = np.zeros(maps.actuators)
    peak[design.excited] = (np.abs(coefficients[design.excited, terms:]) / np.sqrt(sag_variance)).max(axis=1)
    grades = quality.grade(response, peak, standard_error, design.excited, rings, options)
    figure_sag = figure[:, terms:]
    # The figure of a resumed run is that of its last part: it may have changed while the run was interrupted.
    last = design.matrix[good.segment == good.segment[-1], : design.drift].any(axis=0)
    return InfluenceFit(
        method=options.method,
        influence_zernike=coefficients[:, :terms].T.copy(),
        zernike_offset=figure[last, :terms].mean(axis=0),
        influence_sag=coefficients[:, terms:].T.copy(),
        sag_offset=figure_sag[last].mean(axis=0),
        points=maps.points,
        signal_min=float(good.applied.min()),
        signal_max=float(good.applied.max()),
        used=used,
        reasons=tuple(reasons),
        map_residual=map_residual,
        in_sample_rms=float(np.sqrt(np.mean(np.square(in_sample)))),
        held_out_rms=float(np.sqrt(np.mean(np.square(left)))),
        held_out_max_zernike=error,
        condition_number=quality.condition_number(coefficients[:, :terms].T, tilt_known),
        response=response,
        standard_error=standard_error,
        signal_covariance=covariance,
        grades=grades,
        drift_rms=float(np.sqrt(np.mean(np.square(rms(figure_sag - figure_sag.mean(axis=0), weight))))),
        limitations=(
            *quality.limitations(good, design, grades, tilt_known, tested),
            *quality.blur(response, standard_error, design.excited, options.weak_sigmas),
            *remarks,
        ),
    )
