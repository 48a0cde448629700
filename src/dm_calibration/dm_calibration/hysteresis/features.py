"""The effective signal as a sum of features of the commands, linear in the weights that are to be identified."""

import numpy as np
from numpy.polynomial import legendre

from dm_common import Floats
from dm_common.hysteresis.duhem import DuhemOperator, FadingHysteresis
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel, HysteresisState

#: Weight of one element of an even creep spectrum per unit of creep rate, and of all elements.
PER_ELEMENT = float(np.log10(CREEP_TIMES[-1] / CREEP_TIMES[0])) / (len(CREEP_TIMES) - 1)
EVEN = np.full(len(CREEP_TIMES), PER_ELEMENT)
#: Least creep rate that a prior assumes, as a share of a step per decade of time.
RATE_MIN = 1e-3

#: Number of patterns of the prior that are kept.
PATTERNS = 60
#: Prior of the weights: overall standard deviation, and the power with which the variance falls with the order.
#: Doubling or halving any of these two and the next two values changes held-out errors by less than a tenth.
AMPLITUDE, ORDER_POWER = 0.2, 3.0
#: Correlation length of the weights over the half-width, and decay length of their variance.
CORRELATION, DECAY = 0.5, 0.35
#: Variance of the loading curve, relative to that of all play operators together.
LOADING = 0.3
#: An actuator's own Duhem operator: fewest coefficients, number of their first-order updates, and weight of the
#: operator below which the maps do not determine them.
DUHEM_ORDERS, DUHEM_ROUNDS, DUHEM_WEIGHT_MIN = 6, 2, 0.01
#: Step of a coefficient for numerical derivatives, and largest change of a coefficient in one update.
SLOPE_STEP, CHANGE_MAX = 0.02, 1.0
#: Number of rows for which creep is computed at a time.
BLOCK = 32


def play_values(signals: Floats, radius: Floats, rest: float = 0.0) -> Floats:
    """(M, R, N) play operators of half-widths `radius` (R,) along `signals` (M, N) after a degauss at `rest`."""
    half_width = radius[:, None]
    play = np.full((len(radius), signals.shape[1]), rest)
    values = np.empty((len(signals), *play.shape))
    for row, shape in enumerate(signals):
        play = np.clip(play, shape - half_width, shape + half_width)
        values[row] = play
    return values


def play_features(signals: Floats, radius: Floats, powers: int, rest: float = 0.0) -> Floats:
    """(M, R D, N) powers 1 .. D of :func:`play_values`, less those at rest; all powers of a half-width are adjacent."""
    values = play_values(signals, radius, rest)
    stacked = np.stack([values**power - rest**power for power in range(1, powers + 1)], axis=2)
    return stacked.reshape(len(signals), len(radius) * powers, signals.shape[1])


def play_weights(series: Floats) -> Floats:
    """(N, R, D) weights of powers 1 .. D, from those of Legendre polynomials (N, R, D); constants are left out."""
    orders = series.shape[-1]
    powers = [np.pad(legendre.leg2poly([0.0] * order + [1.0]), (0, orders - order)) for order in range(1, orders + 1)]
    return np.asarray(series @ np.array(powers)[:, 1:])


def pattern_basis(radius: Floats, orders: int) -> Floats:
    """(R D, K) strongest patterns of the prior over half-widths and orders, scaled to weights of unit variance."""
    away = np.abs(np.subtract.outer(radius, radius))
    smooth = np.exp(-away / CORRELATION - np.add.outer(radius, radius) / (2.0 * DECAY)) / max(len(radius) - 1, 1)
    smooth[0, :] = smooth[:, 0] = 0.0  # the loading curve is independent of the loops
    smooth[0, 0] = LOADING
    order = np.arange(1, orders + 1, dtype=np.float64) ** -ORDER_POWER
    size, axes = np.linalg.eigh(AMPLITUDE**2 * np.kron(smooth, np.diag(order)))
    strongest = np.argsort(size)[::-1][:PATTERNS]
    return np.asarray(axes[:, strongest] * np.sqrt(size[strongest]))


def fading_features(signals: Floats, operators: FadingHysteresis, rest: float = 0.0) -> Floats:
    """(M, Z, N) values of Duhem operators along `signals` (M, N), which begin demagnetised at `rest`."""
    last = np.full(signals.shape[1], rest)
    states = np.zeros((len(last), operators.size))
    values = np.empty((len(signals), operators.size, len(last)))
    for row, shape in enumerate(signals):
        states = operators.move(states, last, shape)
        values[row], last = states.T, shape
    return values


def padded_slope(slope: Floats, actuators: int) -> Floats:
    """(N, 2, A) coefficients of each actuator's Duhem operator: `slope`, padded with 0 to at least DUHEM_ORDERS."""
    padded = np.pad(slope, (0, max(DUHEM_ORDERS - len(slope), 0)))
    return np.tile(padded, (actuators, 2, 1))


def fading_changes(signals: Floats, slope: Floats, rest: float = 0.0) -> Floats:
    """(M, 2 A, N) derivatives of :func:`fading_features` by the coefficients `slope` (N, 2, A) of its operator.

    A derivative is 0 where the changed coefficients give no valid operator.
    """
    still = fading_features(signals, FadingHysteresis(slope), rest)
    changes = []
    for index in np.ndindex(*slope.shape[1:]):
        changed = slope.copy()
        changed[:, *index] += SLOPE_STEP
        try:
            changes.append((fading_features(signals, FadingHysteresis(changed), rest) - still) / SLOPE_STEP)
        except ValueError:
            changes.append(np.zeros_like(still))
    return np.concatenate(changes, axis=1)


