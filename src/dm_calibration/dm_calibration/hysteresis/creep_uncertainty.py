"""How well a run shows the creep spectrum.

Creep much younger than a map, or much older than the run, follows from the smoothness of the spectrum alone; what is
between, from the maps. To first order the errors of the weights are those of a Bayesian linear regression on the
positions and what the creep elements have followed of them, with figure and gains as fitted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dm_calibration.hysteresis.candidate_fit import Run
from dm_calibration.hysteresis.features import creep_states, follow, spectrum_prior
from dm_calibration.hysteresis.segments import basis_of, figure_columns, in_parts, without
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_common.optics.zernike import PISTON_TILT

Floats = NDArray[np.float64]

#: Prior standard deviation of the elements' weights relative to the mean rate, and their correlation over elements;
#: that of a position, relative; the spread of both between actuators, relative to that.
SPECTRUM, CORRELATION, POSITION, SPREAD = 0.6, 6.0, 0.03, 0.3
#: An actuator whose gains are less than this share of the largest is dead.
DEAD = 0.01


def creep_covariance(run: Run, law: HysteresisModel) -> Floats:
    """(2, 1 + J, 1 + J) covariances of the weights of position and creep elements that `run` leaves.

    The first is of errors that all actuators share, the second of those of each by itself.
    """
    values, keep = run.responses.values, run.responses.usable
    parts, starts = run.parts, run.starts
    still = replace(law, creep_rate=0.0)

    def features_of(part: slice, start: float) -> Floats:
        moved = run.moved_in(part)
        rested = still.demagnetised(run.signals.shape[1], start)
        position = follow(still, rested, run.signals[part], run.time[part], moved)[0]
        states = creep_states(position, run.time[part], start, moved)
        return np.concatenate((position[:, None], np.array(list(states))), axis=1)

    features = in_parts(parts, starts, features_of)
    creep = np.einsum(
        "mjn,nj->mn", features[:, 1:], np.broadcast_to(law.creep_share, (features.shape[2], len(CREEP_TIMES)))
    )
    figure = figure_columns(run.time, parts, starts)[keep]
    design = np.hstack((figure, (features[:, 0] + creep)[keep]))
    solution = np.linalg.lstsq(design, values[keep], rcond=1e-10)[0]
    left = values[keep] - design @ solution
    scatter = run.responses.scatter(np.sqrt(np.square(left).sum(axis=0) / max(len(left) - design.shape[1], 1)))
    gains = solution[figure.shape[1] :] / scatter
    seen = without(features[keep], basis_of(figure))

    prior = np.zeros((1 + len(CREEP_TIMES),) * 2)
    prior[0, 0], prior[1:, 1:] = POSITION**2, spectrum_prior(law.creep_rate, SPECTRUM, CORRELATION)
    together = seen @ gains
    shared = np.linalg.inv(np.einsum("mjd,mkd->jk", together, together) + np.linalg.inv(prior))
    # What one actuator shows beside all others, but for piston and tilt, which no response holds; a dead one nothing.
    # It takes the place of one of those three: it does not follow them, so the others show that pattern.
    moves = np.linalg.norm(gains, axis=1)
    alive = moves > DEAD * moves.max()
    hidden = max(PISTON_TILT, int((~alive).sum()))
    size, axes = np.linalg.eigh(gains @ gains.T)
    evidence = np.zeros(len(gains))
    evidence[alive] = 1.0 / (np.square(axes[alive, hidden:]) / size[hidden:]).sum(axis=1)
    each = np.einsum("mjn,mkn,n->njk", seen, seen, evidence, optimize=True) + np.linalg.inv(SPREAD**2 * prior)
    return np.stack((shared, np.linalg.inv(each).mean(axis=0)))
