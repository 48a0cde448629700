"""How well a run determines the creep spectrum.

Creep much faster than a map, or much slower than the run, is known from the smoothness of the spectrum alone; creep in
between, from the maps. To first order the errors of the weights are those of a Bayesian linear regression on positions
and states of the creep elements, with figure and gains as fitted. Effects outside the law, such as loops that widen
with speed, are common to all actuators, so the errors of the responses are not independent: the maps count for less, by
the ratio in which their residual exceeds independent errors along the features. Laws of each actuator follow the maps
of a short run more closely than they predict others, so the maps count for less, too, by the ratio in which the
residual of maps held out exceeds that of the fit.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from dm_calibration.hysteresis.features import spectrum_prior
from dm_calibration.hysteresis.run import Run, basis_of, without
from dm_common import Floats
from dm_common.hysteresis.model import HysteresisModel
from dm_common.optics.zernike import PISTON_TILT

#: Prior of the element weights that all actuators share: standard deviation relative to the mean weight, and
#: correlation length in elements. Creep may begin or end anywhere, so a weight of 0 must remain plausible.
SHARED, SHARED_CORRELATION = 0.9, 2.0
#: The same for the deviations of one actuator, which are in its rate rather than in the shape of its spectrum.
OWN, OWN_CORRELATION = 0.12, 6.0
#: Relative prior standard deviations of the weight of a position: common to all actuators, and of each actuator.
POSITION, OWN_POSITION = 0.03, 0.009
#: An actuator whose gains are less than this share of the largest is dead.
DEAD = 0.01


def creep_covariance(run: Run, law: HysteresisModel, held_out: Floats | None = None) -> Floats:
    """(2, 1 + J, 1 + J) covariances of the weights of position and creep elements after the fit to `run`.

    The first is of errors that all actuators share, the second of those of each by itself (mean over the actuators).

    Args:
        held_out: (M, D) m, residual of maps that had no part in a fit, NaN for the others; None = every map was fitted.
    """
    keep = run.responses.usable
    position, effective = run.follow(replace(law, creep_rate=0.0)), run.follow(law)
    features = np.concatenate((position[:, None], run.creep_states(position)), axis=1)
    gains, left = run.gains(effective, keep)
    left = left[keep]
    unknowns = run.figure.shape[1] + len(gains)
    scatter = run.responses.scatter(np.sqrt(np.square(left).sum(axis=0) / max(len(left) - unknowns, 1)))
    gains = gains / scatter
    seen = without(features[keep], basis_of(run.figure[keep]))

    together = seen @ gains
    evidence = np.einsum("mjd,mkd->jk", together, together)
    errors = np.einsum("mjd,md->mj", together, left / scatter)
    excess = max(1.0, float(np.mean(np.square(errors).sum(axis=0) / np.diag(evidence))))
    beyond = 1.0
    if held_out is not None and len(unseen := held_out[np.isfinite(held_out).all(axis=1)]):
        beyond = max(beyond, float(np.median(np.square(unseen / scatter).mean(axis=1))))  # of a typical map
    prior = _prior(law, SHARED, SHARED_CORRELATION, POSITION)
    shared = _posterior(evidence / (excess * beyond), prior)
    # Evidence on one actuator while all others are free; a dead one has none. Left out are the three signal patterns
    # that make piston and tilt, which no response contains. A dead actuator is such a hidden pattern by itself; without
    # it the others cannot form one of the three. A mirror of three actuators or fewer has no such patterns.
    moves = np.linalg.norm(gains, axis=1)
    alive = moves > DEAD * moves.max()
    hidden = max(PISTON_TILT if len(gains) > PISTON_TILT else 0, int((~alive).sum()))
    size, axes = np.linalg.eigh(gains @ gains.T)
    weight = np.zeros(len(gains))
    weight[alive] = 1.0 / (np.square(axes[alive, hidden:]) / size[hidden:]).sum(axis=1)
    prior = _prior(law, OWN, OWN_CORRELATION, OWN_POSITION)
    each = np.einsum("mjn,mkn,n->njk", seen, seen, weight, optimize=True)
    return np.stack((shared, _posterior(each / beyond, prior).mean(axis=0)))


def _posterior(evidence: Floats, prior: Floats) -> Floats:
    """(..., F, F) posterior covariance of weights, from the covariance `prior` (F, F) and `evidence` (..., F, F).

    Computed in units of the prior, where rounding cannot make it negative.
    """
    root = np.linalg.cholesky(prior)
    size, axes = np.linalg.eigh(root.T @ evidence @ root)
    left = root @ axes / np.sqrt(1.0 + np.maximum(size, 0.0))[..., None, :]
    return np.asarray(left @ np.swapaxes(left, -1, -2))


def _prior(law: HysteresisModel, spectrum: float, correlation: float, position: float) -> Floats:
    """(1 + J, 1 + J) covariance of the weights of position and creep elements, relative to those of `law`."""
    return np.asarray(block_diag(position**2, spectrum_prior(law.creep_rate, spectrum, correlation)))
