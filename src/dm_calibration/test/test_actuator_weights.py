"""Weights of features of each actuator, and how far the maps say that actuators differ."""

from __future__ import annotations

import numpy as np
import pytest

from dm_calibration.hysteresis.actuator_weights import SPREAD_ACTUATORS, SPREADS, likeliest_spread, weights_of

ACTUATORS = 4


def test_weights_are_those_of_the_normal_equations() -> None:
    rng = np.random.default_rng(3)
    features, left, gains = (rng.standard_normal(shape) for shape in ((40, 3, ACTUATORS), (40, 6), (ACTUATORS, 6)))
    own, common = 100.0, 100.0 / (ACTUATORS + 0.01)
    between = own * np.eye(ACTUATORS) - common
    columns = np.einsum("mfn,nd->mdnf", features, gains).reshape(40 * 6, -1)
    normal = columns.T @ columns + np.kron(between, np.eye(3))
    expected = np.linalg.solve(normal, columns.T @ left.ravel()).reshape(ACTUATORS, 3).T
    for begin in (np.zeros_like(expected), expected + 1.0):
        found = weights_of(features, left, gains, (own, common), begin)
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("spread", SPREADS)
@pytest.mark.parametrize("actuators", [12, SPREAD_ACTUATORS + 12])
def test_how_far_actuators_differ_is_told(spread: float, actuators: int) -> None:
    rng = np.random.default_rng(4)
    features, gains = rng.standard_normal((400, 20, actuators)), rng.standard_normal((actuators, 6))
    weights = rng.standard_normal((20, 1)) + spread * rng.standard_normal((20, actuators))
    left = np.einsum("mfn,fn,nd->md", features, weights, gains) + rng.standard_normal((400, 6))
    assert likeliest_spread(features, left, gains, weights) == spread
