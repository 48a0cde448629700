"""What a law is over the whole range of the signals: how steep at least, and how far it reaches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dm_common.hysteresis.duhem import DuhemOperator
from dm_common.hysteresis.model import HysteresisModel

Floats = NDArray[np.float64]


def slope_min(law: HysteresisModel, low: float = -1.0, high: float = 1.0) -> float:
    """Smallest slope of the effective signal over signals of `low` .. `high`, on any way.

    After a turn the operators set in one by one, narrow ones first; what has set in follows the signal at a
    distance of its half-width. Those of half-width r have set in only where the turn can lie 2 r behind.
    """
    order = np.argsort(law.play_radius)
    radius, weight = law.play_radius[order], law.play_weight[..., order, :]
    signal, way = np.linspace(low, high, 201)[:, None], np.array([1.0, -1.0])[:, None, None]
    behind = np.where(way > 0.0, signal - low, high - signal)
    value = signal - way * radius
    weight = weight[..., None, None, :, :]  # a row for each way and signal
    slope = np.zeros(np.broadcast_shapes(value.shape, weight.shape[:-1]))
    for power in range(weight.shape[-1], 0, -1):
        slope = slope * value + power * weight[..., power - 1]
    slope = np.where(2.0 * radius <= behind, slope, 0.0)
    smallest = np.cumsum(slope, axis=-1).min(axis=(-3, -2, -1))
    if law.duhem_slope.size:
        duhem = DuhemOperator(law.duhem_slope)
        least, most = duhem.slope_range
        smallest = smallest + np.minimum(law.duhem_weight * least, law.duhem_weight * most)
    return float(np.min(smallest))


def span(law: HysteresisModel) -> Floats:
    """Effective signal at +1 less that at -1 in a full cycle that closes, of each law: (1,) or (N,)."""
    count = law.actuators or 1
    state = law.demagnetised(count, 0.0)
    for turn in (1.0, -1.0, 1.0, -1.0):
        state = law.move(state, np.full(count, turn), 0.0)
    low = state.position
    return np.asarray(law.move(state, np.ones(count), 0.0).position - low)


def normalised(law: HysteresisModel) -> HysteresisModel:
    """The same law with effective signals that span 2."""
    return law.scaled(2.0 / span(law))
