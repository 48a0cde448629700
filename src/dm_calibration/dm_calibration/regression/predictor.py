"""The surface control error of a command before it is applied, with an interval.

The regression gives the error of a command from this command and those before it. The error depends on the history,
which a request does not contain, so it is predicted for many histories that the mirror may have in use: smooth shapes
(the spheres and Zernike surfaces of the calibration) of any size the range allows, in random order from a rested
mirror. The interval contains 95 % of the predictions, widened by the uncertainty of the regression.
"""

from dataclasses import dataclass

import numpy as np

from dm_calibration.hysteresis.features import follow
from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.surfaces import MODEL_NAMES
from dm_calibration.influence.weights import surface_control_error
from dm_calibration.regression.sag_history import RunHistory, SagModel
from dm_calibration.regression.stepwise import SelectionOptions, StepwiseFit
from dm_calibration.regression.surface_error import model_candidates, regress, surface_errors, told_apart
from dm_common import Floats, Ints
from dm_common.optics.piston_tilt import rms

#: Number of histories, commands in each, and time between commands, s.
HISTORIES = 200
COMMANDS = 8
DWELL = 1.0


@dataclass(frozen=True, eq=False)
class ErrorPredictor:
    """Predicts the error of commands with unknown history.

    Attributes:
        influence: the influence function that gives nominal surfaces.
        fit: the regression on all surfaces p01-p58.
        held_out_rms: held-out error for these, see :func:`~dm_calibration.regression.surface_error.regress`, m.
        sag: model of the sag from commands, fitted to all good maps.
        moved: indices of the actuators whose signals are candidates.
        histories: (1 + COMMANDS, HISTORIES, N) normalised signals; the first is rest, where creep has died away.
    """

    influence: InfluenceFit
    fit: StepwiseFit
    held_out_rms: float
    sag: SagModel
    moved: Ints
    histories: Floats

    def predict(self, signals: Floats) -> tuple[float, float, float]:
        """Mean and 95 % interval over histories of the rms surface control error of one command.

        Args:
            signals: (N,) normalised.

        Returns:
            mean, lower, upper: m, none below 0.
        """
        commands, count, actuators = self.histories.shape
        applied = np.concatenate((self.histories, np.broadcast_to(signals, (1, count, actuators))))
        # Histories side by side, as if each had a mirror of its own.
        model = self.sag.hysteresis
        rested = model.demagnetised(count * actuators, 0.0, float(self.histories[0, 0, 0]))
        effective, _ = follow(model, rested, applied.reshape(commands + 1, -1), DWELL * np.arange(commands + 1))
        moved = effective[-1] - model.effective(rested)
        sag = self.sag.figure[-1] + moved.reshape(count, actuators) @ self.sag.influence
        same = np.broadcast_to(signals, (count, actuators))
        influence, points = self.influence, self.influence.points
        size = rms(surface_control_error(sag, same, influence.influence_zernike, points), points.weight)
        mean, lower, upper = self.fit.predict(np.column_stack((size, same[:, self.moved])))
        return (
            max(float(mean.mean()), 0.0),
            max(float(np.percentile(lower, 2.5)), 0.0),
            max(float(np.percentile(upper, 97.5)), 0.0),
        )


def fit_predictor(maps: MapSet, influence: InfluenceFit, options: SelectionOptions | None = None) -> ErrorPredictor:
    """A predictor from all surfaces p01-p58 of a calibration, with its leave-one-out error.

    Raises as `surface_errors` and `regress` of :mod:`~dm_calibration.regression.surface_error`.
    """
    errors = surface_errors(maps, influence)
    history = RunHistory(maps, influence.sag_offset + maps.applied @ influence.influence_sag.T)
    names, candidates = model_candidates(maps, influence, errors, history.predict)
    fit, held_out_rms = regress(errors, names, candidates, influence.method, options)
    histories = _histories(maps, influence, np.random.default_rng(0))
    moved = told_apart(influence, errors)
    return ErrorPredictor(influence, fit, held_out_rms, history.fit(influence.used), moved, histories)


def _histories(maps: MapSet, influence: InfluenceFit, rng: np.random.Generator) -> Floats:
    """(1 + COMMANDS, HISTORIES, N) rest, then random smooth shapes inside the range of signals of the calibration."""
    low, high = influence.signal_min, influence.signal_max
    middle = 0.5 * (low + high)
    shapes = maps.applied[[name in MODEL_NAMES for name in maps.label]] - middle
    shapes = shapes[np.abs(shapes).max(axis=1, initial=0.0) > 0.0]
    if len(shapes):
        largest = shapes * (0.5 * (high - low) / np.abs(shapes).max(axis=1, keepdims=True))
        chosen = largest[rng.integers(0, len(largest), (COMMANDS, HISTORIES))]
        commands = middle + rng.uniform(-1.0, 1.0, (COMMANDS, HISTORIES, 1)) * chosen
    else:  # no smooth shape is known: every actuator on its own
        commands = rng.uniform(low, high, (COMMANDS, HISTORIES, maps.actuators))
    return np.concatenate((np.full_like(commands[:1], maps.rest), commands))
