"""Predict the surface control error of a surface: section 3.1 of [1].

The surface control error of a map is the map less its nominal surface G s, piston and tilt removed; the response is its
rms over the whole aperture. The sample surfaces p01-p58 train the regression.

*Candidates.* [1] has 37 signals and 21 coefficients. The error is a norm, sqrt(|figure + print-through s + memory of
the actuators|^2), and hardly a linear function of either: hence the adjusted R^2 of 0.2 in [1]
(`studies.paper.readings` compares the readings of [1]). The candidates here are the signals and one more, `model`:
the norm of the error predicted from the commands so far (:mod:`~dm_calibration.regression.sag_history`). It contains
hysteresis and creep, and a figure that drifts with the reference frames. No measurement of the surface itself enters,
but the frames before and after it do.

`model` is never taken from a fit that has seen the surface: every surface is predicted from a fit without its own fold.
(G has seen it, but G only defines the nominal surface, and with that the error to be predicted.)

*Thresholds.* Of C candidates without any effect, the best passes 0.05 more often than not. The usual thresholds are
divided by C (Bonferroni): beside `model`, a signal that enters by chance makes a poke of its actuator unpredictable.

*AZWreg* could mean: (a) another G, from coefficients fitted with region weights; (b) a region-weighted norm as
response; (c) weighted least squares, each surface weighted by Eq. (8) with r the variance of its own ten regional
errors; (d) all ten regions of all surfaces as samples of one regression. Table 3 gives Err and RelErr, hence the true
errors, which are the same for both models to within rounding: that excludes (b). n = 49 in Table 2 excludes (d). Here
it is (a) with (c): the influence function states its method, :func:`surface_weights` gives the weights, and Eq. (8)
does as the text says, "make a larger value of variability have less impact". epsilon is the median of the r.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.quality import GRADE_NOT_EXCITED
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.influence.surfaces import TABLE_1, TABLE_CHANNELS
from dm_calibration.influence.weights import region_weights, surface_control_error
from dm_calibration.regression.stepwise import (
    P_ENTER,
    P_REMOVE,
    TOLERANCE,
    SelectionOptions,
    StepwiseFit,
    leave_one_out,
    stepwise,
)
from dm_common import Bools, Floats, Ints
from dm_common.optics.piston_tilt import rms
from dm_common.optics.sample_regions import regional_rms

#: p01 to p58; the Zernike surfaces are not part of the regression.
SURFACES = tuple(name for name in TABLE_1 if not name.startswith("pz"))
#: Number of folds in which surfaces are left out of the fits that give `model`.
FOLDS = 10
#: Name of the candidate made from the influence function.
MODEL = "model"

#: Returns the sag after all commands of a run, (M, P) m, by a fit to the given maps (M,).
Prediction = Callable[[Bools], Floats]


@dataclass(frozen=True, eq=False)
class SurfaceErrors:
    """The sample surfaces of a calibration with their errors.

    Attributes:
        rows: (S,) their indices among the maps.
        labels: (S,) of p01-p58.
        signals: (S, N) as applied.
        regional: (S, R) m, rms surface control error inside concentric regions, the whole aperture last.
    """

    rows: Ints
    labels: tuple[str, ...]
    signals: Floats
    regional: Floats

    @property
    def response(self) -> Floats:
        """(S,) m, rms surface control error over the whole aperture."""
        return np.asarray(self.regional[:, -1])


def surface_errors(maps: MapSet, fit: InfluenceFit) -> SurfaceErrors:
    """Errors of the surfaces p01-p58 among `maps` that entered `fit`, from their sag samples.

    Raises:
        EmptyRegionError: a surface has no sample in some region.
        TooFewMapsError: there is none of these surfaces.
        ValueError: other than 21 terms.
    """
    rows = np.array([k for k, label in enumerate(maps.label) if label in SURFACES and fit.used[k]], dtype=np.int64)
    if not rows.size:
        raise TooFewMapsError("none of the surfaces p01 to p58 is among the good maps: calibrate with the plan full")
    labels = tuple(maps.label[row] for row in rows)
    error = surface_control_error(maps.sag[rows], maps.applied[rows], fit.influence_zernike, maps.points)
    return SurfaceErrors(rows, labels, maps.applied[rows], regional_rms(error, maps.points, labels=labels))


def surface_weights(errors: SurfaceErrors) -> Floats:
    """(S,) weights of the surfaces for AZWreg: Eq. (8) with r the variance of a surface's regional errors, m^2.

    Scaled so that a surface of average variance has weight 1, the weight of a new surface, whose regional errors have
    not been measured.

    Raises:
        ValueError: the errors of all surfaces are the same in all regions, so that Eq. (8) gives no weights.
    """
    variance = errors.regional.var(axis=1, ddof=1)
    epsilon = float(np.median(variance))
    if epsilon <= 0.0:
        raise ValueError("the errors do not differ from region to region: Eq. (8) gives no weights; use AZreg")
    weights = region_weights(variance, epsilon)
    return weights * np.mean(1.0 / weights)


def regress(
    errors: SurfaceErrors,
    names: Sequence[str],
    candidates: Floats,
    method: str,
    options: SelectionOptions | None = None,
) -> tuple[StepwiseFit, float]:
    """Select and fit a regression of the surface control error on `candidates` (S, C).

    Args:
        names: (C,) of the candidates.
        method: of the influence function; AZWreg makes the regression a weighted one.
        options: thresholds; None = those of the module's docstring.

    Returns:
        The selected model, in m, and the rms error of the surfaces, each predicted by a model selected and fitted
        without it, m.

    Raises:
        TooFewMapsError: see :mod:`~dm_calibration.regression.stepwise`.
        ValueError: constant errors.
    """
    weights = surface_weights(errors) if method == "AZWreg" else None
    options = options or SelectionOptions(P_ENTER / len(names), P_REMOVE / len(names))
    fitted = stepwise(candidates, errors.response, names, weights, options)
    left_out = errors.response - leave_one_out(candidates, errors.response, weights, options)
    return fitted, float(np.sqrt(np.mean(left_out**2)))


def model_candidates(
    maps: MapSet, fit: InfluenceFit, errors: SurfaceErrors, predict: Prediction
) -> tuple[tuple[str, ...], Floats]:
    """`model` and the signals of the N actuators told apart: their names, and (S, 1 + N)."""
    model = rms(held_out_errors(maps, fit, errors, predict), maps.points.weight)
    moved = told_apart(fit, errors)
    return (MODEL, *(f"s{k + 1:02d}" for k in moved)), np.column_stack((model, errors.signals[:, moved]))


def told_apart(fit: InfluenceFit, errors: SurfaceErrors) -> Ints:
    """Indices of the actuators moved, without those beyond Table 1 that all surfaces move like an earlier one."""
    moved = np.flatnonzero(fit.grades != GRADE_NOT_EXCITED)
    centred = errors.signals[:, moved] - errors.signals[:, moved].mean(axis=0)
    size = np.linalg.norm(centred, axis=0)
    alike = np.abs(centred.T @ centred) > (1.0 - TOLERANCE) * np.outer(size, size)
    return moved[(moved < TABLE_CHANNELS) | ~np.triu(alike, 1).any(axis=0)]


def held_out_errors(maps: MapSet, fit: InfluenceFit, errors: SurfaceErrors, predict: Prediction) -> Floats:
    """(S, P) errors of the sample surfaces, m, each predicted by a fit that has not seen it."""
    fold = np.arange(len(errors.rows)) % FOLDS
    sag = np.empty((len(errors.rows), len(maps.points)))
    for k in np.unique(fold):
        own = errors.rows[fold == k]
        # Repeated maps of a state are left out together.
        sag[fold == k] = predict(fit.used & ~np.isin(maps.step, maps.step[own]))[own]
    return surface_control_error(sag, errors.signals, fit.influence_zernike, maps.points)
