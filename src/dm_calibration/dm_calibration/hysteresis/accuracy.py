"""How well a run will show the hysteresis model, from its commands alone, before anything moves.

A coefficient of a map is ``figure + sum_n H_n e_n`` with effective signals ``e_n = sum_f w_f x_fn`` of features x. To
first order the errors of the gains H and of the weights w that the run leaves are those of two linear regressions on
its commands, (X'X)^-1 sigma^2 each; what they do to the check moves of the run is what its held-out maps will show.
Features are those of the richest candidate, which costs most maps. What no number of maps takes away is a floor.
"""

import numpy as np
from numpy.typing import NDArray

from dm_calibration.hysteresis.candidate_fit import PREISACH_AND_DUHEM
from dm_calibration.hysteresis.features import crept, fading_features, play_features, relaxation
from dm_calibration.hysteresis.run import without
from dm_calibration.influence.regression import TooFewMapsError
from dm_common import Floats
from dm_common.hysteresis.duhem import FadingHysteresis
from dm_common.optics.zernike import PISTON_TILT

#: The richest candidate, the slope of a typical fading operator, a typical creep rate.
RICHEST, SLOPE, CREEP_RATE = PREISACH_AND_DUHEM, 1.5, 0.01
#: Standard deviation of a coefficient of one map where no calibration tells it, m.
TYPICAL_NOISE = 2e-10
#: Standard deviation of a coefficient that stays however long the run is, m: steps of the electronics, creep older than
#: the run, a law that is nearly right only. What held-out simulated maps show where (X'X)^-1 says much less, from
#: 300 maps on.
FLOOR = 3.5e-10
#: Draws for quantiles of the largest of many correlated errors.
DRAWS = 4000
#: Directions of the features weaker than this share of the strongest cannot be distinguished, and need not be.
RESOLVED = 1e-7


def expected_accuracy(
    signals: Floats, time: Floats, check: NDArray[np.bool_], noise: float, influence: Floats
) -> float:
    """The expected error of the check moves of a run that begins with a degauss just before its first map.

    Args:
        signals: (M, N) commands less those of mid range, one map each.
        time: (M,) s, when the maps will be taken.
        check: (M,) which moves test the law.
        noise: standard deviation of a coefficient of one map, m.
        influence: (K, N) m per unit signal, from any earlier calibration.

    Returns:
        95 % quantile of the largest coefficient error beyond tilt, m; compares with
        `HysteresisFit.held_out_max_zernike`.

    Raises:
        TooFewMapsError: no check moves, or fewer other maps than actuators and features.
    """
    if not check.any():
        raise TooFewMapsError("check: the run has no moves that test the law")
    start = float(time[0]) - 1.0
    settled = relaxation(time, start)
    gains = np.column_stack((np.ones(len(time)), settled, (time - start) / np.ptp(time), signals))
    if (~check).sum() <= gains.shape[1]:
        raise TooFewMapsError(f"{(~check).sum()} maps: must be more than {gains.shape[1]} to tell gains and figure")
    share = _leverage(gains[~check], gains[check]).mean()
    response = influence[PISTON_TILT:].T
    # Gains of every response are a regression of their own; the weights are shared by all.
    covariance = np.eye(response.shape[1]) * (share * noise**2 + FLOOR**2)
    features = _features(signals, time, start)
    free = np.linalg.qr(gains[~check, :3])[0]
    covariance += noise**2 * _shared_error(without(features[~check], free), features[check], response)
    return largest_of(covariance)


def largest_of(covariance: Floats) -> float:
    """95 % quantile of the largest of D errors with `covariance` (D, D), in their unit."""
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(len(covariance)), covariance, DRAWS, method="svd")
    return float(np.quantile(np.abs(draws).max(axis=1), 0.95))


def _features(signals: Floats, time: Floats, start: float) -> Floats:
    """(M, F, N), the creep of the signal among them; without the signal itself, whose weight is in the gains."""
    plays = play_features(signals, RICHEST.radius, RICHEST.powers)
    own_creep = crept(signals[:, None, :], time, start)
    fading = fading_features(signals, FadingHysteresis(np.array([SLOPE])))
    static = np.concatenate((plays[:, 1:], fading), axis=1)
    return np.concatenate((static + CREEP_RATE * crept(static, time, start), own_creep), axis=1)


def _leverage(seen: Floats, asked: Floats) -> Floats:
    """(Q,) variance of predictions at rows `asked` (Q, U), from rows `seen` (M, U) of unit variance."""
    _, strength, axes = np.linalg.svd(seen, full_matrices=False)
    resolved = strength > RESOLVED * strength[0]
    return np.asarray(np.square(asked @ axes[resolved].T / strength[resolved]).sum(axis=1))


def _shared_error(seen: Floats, asked: Floats, response: Floats) -> Floats:
    """(D, D) mean covariance of the responses of moves `asked` (Q, F, N) from weights shown by `seen` (M, F, N).

    Args:
        response: (N, D) of unit signals; every response with unit variance.
    """
    count = seen.shape[1]
    columns = (seen @ response).transpose(1, 0, 2).reshape(count, -1)
    size, axes = np.linalg.eigh(columns @ columns.T)
    resolved = size > RESOLVED**2 * size[-1]
    root = axes[:, resolved] / np.sqrt(size[resolved])
    moved = (asked @ response).transpose(0, 2, 1) @ root  # (Q, D, F)
    return np.asarray(np.einsum("qdf,qef->de", moved, moved, optimize=True) / len(asked))
