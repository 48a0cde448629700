"""Predict the surface control error of a surface: section 3.1 of [1] with its Tables 2 and 3.

The surface control error of a map is the map less its nominal surface G s, piston and tilt removed, and the response
its rms over the whole aperture. Fifty of the surfaces p01-p58 train the regression, eight test it.

What [1] leaves open, and the readings

*Candidates.* There are 37 signals and 21 coefficients. The error is a norm, sqrt(|figure + print-through s + what the
actuators remember|^2): almost no linear function of either, which is why the adjusted R^2 in [1] is 0.2. All of these
readings are kept (:class:`Reading`):

- LINEAR: [1] to the letter, the signals and the coefficients measured on the surface itself.
- COMMAND: the signals and one candidate more, `model`: the norm of the error that figure and influence function in sag
  predict. It needs no measurement and no history; it serves a controller that is about to move.
- MEASURED: signals, measured coefficients, and `model` with the part inside the 21 terms from those, c - G s, and the
  rest as COMMAND. It uses what [1] uses, but the surface must have been measured.
- HISTORY: as COMMAND, but `model` follows the commands before this one too
  (:mod:`~dm_calibration.regression.sag_history`), so it knows hysteresis and creep, and the figure drifts with
  the reference frames. Nothing measured on the surface itself enters, but the frames before and after it do. This is
  the one that works, and the default.

`model` is never taken from a fit that has seen the surface: the eight test surfaces are in none of these fits, and
every training surface is predicted from a fit without its own fold. (G is: it defines the nominal surface, so it is
part of the question, not of the answer.)

*Thresholds.* Of C candidates that mean nothing, the best passes 0.05 more often than not. LINEAR keeps the usual
thresholds, as [1] seems to. The others divide them by C (Bonferroni): with `model` in, a signal that enters by
chance makes a poke of its actuator unpredictable.

*AZWreg.* (a) Another G, from coefficients fitted with region weights; (b) the response a region-weighted norm; (c)
weighted least squares, each surface weighted by Eq. (8) with r the variance of its own ten regional errors; (d) all ten
regions of all surfaces as samples of one regression. Table 3 gives Err and RelErr, hence the true errors, and they are
the same for both models to within rounding: that excludes (b). n = 49 in Table 2 excludes (d). Taken is (a) with (c):
the influence function carries its method, :func:`surface_weights` gives the weights, and Eq. (8) does what the text
says, "make a larger value of variability have less impact". epsilon is the median of the r.

p values and R^2 are optimistic, because the variables were selected on the same data (see
:mod:`~dm_calibration.regression.stepwise`); held-out errors stand beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.weights import surface_control_error
from dm_calibration.regression.sag_history import RunHistory
from dm_calibration.regression.stepwise import (
    P_ENTER,
    P_REMOVE,
    SelectionOptions,
    StepwiseFit,
    leave_one_out,
    stepwise,
)
from dm_calibration.regression.surface_samples import (
    SURFACES,
    SurfaceErrors,
    surface_errors,
    surface_rows,
    surface_weights,
)
from dm_common.names import unknown_name
from dm_common.optics.piston_tilt import rms
from dm_common.optics.zernike import TERM_RMS, basis

Floats = NDArray[np.float64]

#: Test set of [1].
TEST_SET = ("p04", "p09", "p16", "p34", "p44", "p47", "p51", "p55")
#: Folds in which the training surfaces are left out of the fits that `model` comes from.
FOLDS = 10
#: Name of the candidate made from the influence function.
MODEL = "model"


class Reading(Enum):
    """Which candidates the regression has; see the module."""

    LINEAR = "linear"
    COMMAND = "command"
    MEASURED = "measured"
    HISTORY = "history"


@dataclass(frozen=True)
class Table2Row:
    """One model of Table 2; lengths in m.

    Attributes:
        adjusted_r2, f_statistic, p_value: in-sample; p and R^2 are optimistic after selection.
        n, k: samples and selected variables.
        in_sample_rms: of the residuals of the training surfaces.
        leave_one_out_rms: of the training surfaces, each predicted by a model selected and fitted without it.
        test_rms: of the prediction errors of the test set; NaN without one.
    """

    model: str
    reading: str
    adjusted_r2: float
    f_statistic: float
    p_value: float
    n: int
    k: int
    in_sample_rms: float
    leave_one_out_rms: float
    test_rms: float


@dataclass(frozen=True)
class Table3Row:
    """One test surface of Table 3; lengths in m.

    Attributes:
        error: predicted less actual (Err).
        relative_error: |error| / actual (RelErr).
        lower, upper: 95 % prediction interval.
    """

    surface: str
    actual: float
    predicted: float
    error: float
    relative_error: float
    lower: float
    upper: float


@dataclass(frozen=True, eq=False)
class ErrorRegression:
    """A regression of the surface control error, with its tables.

    Attributes:
        names: (C,) candidates, in the order in which `fit` takes them.
        fit: the selected model, in m.
        table2: its row.
        table3: the test surfaces.
    """

    reading: Reading
    names: tuple[str, ...]
    fit: StepwiseFit
    table2: Table2Row
    table3: tuple[Table3Row, ...]


def regress_surface_errors(
    maps: MapSet,
    fit: InfluenceFit,
    reading: Reading = Reading.HISTORY,
    options: SelectionOptions | None = None,
    test_set: Sequence[str] = TEST_SET,
) -> ErrorRegression:
    """Select and fit a regression of the surface control error on the surfaces p01-p58 outside `test_set`.

    Args:
        maps: the raw data of a calibration.
        fit: its influence function; the method AZWreg makes the regression a weighted one.
        options: thresholds; None = those of the module's docstring.
        test_set: surfaces to predict and never to train on; those not measured are passed over. Empty: all train.

    Raises:
        UnknownNameError: a name that is not one of p01-p58.
        CollinearError, TooFewSamplesError: see :mod:`~dm_calibration.regression.stepwise`.
        ValueError: constant errors, or a surface without data in some region.
    """
    for name in test_set:
        if name not in SURFACES:
            raise unknown_name("test surface", name, SURFACES)
    errors = surface_errors(maps, fit)
    test = np.array([label in test_set for label in errors.labels])
    names, candidates = _candidates(maps, fit, errors, test, reading)
    weights = surface_weights(errors) if fit.method == "AZWreg" else None
    if options is None:
        share = 1 if reading is Reading.LINEAR else len(names)
        options = SelectionOptions(P_ENTER / share, P_REMOVE / share)
    return _judge(errors, test, names, candidates, weights, reading, fit.method, options)


def _candidates(
    maps: MapSet, fit: InfluenceFit, errors: SurfaceErrors, test: NDArray[np.bool_], reading: Reading
) -> tuple[tuple[str, ...], Floats]:
    signals = [f"s{k + 1:02d}" for k in range(errors.signals.shape[1])]
    coefficients = [f"c{k + 1:02d}" for k in range(errors.coefficients.shape[1])]
    if reading is Reading.LINEAR:
        return (*signals, *coefficients), np.hstack((errors.signals, errors.coefficients))
    predicted = _cross_fitted(maps, fit, test, hysteresis=reading is Reading.HISTORY)
    if reading is not Reading.MEASURED:
        model = rms(predicted, maps.points.weight)
        return (MODEL, *signals), np.column_stack((model, errors.signals))
    inside = (errors.coefficients - errors.signals @ fit.influence_zernike.T)[:, 3:] * TERM_RMS[3:]
    # Terms and points are orthogonal in the weighted sum, but for the discreteness of the points.
    orthogonal = np.linalg.qr(np.sqrt(maps.points.weight)[:, np.newaxis] * basis(maps.points.x, maps.points.y))[0]
    beyond = np.sqrt(maps.points.weight) * predicted
    beyond = beyond - (beyond @ orthogonal) @ orthogonal.T
    model = np.hypot(np.linalg.norm(inside, axis=1), np.linalg.norm(beyond, axis=1))
    return (MODEL, *signals, *coefficients), np.column_stack((model, errors.signals, errors.coefficients))


def _cross_fitted(maps: MapSet, fit: InfluenceFit, test: NDArray[np.bool_], hysteresis: bool) -> Floats:
    """(M, P) error surfaces of the sample surfaces, each from a fit that has not seen it, m."""
    rows = surface_rows(maps, fit)
    history = RunHistory(maps, fit.sag_offset + maps.applied @ fit.influence_sag.T, hysteresis)
    fold = np.full(len(rows), FOLDS)
    fold[~test] = np.arange((~test).sum()) % FOLDS
    seen = fit.used & ~np.isin(maps.step, maps.step[rows[test]])  # repeated maps of a state leave together
    sag = np.empty((len(rows), len(maps.points)))
    for k in np.unique(fold):
        own = fold == k
        law = history.fit(seen & ~np.isin(maps.step, maps.step[rows[own]]))
        sag[own] = history.predict(law)[rows[own]]
    return surface_control_error(sag, maps.applied[rows], fit.influence_zernike, maps.points)


def _judge(
    errors: SurfaceErrors,
    test: NDArray[np.bool_],
    names: tuple[str, ...],
    candidates: Floats,
    weights: Floats | None,
    reading: Reading,
    method: str,
    options: SelectionOptions,
) -> ErrorRegression:
    """Select, fit, and put the tables together."""
    x, y = candidates[~test], errors.response[~test]
    w = None if weights is None else weights[~test]
    fitted = stepwise(x, y, names, w, options)
    residual = y - fitted.predict(x)[0]
    left_out = y - leave_one_out(x, y, names, w, options)
    actual = errors.response[test]
    mean, lower, upper = fitted.predict(candidates[test])
    labels = [label for label, tested in zip(errors.labels, test, strict=True) if tested]
    table3 = tuple(
        Table3Row(label, float(a), float(m), float(m - a), float(abs(m - a) / a), float(low), float(high))
        for label, a, m, low, high in zip(labels, actual, mean, lower, upper, strict=True)
    )
    table2 = Table2Row(
        model=method,
        reading=reading.value,
        adjusted_r2=fitted.adjusted_r2,
        f_statistic=fitted.f_statistic,
        p_value=fitted.p_value,
        n=fitted.n,
        k=fitted.k,
        in_sample_rms=float(np.sqrt(np.mean(residual**2))),
        leave_one_out_rms=float(np.sqrt(np.mean(left_out**2))),
        test_rms=float(np.sqrt(np.mean((mean - actual) ** 2))) if len(actual) else float("nan"),
    )
    return ErrorRegression(reading, names, fitted, table2, table3)
