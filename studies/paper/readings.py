"""The readings of the regression in section 3.1 of [1], which leaves some choices open, with their Tables 2 and 3.

Fifty of the surfaces p01-p58 train the regression, eight test it. There are 37 signals and 21 coefficients. All of
these readings are kept (:class:`Reading`):

- LINEAR: [1] to the letter, the signals and the coefficients measured on the surface itself.
- COMMAND: the signals and one more candidate, `model`: the norm of the error that figure and influence function in sag
  predict. It needs no measurement and no history, so a controller can use it before a move.
- MEASURED: signals, measured coefficients, and `model`, whose part inside the 21 terms comes from these, c - G s, and
  whose rest is as in COMMAND. It uses what [1] uses, but the surface must have been measured.
- HISTORY: as COMMAND, but `model` also follows the earlier commands. This reading works, and the suite uses it: see
  :mod:`dm_calibration.regression.surface_error`, also for what is common to all of them.

No fit behind `model` contains any of the eight test surfaces. LINEAR keeps the usual thresholds, as [1] apparently
does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.weights import surface_control_error
from dm_calibration.regression.sag_history import RunHistory
from dm_calibration.regression.stepwise import SelectionOptions, StepwiseFit
from dm_calibration.regression.surface_error import (
    MODEL,
    SURFACES,
    Prediction,
    SurfaceErrors,
    held_out_errors,
    regress,
    surface_errors,
)
from dm_common import Floats
from dm_common.errors import unknown_name
from dm_common.optics.piston_tilt import fill_gaps, rms
from dm_common.optics.zernike import TERM_RMS, basis
from studies.paper.reported import TEST_SURFACES


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
class ReadRegression:
    """A regression of the surface control error in one reading, with its tables.

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


class LinearHistory:
    """A run without hysteresis: the influence function in sag with a constant figure."""

    def __init__(self, maps: MapSet, model: Floats) -> None:
        """`model`: (M, P) m, sag that replaces points without data."""
        self._sag = fill_gaps(maps.sag, model, maps.points)
        self._design = np.column_stack((np.ones(len(maps)), maps.applied))

    def predict(self, keep: NDArray[np.bool_]) -> Floats:
        """(M, P) m: sag of every command of the run, by the model that best explains the maps in `keep` (M,)."""
        return np.asarray(self._design @ np.linalg.lstsq(self._design[keep], self._sag[keep], rcond=1e-9)[0])


def regress_surface_errors(
    maps: MapSet,
    fit: InfluenceFit,
    reading: Reading = Reading.HISTORY,
    options: SelectionOptions | None = None,
    test_set: Sequence[str] = TEST_SURFACES,
) -> ReadRegression:
    """Select and fit a regression of the surface control error on the surfaces p01-p58 outside `test_set`.

    Args:
        maps: the raw data of a calibration.
        fit: its influence function; the method AZWreg makes the regression a weighted one.
        options: thresholds; None = those of the module's docstring.
        test_set: surfaces to predict and never to train on; those not measured are ignored. Empty: all train.

    Raises:
        UnknownNameError: a name that is not one of p01-p58.
        TooFewMapsError: see :mod:`~dm_calibration.regression.stepwise`.
        ValueError: constant errors, or a surface without data in some region.
    """
    for name in test_set:
        if name not in SURFACES:
            raise unknown_name("test surface", name, SURFACES)
    errors = surface_errors(maps, fit)
    test = np.array([label in test_set for label in errors.labels])
    names, candidates = _candidates(maps, fit, errors, test, reading)
    if options is None and reading is Reading.LINEAR:
        options = SelectionOptions()
    fitted, held_out_rms = regress(_some(errors, ~test), names, candidates[~test], fit.method, options)
    residual = errors.response[~test] - fitted.predict(candidates[~test])[0]
    actual = errors.response[test]
    mean, lower, upper = fitted.predict(candidates[test]) if len(actual) else (actual, actual, actual)
    labels = [label for label, tested in zip(errors.labels, test, strict=True) if tested]
    table3 = tuple(
        Table3Row(label, float(a), float(m), float(m - a), float(abs(m - a) / a), float(low), float(high))
        for label, a, m, low, high in zip(labels, actual, mean, lower, upper, strict=True)
    )
    table2 = Table2Row(
        model=fit.method,
        reading=reading.value,
        adjusted_r2=fitted.adjusted_r2,
        f_statistic=fitted.f_statistic,
        p_value=fitted.p_value,
        n=int(fitted.result.nobs),
        k=len(fitted.variables),
        in_sample_rms=float(np.sqrt(np.mean(residual**2))),
        leave_one_out_rms=held_out_rms,
        test_rms=float(np.sqrt(np.mean((mean - actual) ** 2))) if len(actual) else float("nan"),
    )
    return ReadRegression(reading, names, fitted, table2, table3)


def _some(errors: SurfaceErrors, keep: NDArray[np.bool_]) -> SurfaceErrors:
    labels = tuple(np.array(errors.labels)[keep])
    return SurfaceErrors(errors.rows[keep], labels, errors.signals[keep], errors.regional[keep])


def _held_out_errors(
    maps: MapSet, fit: InfluenceFit, errors: SurfaceErrors, predict: Prediction, test: NDArray[np.bool_]
) -> Floats:
    """(S, P) m, as :func:`held_out_errors`; no fit sees the surfaces in `test` (S,)."""
    tested = errors.rows[test]
    seen = fit.used & ~np.isin(maps.step, maps.step[tested])
    found = np.empty((len(test), len(maps.points)))
    found[~test] = held_out_errors(maps, replace(fit, used=seen), _some(errors, ~test), predict)
    if test.any():
        sag = predict(seen)[tested]
        found[test] = surface_control_error(sag, errors.signals[test], fit.influence_zernike, maps.points)
    return found


def _candidates(
    maps: MapSet, fit: InfluenceFit, errors: SurfaceErrors, test: NDArray[np.bool_], reading: Reading
) -> tuple[tuple[str, ...], Floats]:
    signals = [f"s{k + 1:02d}" for k in range(maps.actuators)]
    coefficients = [f"c{k + 1:02d}" for k in range(maps.terms)]
    measured = maps.coefficients[errors.rows]
    if reading is Reading.LINEAR:
        return (*signals, *coefficients), np.hstack((errors.signals, measured))
    filling = fit.sag_offset + maps.applied @ fit.influence_sag.T
    kind: type[RunHistory | LinearHistory] = RunHistory if reading is Reading.HISTORY else LinearHistory
    predict = kind(maps, filling).predict
    held_out = _held_out_errors(maps, fit, errors, predict, test)
    if reading is not Reading.MEASURED:
        return (MODEL, *signals), np.column_stack((rms(held_out, maps.points.weight), errors.signals))
    inside = (measured - errors.signals @ fit.influence_zernike.T)[:, 3:] * TERM_RMS[3:]
    # The terms are orthogonal in the weighted sum over the points, except for the discreteness of the points.
    root = np.sqrt(maps.points.weight)
    orthogonal = np.linalg.qr(root[:, np.newaxis] * basis(maps.points.x, maps.points.y))[0]
    beyond = root * held_out
    beyond = beyond - (beyond @ orthogonal) @ orthogonal.T
    model = np.hypot(np.linalg.norm(inside, axis=1), np.linalg.norm(beyond, axis=1))
    return (MODEL, *signals, *coefficients), np.column_stack((model, errors.signals, measured))
