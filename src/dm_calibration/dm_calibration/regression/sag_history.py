"""Model of the sag after a command, from its signals and those before it, to predict its surface control error.

An influence function fitted to signals errs by hysteresis and creep. Here each actuator follows the effective signal of
a :class:`~dm_common.hysteresis.model.HysteresisModel` of Prandtl-Ishlinskii form with creep. A few play operators
suffice: a hundred maps of sample surfaces turn the actuators far less often than the excitation of a hysteresis plan.
Weights and creep rate are shared by all actuators; gains are in the influence function. Sag = figure + H e is bilinear,
so figure and H, then weights and creep rate are found by alternating least squares. The figure follows the reference
frames (:func:`~dm_calibration.influence.regression.drift_columns`).
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from dm_calibration.hysteresis.features import play_features
from dm_calibration.hysteresis.responses import Responses
from dm_calibration.hysteresis.run import BEFORE_FIRST_MAP_S, Run, without
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.regression import drift_columns
from dm_common import Bools, Floats
from dm_common.hysteresis.model import CREEP_RATE_MAX, CREEP_TIMES, HysteresisModel
from dm_common.optics.piston_tilt import fill_gaps

#: Half-widths of the play operators beside the signal itself, normalised.
PLAY_RADII = (0.05, 0.15, 0.3, 0.5, 0.75)
#: Rounds of alternating solutions; the weights have converged to 1e-3 after four.
ROUNDS = 6


@dataclass(frozen=True, eq=False)
class SagModel:
    """Sag of the maps of one run, as fitted to some of them.

    Attributes:
        hysteresis: law of all actuators; the weight of the signal itself is 1.
        influence: (N, P) m per unit effective signal.
        figure: (R, P) m, at rest, at the knots of the drift.
    """

    hysteresis: HysteresisModel
    influence: Floats
    figure: Floats


class RunHistory:
    """The maps of one calibration run as a sequence of commands, ready to fit models to some and predict the others."""

    def __init__(self, maps: MapSet, model: Floats) -> None:
        """Run through the commands once.

        Args:
            maps: of the run, in the order measured, which begins at rest, demagnetised (degauss).
            model: (M, P) m, sag used to fill points without data.
        """
        self._maps = maps
        self._sag = fill_gaps(maps.sag, model, maps.points)
        self._figure = drift_columns(maps.stamp_ns, maps.reference, maps.step, maps.segment)
        self._radius = np.array((0.0, *PLAY_RADII))
        time = np.maximum.accumulate(1e-9 * (maps.stamp_ns - maps.stamp_ns[0]))  # even if the clock was set back
        moved = np.clip(maps.moved_s(), np.concatenate(([-BEFORE_FIRST_MAP_S], time[:-1])), time)
        responses = Responses(self._sag, 0, np.asarray(np.isfinite(maps.sag).any(axis=1)))
        run = Run(maps.applied, time, responses, -BEFORE_FIRST_MAP_S, moved, maps.segment, maps.degaussed, maps.rest)
        self._plays = run.along(lambda signals: play_features(signals, self._radius, 1, maps.rest))
        self._crept = run.crept(self._plays)

    def fit(self, keep: Bools) -> SagModel:
        """The model that best explains the maps in `keep` (M,), which must have data."""
        area = np.sqrt(self._maps.points.weight)
        figure, sag = self._figure[keep], self._sag[keep] * area
        free = np.linalg.qr(figure)[0]  # sag that the figure explains is no evidence on the weights
        without_figure = without(sag, free)
        weights, rate = np.eye(len(self._radius))[0], 0.0
        for _ in range(ROUNDS):
            design = np.hstack((figure, self._effective(weights, rate)[keep]))
            solution = np.linalg.lstsq(design, sag, rcond=1e-9)[0]
            offset, influence = solution[: figure.shape[1]], solution[figure.shape[1] :]
            features = np.concatenate((self._plays[keep], (weights @ self._crept[keep])[:, np.newaxis]), axis=1)
            found = self._weights(features @ influence, free, without_figure)
            weights, rate = found[:-1], min(float(found[-1]), CREEP_RATE_MAX)
        model = HysteresisModel(self._radius, weights[:, np.newaxis], np.zeros(0), 0.0, rate, CREEP_TIMES)
        return SagModel(model, influence / area, offset / area)

    @staticmethod
    def _weights(columns: Floats, free: Floats, sag: Floats) -> Floats:
        """Weights (F,) >= 0 with columns (M, F, P) summing up to the sag (M, P); the first scaled to 1."""
        features = columns.shape[1]
        columns = np.moveaxis(without(columns, free), 1, 2).reshape(-1, features)
        q, r = np.linalg.qr(columns)
        weights = nnls(r, q.T @ sag.ravel())[0]
        return np.asarray(weights / weights[0]) if weights[0] > 0.0 else np.eye(features)[0]

    def _effective(self, weights: Floats, rate: float) -> Floats:
        """(M, N) effective signals of the run."""
        return np.asarray(weights @ self._plays + rate * (weights @ self._crept))

    def predict(self, keep: Bools) -> Floats:
        """(M, P) m: sag of every command of the run, by the model that best explains the maps in `keep` (M,)."""
        model = self.fit(keep)
        effective = self._effective(model.hysteresis.play_weight[:, 0], model.hysteresis.creep_rate)
        return np.asarray(self._figure @ model.figure + effective @ model.influence)
