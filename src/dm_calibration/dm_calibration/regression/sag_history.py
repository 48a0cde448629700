"""The sag of a command from the signals and those before it, to tell the surface control error before it is measured.

An influence function fitted to signals errs by what the actuators remember. Here each actuator follows an effective
signal, u = s + sum_k a_k p_k(s) + sum_j b_j q_j(s): p_k are play operators, which make up a Prandtl-Ishlinskii law
([16], section 2.4), q_j the signals low-pass filtered with different time constants, which make up creep. The weights
a_k, b_j >= 0 are shared by all actuators, so some hundred maps determine them well; gains are in the influence
function. Sag = figure + H u is bilinear, so figure and H, then the weights are least-squares solutions in turn. The
figure follows the reference frames (:mod:`~dm_calibration.influence.drift`).

Without memory (no play, no creep) it is the influence function in sag with a constant figure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from dm_calibration.hysteresis.segments import in_parts, parts_of
from dm_calibration.influence.drift import drift_columns
from dm_calibration.influence.gaps import usable_sag
from dm_calibration.influence.maps import MapSet
from dm_common.optics.sag import fill_gaps

Floats = NDArray[np.float64]

#: Half-widths of the play operators, in units of the half range of signals.
PLAY_RADII = (0.05, 0.15, 0.3, 0.5, 0.75)
#: Time constants of creep, s: the span of a calibration run; slower creep is drift of the figure.
CREEP_TIMES = (3.0, 30.0, 300.0)
#: Rounds of alternating solutions; the weights stand to 1e-3 after four.
ROUNDS = 6


@dataclass(frozen=True, eq=False)
class SagLaw:
    """Sag of the maps of one run, as fitted to some of them.

    Attributes:
        weights: (F,) of the features; the first, that of the signal itself, is 1.
        influence: (N, P) m per unit effective signal.
        figure: (R, P) m, at the knots of the drift.
    """

    weights: Floats
    influence: Floats
    figure: Floats


class RunHistory:
    """The maps of one calibration run as a sequence of commands, ready to fit laws to some and predict the others."""

    def __init__(self, maps: MapSet, model: Floats, hysteresis: bool = True) -> None:
        """Run through the commands once.

        Args:
            maps: of the run, in the order measured, which begins at rest with the memory wiped (degauss).
            model: (M, P) m, sag to fill points without data from.
            memory: whether to follow play, creep and drift.
        """
        self._maps = maps
        reasons = ["" if np.isfinite(row).any() else "no data" for row in maps.sag]
        self.usable = np.array([not reason for reason in reasons])
        self._sag = usable_sag(maps, reasons)
        self._sag[self.usable] = fill_gaps(maps.sag[self.usable], model[self.usable], maps.points)
        self._figure = drift_columns(maps.stamp_ns, maps.reference) if hysteresis else np.ones((len(maps), 1))
        time_s = np.float64(1e-9) * maps.stamp_ns
        self._features = (
            in_parts(parts_of(maps.segment), lambda part: effective_signals(maps.applied[part], time_s[part]))
            if hysteresis
            else maps.applied[:, np.newaxis]
        )

    def fit(self, keep: NDArray[np.bool_]) -> SagLaw:
        """The law that explains the maps in `keep` (M,) best."""
        keep = keep & self.usable
        area = np.sqrt(self._maps.points.weight)
        figure, features = self._figure[keep], self._features[keep]
        sag = self._sag[keep] * area
        free = np.linalg.qr(figure)[0]  # what the figure takes up is no evidence about the weights
        without_figure = sag - free @ (free.T @ sag)
        weights = np.zeros(features.shape[1])
        weights[0] = 1.0
        for _ in range(ROUNDS):
            design = np.hstack((figure, weights @ features))
            solution = np.linalg.lstsq(design, sag, rcond=1e-9)[0]
            offset, influence = solution[: figure.shape[1]], solution[figure.shape[1] :]
            if len(weights) == 1:
                break
            weights = self._weights(features @ influence, free, without_figure)
        return SagLaw(weights, influence / area, offset / area)

    @staticmethod
    def _weights(columns: Floats, free: Floats, sag: Floats) -> Floats:
        """Weights (F,) >= 0 with columns (M, F, P) summing up to the sag (M, P); the first scaled to 1."""
        count, features, points = columns.shape
        columns = columns.reshape(count, -1)
        columns = (columns - free @ (free.T @ columns)).reshape(count, features, points)
        columns = np.moveaxis(columns, 1, 2).reshape(-1, features)
        q, r = np.linalg.qr(columns)
        weights = nnls(r, q.T @ sag.ravel())[0]
        return np.asarray(weights / weights[0]) if weights[0] > 0.0 else np.eye(features)[0]

    def predict(self, law: SagLaw) -> Floats:
        """(M, P) m: sag of every command of the run."""
        return np.asarray(self._figure @ law.figure + (law.weights @ self._features) @ law.influence)


def effective_signals(applied: Floats, time_s: Floats) -> Floats:
    """Features of the history: the signals, play operators and creep.

    Args:
        applied: (M, N) normalised, in order; the memory is empty before the first.
        time_s: (M,) s.

    Returns:
        (M, 1 + plays + creeps, N).
    """
    radius = np.array(PLAY_RADII)[:, np.newaxis]
    tau = np.array(CREEP_TIMES)[:, np.newaxis]
    play = np.zeros((len(radius), applied.shape[1]))
    creep = np.repeat(applied[:1], len(tau), axis=0)
    result = np.empty((len(applied), 1 + len(radius) + len(tau), applied.shape[1]))
    elapsed = np.maximum(np.diff(time_s, prepend=time_s[:1]), 0.0)
    for row, signals in enumerate(applied):
        np.clip(play, signals - radius, signals + radius, out=play)
        # The map is taken at the end of the time spent at these signals.
        creep = signals + (creep - signals) * np.exp(-elapsed[row] / tau)
        result[row] = np.vstack((signals[np.newaxis], play, creep))
    return result
