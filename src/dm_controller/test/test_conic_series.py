"""The short series of a conic against its closed form."""

from __future__ import annotations

import numpy as np
import pytest

from dm_common.optics.conic import conic_coefficients, conic_sag
from dm_controller.planning.fast_path import Q_MAX, series, series_coefficients, series_sag

RADIUS = 11e-3
CASES = [(0.05, 0.0), (-0.3, -1.0), (0.2, 5.0), (0.9, 0.0), (0.3, -8.0), (0.0, 1.0)]


@pytest.mark.parametrize(("curvature", "conic_constant"), CASES)
def test_sag_and_coefficients_are_exact(curvature: float, conic_constant: float) -> None:
    amplitudes = series(curvature, conic_constant, RADIUS)
    assert amplitudes is not None
    x, y = np.random.default_rng(2).uniform(-0.7, 0.7, (2, 50))
    sag = conic_sag(RADIUS * x, RADIUS * y, curvature, conic_constant)
    np.testing.assert_allclose(series_sag(x, y) @ amplitudes, sag, rtol=1e-13, atol=1e-21)
    coefficients = conic_coefficients(curvature, conic_constant, RADIUS)
    np.testing.assert_allclose(series_coefficients() @ amplitudes, coefficients, rtol=1e-12, atol=1e-18)


def test_a_deep_conic_has_no_short_series() -> None:
    curvature = 1.01 * np.sqrt(Q_MAX) / RADIUS
    assert series(curvature, 0.0, RADIUS) is None
    assert series(curvature, -1.0, RADIUS) is not None  # a paraboloid is its first term
    assert series(float("nan"), 0.0, RADIUS) is None
