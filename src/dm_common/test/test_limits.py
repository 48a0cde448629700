"""Limits of the signals: what they allow, and shapes scaled to keep them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_common.geometry import hexagonal_positions, neighbour_pairs
from dm_common.limits import SLACK, Limits

PAIRS = neighbour_pairs(*hexagonal_positions(37))


def test_rounding_is_allowed_and_more_is_not() -> None:
    limits = Limits(-1.0, 1.0, PAIRS, 0.5)
    assert limits.allow(np.full(37, 1.0 + 0.5 * SLACK))
    assert not limits.allow(np.full(37, 1.0 + 2.0 * SLACK))
    poke = np.zeros(37)
    poke[0] = 0.5 + 0.5 * SLACK
    assert limits.allow(poke)
    poke[0] = 0.5 + 2.0 * SLACK
    assert not limits.allow(poke)
    assert Limits(-1.0, 1.0, PAIRS, 2.0).allow(poke)
    assert Limits(-1.0, 1.0).allow(poke)


def test_actuators_at_a_limit_are_found() -> None:
    signals = np.zeros(37)
    signals[0], signals[36] = 0.5, -1.0
    at_limit = Limits(-1.0, 1.0, PAIRS, 0.5).at_limit(signals)
    assert set(np.flatnonzero(at_limit)) >= {0, 1, 2, 3, 4, 5, 6, 36}
    assert np.flatnonzero(Limits(-1.0, 1.0).at_limit(signals)).tolist() == [36]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=37, max_size=37), st.floats(0.05, 2.0))
def test_scaled_signals_keep_every_limit(values: list[float], limit: float) -> None:
    limits = Limits(-1.0, 1.0, PAIRS, limit)
    signals, factor = limits.scaled(np.array(values))
    assert signals.min() >= -1.0 and signals.max() <= 1.0
    assert limits.differences(signals).max() <= limit
    assert 0.0 <= factor <= 1.0


def test_scaling_keeps_the_shape_about_its_mean() -> None:
    shape = np.random.default_rng(3).uniform(-1.0, 1.0, 37)
    signals, factor = Limits(-1.0, 1.0, PAIRS, 0.4).scaled(shape)
    assert factor < 1.0
    np.testing.assert_allclose(signals - shape.mean(), factor * (shape - shape.mean()), atol=1e-11)
    unchanged, factor = Limits(-1.0, 1.0, PAIRS, 2.0).scaled(shape)
    assert factor == 1.0 and (unchanged == shape).all()


def test_impossible_limits_are_refused() -> None:
    with pytest.raises(ValueError, match="the lower limit must be below the upper"):
        Limits(1.0, -1.0)
    with pytest.raises(ValueError, match="neighbour_difference = 0: must be positive"):
        Limits(neighbour_difference=0.0)