def own_slopes(slope: Floats, weight: Floats, changes: Floats) -> Floats:
    """(N, 2, A) coefficients of each actuator's Duhem operator after one first-order update.

    Args:
        slope: (N, 2, A) to begin with.
        weight, changes: (N,) and (2 A, N) fitted weights of the operator and of :func:`fading_changes`.
    """
    known = np.abs(weight) > DUHEM_WEIGHT_MIN
    change = np.where(known, changes / np.where(known, weight, 1.0), 0.0).T.reshape(slope.shape)
    change = np.clip(change, -CHANGE_MAX, CHANGE_MAX)
    for share in (1.0, 0.5, 0.25):
        try:
            DuhemOperator(slope + share * change)
        except ValueError:  # no valid operator
            continue
        return slope + share * change
    return slope


def creep_states(values: Floats, time: Floats, start: float, moved: Floats | None = None) -> Floats:
    """(M, J, ...) states of the creep elements, which follow `values` (M, ...), at each `time`; see :func:`crept`."""
    shape = (len(CREEP_TIMES), *(1,) * (values.ndim - 1))
    moved = _moved(time, start, moved)
    still = np.exp(-np.diff(np.column_stack((moved, time)).ravel(), prepend=start)[:, None] / CREEP_TIMES)
    lag, before = np.zeros((len(CREEP_TIMES), *values.shape[1:])), np.zeros(values.shape[1:])
    states = np.empty((len(values), *lag.shape))
    for state, now, until_move, since in zip(states, values, still[::2], still[1::2], strict=True):
        lag *= (until_move * since).reshape(shape)
        lag += since.reshape(shape) * (now - before)
        np.subtract(now, lag, out=state)
        before = now
    return states


def crept(features: Floats, time: Floats, start: float, moved: Floats | None = None, weight: Floats = EVEN) -> Floats:
    """Creep of features (M, ...) at each `time` (M,) s; all features were 0 before `start`.

    The state of an element is the feature less its lag: the sum over moves of size times exp(-age / time constant).

    Args:
        moved: (M,) s, when the mirror took each shape; None = right after the measurement before.
        weight: (J,) of the creep elements, or (J, N) for each actuator, the last axis of the features; by default those
            of an even spectrum, per unit of creep rate.
    """
    share = weight.reshape(len(CREEP_TIMES), -1).T
    values = features.reshape(len(features), -1, len(share))
    moves = np.ascontiguousarray(np.diff(values, axis=0, prepend=np.zeros_like(values[:1])).transpose(2, 0, 1))
    moved, last = _moved(time, start, moved), start
    lag, lags = np.zeros((len(share), len(CREEP_TIMES), moves.shape[2])), np.empty_like(moves)
    for first in range(0, len(time), BLOCK):
        rows = slice(first, first + BLOCK)
        age = np.maximum(time[rows, None] - moved[rows], 0.0)
        young = np.tril(np.exp(-age / CREEP_TIMES[:, None, None]))
        old = np.exp((last - time[rows, None]) / CREEP_TIMES)
        lags[:, rows] = (share[:, None] * old) @ lag + np.tensordot(share, young, 1) @ moves[:, rows]
        lag = old[-1, :, None] * lag + young[:, -1] @ moves[:, rows]
        last = time[rows][-1]
    return (share.sum(axis=1) * values - lags.transpose(1, 2, 0)).reshape(features.shape)


def _moved(time: Floats, start: float, moved: Floats | None) -> Floats:
    """(M,) s, when the mirror took the shape of each row; see :func:`crept`."""
    return np.concatenate(([start], time[:-1])) if moved is None else np.clip(moved, start, time)


def weight_of(rate: float) -> float:
    """Expected weight of each creep element, in the prior of a law with the creep rate `rate`."""
    return max(rate, RATE_MIN) * PER_ELEMENT


def smoothness(count: int, correlation: float) -> Floats:
    """(count, count) correlation of a smooth spectrum: falls to 1/e over `correlation` elements."""
    number = np.arange(count)
    return np.asarray(np.exp(-np.abs(np.subtract.outer(number, number)) / correlation))


def spectrum_prior(rate: float, spread: float, correlation: float) -> Floats:
    """(J, J) prior covariance of the weights of the creep elements of a law with the creep rate `rate`.

    Args:
        spread: standard deviation relative to the weight expected for `rate`.
        correlation: see :func:`smoothness`.
    """
    return (spread * weight_of(rate)) ** 2 * smoothness(len(CREEP_TIMES), correlation)


def relaxation(time: Floats, start: float) -> Floats:
    """(M,) creep left at `time` (s) of an old displacement that ended at `start`, for an even spectrum of unit rate."""
    return np.asarray(np.exp(-(time[:, None] - start) / CREEP_TIMES).sum(axis=1) * PER_ELEMENT)


def follow(
    law: HysteresisModel, state: HysteresisState, signals: Floats, time: Floats, moved: Floats | None = None
) -> tuple[Floats, HysteresisState]:
    """(M, N) effective signals of `signals` (M, N), observed at `time` (M,) s, and the state after the last.

    Args:
        moved: (M,) s, when each was applied; None = right after the observation before.

    Raises:
        ValueError: time stamps that run backwards.
    """
    if (np.diff(time) < 0.0).any():
        row = int(np.flatnonzero(np.diff(time) < 0.0)[0]) + 1
        raise ValueError(f"time stamps: row {row} is {time[row - 1] - time[row]:.3f} s before the row before it")
    result = np.empty_like(signals)
    starts = np.concatenate(([state.time], time[:-1])) if moved is None else moved
    for row, (shape, start, when) in enumerate(zip(signals, starts, time, strict=True)):
        state = law.advance(law.move(state, shape, float(start)), float(when))
        result[row] = law.effective(state)
    return result, state
