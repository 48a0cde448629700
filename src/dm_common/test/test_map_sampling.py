"""Sampling points and the four-neighbour rule."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_common.optics.sampling import SamplePoints, edge_clustered_points, on_disc, sample_map
from dm_common.optics.zernike import basis


@settings(max_examples=40, deadline=None)
@given(st.integers(8, 3000))
def test_exact_count_inside_the_disc_with_all_its_area(count: int) -> None:
    points = edge_clustered_points(count)
    assert len(points) == len(points.x) == len(points.y) == len(points.weight) == count
    assert np.hypot(points.x, points.y).max() < 1
    assert points.weight.min() > 0
    assert points.weight.sum() == pytest.approx(1, abs=1e-12)


def test_points_crowd_at_the_rim() -> None:
    points = edge_clustered_points(500)
    # Uniform points would have 19 % of them there.
    assert (np.hypot(points.x, points.y) > 0.9).sum() > 1.5 * 0.19 * len(points)


def test_weights_integrate_smooth_surfaces() -> None:
    points = edge_clustered_points(500)
    mean = points.weight @ basis(points.x, points.y)
    np.testing.assert_allclose(mean, np.eye(21)[0], atol=0.02)


def test_points_tell_the_21_terms_well_apart_and_are_the_same_every_time() -> None:
    points, again = edge_clustered_points(), edge_clustered_points()
    assert np.linalg.cond(basis(points.x, points.y)) < 6
    np.testing.assert_array_equal(points.x, again.x)


def at(*positions: tuple[float, float]) -> SamplePoints:
    x, y = np.array(positions).T
    return SamplePoints(x, y, np.full(len(x), 1 / len(x)))


SAG = np.array([[1.0, 2.0, 4.0], [8.0, 16.0, 32.0], [64.0, 128.0, np.nan]])


def test_four_neighbour_rule() -> None:
    # centre on the middle pixel, radius of one pixel: x right, y up
    points = at((0, 0), (1, 1), (0.5, 0), (0, -0.3), (-0.25, 0.6), (0.5, -0.5), (1, -0.5), (1, -1))
    expected = [
        16,  # on a pixel
        4,  # on the top right pixel
        (16 + 32) / 2,  # between two columns
        (16 + 128) / 2,  # between two rows
        (1 + 2 + 8 + 16) / 4,  # among four
        (16 + 32 + 128) / 3,  # among four, one without data
        32,  # between two rows, one without data
        np.nan,  # on a pixel without data
    ]
    np.testing.assert_allclose(sample_map(SAG, 1, 1, 1, points), expected)


def test_neighbours_beyond_the_border_do_not_count() -> None:
    np.testing.assert_allclose(sample_map(SAG, 1, 1, 2, at((0, 0.75), (1, 0))), [2, np.nan])
    assert np.isnan(sample_map(SAG, 50, 50, 2, edge_clustered_points(20))).all()


def test_rounding_does_not_make_four_neighbours_of_one() -> None:
    points = at((0.1 + 0.2, 0.0))
    assert sample_map(SAG, 0.7, 1, 1, points)[0] == 16  # 0.7 + 0.30000000000000004 is column 1


def test_plane_is_sampled_within_half_a_pixel() -> None:
    rows, columns = np.mgrid[:101, :101]
    sag = 3.0 * columns - 2.0 * rows
    points = edge_clustered_points(200)
    expected = 3.0 * (50 + 40 * points.x) - 2.0 * (50 - 40 * points.y)
    np.testing.assert_allclose(sample_map(sag, 50, 50, 40, points), expected, atol=2.5)


def test_interpolation_on_the_disc_keeps_a_smooth_shape() -> None:
    points = edge_clustered_points(500)
    shape = points.x**2 - 0.5 * points.y
    shown = on_disc(shape[None], points, 41)[0]
    axis = np.linspace(-1.0, 1.0, 41)
    x, y = np.meshgrid(axis, axis)
    inside = np.hypot(x, y) <= 1.0
    assert np.isnan(shown[~inside]).all()
    np.testing.assert_allclose(shown[inside], (x**2 - 0.5 * y)[inside], atol=5e-3)
