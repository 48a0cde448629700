"""Eq. (2) against closed forms."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_common.optics.conic import conic_coefficients, conic_sag
from dm_common.optics.zernike import basis


def test_sphere_lies_on_its_circle() -> None:
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 9), np.linspace(-0.6, 0.6, 9))
    z = conic_sag(x, y, 1.0)
    np.testing.assert_allclose(x**2 + y**2 + (z - 1) ** 2, 1.0, rtol=1e-14)


def test_paraboloid_is_a_parabola_at_any_radius() -> None:
    r = np.linspace(0, 50, 11)
    np.testing.assert_allclose(conic_sag(r, 0, 2.0, -1.0), r**2, rtol=1e-14)


@settings(max_examples=50, deadline=None)
@given(st.floats(1e-9, 0.1), st.sampled_from([-1.0, 1.0]), st.floats(1e-4, 0.015))
def test_weak_curvature_loses_no_digits(size: float, sign: float, r: float) -> None:
    c = sign * size
    exact = Fraction(c) * Fraction(r) ** 2 / 2 * (1 + Fraction(c) ** 2 * Fraction(r) ** 2 / 4)  # next term below 1e-11
    assert float(conic_sag(r, 0.0, c)) == pytest.approx(float(exact), rel=1e-11)


def test_point_beyond_the_equator_is_refused() -> None:
    with pytest.raises(ValueError, match=r"curvature = 2 1/m, conic_constant = 0: .* reach out to 0\.6 m"):
        conic_sag(0.6, 0.0, 2.0)
    with pytest.raises(ValueError, match="must be finite"):
        conic_sag(0.6, 0.0, math.nan)
    with pytest.raises(ValueError, match="radius = 0"):
        conic_coefficients(0.05, 0.0, 0.0)


def test_coefficients_of_the_papers_sphere() -> None:
    radius, c = 11e-3, 0.05
    found = conic_coefficients(c, 0.0, radius)
    # z = c r^2 / 2 + c^3 r^4 / 8 + ..., with r^2 = (Z_2^0 + 1) / 2 and r^4 = (Z_4^0 + 3 Z_2^0 + 2) / 6
    quadratic, quartic = c * radius**2 / 2, c**3 * radius**4 / 8
    expected = np.zeros(21)
    expected[0] = quadratic / 2 + quartic / 3
    expected[3] = quadratic / 2 + quartic / 2
    expected[10] = quartic / 6
    np.testing.assert_allclose(found, expected, atol=1e-18)


@settings(max_examples=15, deadline=None)
@given(st.floats(-0.5, 0.5), st.floats(-2, 1))
def test_coefficients_are_the_least_squares_fit(c: float, k: float) -> None:
    radius = 11e-3
    y, x = (np.mgrid[:60, :60] - 29.5) / 29.9
    inside = x**2 + y**2 <= 1
    terms = basis(x[inside], y[inside])
    fitted = terms @ conic_coefficients(c, k, radius)
    np.testing.assert_allclose(fitted, conic_sag(radius * x[inside], radius * y[inside], c, k), atol=1e-15)
