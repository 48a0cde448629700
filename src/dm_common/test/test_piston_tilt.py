"""Planes of maps and of sag vectors, and points without data."""

from __future__ import annotations

import numpy as np
import pytest

from dm_common.optics.piston_tilt import fill_gaps, fit_plane, remove_piston_tilt, remove_plane, rms, weighted_fit
from dm_common.optics.sampling import edge_clustered_points
from dm_common.optics.zernike import basis

POINTS = edge_clustered_points(200)


def test_piston_and_tilt_are_removed_and_nothing_else() -> None:
    rows, columns = np.mgrid[:40, :50]
    bump = np.where(np.random.default_rng(0).random((40, 50)) < 0.1, np.nan, np.sin(columns / 3.0) * np.cos(rows / 5.0))
    flat = remove_plane(bump)
    tilted = remove_plane(bump + 5 + 0.3 * columns - 0.2 * rows)
    np.testing.assert_allclose(tilted, flat, atol=1e-12)
    np.testing.assert_allclose(fit_plane(flat), 0, atol=1e-13)
    np.testing.assert_allclose(fit_plane(5 + 0.3 * (columns - 24.5) - 0.2 * (rows - 19.5)), [5, 0.3, -0.2])


def test_plane_of_a_single_row_does_not_fail() -> None:
    sag = np.full((5, 6), np.nan)
    sag[2] = np.arange(6)
    np.testing.assert_allclose(remove_plane(sag)[2], 0, atol=1e-12)
    with pytest.raises(ValueError, match="no valid pixel"):
        fit_plane(np.full((2, 2), np.nan))


def test_weighted_fit_with_and_without_gaps() -> None:
    random = np.random.default_rng(6)
    modes = random.standard_normal((50, 4))
    weight = random.uniform(0.5, 1.5, 50)
    truth = random.standard_normal((3, 4))
    sag = truth @ modes.T
    assert weighted_fit(sag, modes, weight) == pytest.approx(truth)
    sag[1, 5:20] = np.nan
    assert weighted_fit(sag, modes, weight) == pytest.approx(truth)


def test_planes_of_sag_vectors_are_removed_and_nothing_else() -> None:
    modes = basis(POINTS.x, POINTS.y)
    sag = np.random.default_rng(1).standard_normal((3, 21)) @ modes.T
    sag[2, :30] = np.nan
    tilted = sag + 5.0 + 0.3 * POINTS.x - 0.2 * POINTS.y
    np.testing.assert_allclose(remove_piston_tilt(tilted, POINTS), remove_piston_tilt(sag, POINTS), atol=1e-12)
    np.testing.assert_allclose(remove_piston_tilt(modes[:, :3].T, POINTS), 0.0, atol=1e-12)


def test_gaps_are_filled_from_the_model_as_the_map_stands() -> None:
    """The interferometer's plane is not the model's: it goes before the model takes the place of what is missing."""
    model = np.random.default_rng(2).standard_normal((2, 21)) @ basis(POINTS.x, POINTS.y).T
    sag = model + 4.0 - 1.5 * POINTS.x
    sag[0, 10:60] = np.nan
    np.testing.assert_allclose(fill_gaps(sag, model, POINTS), remove_piston_tilt(model, POINTS), atol=1e-12)


def test_rms_weighs_by_area() -> None:
    assert rms(np.full((2, 200), 3.0), POINTS.weight) == pytest.approx(3.0)
    assert rms(2.0 * POINTS.x, POINTS.weight) == pytest.approx(1.0, rel=0.01)  # 2 x over the unit disc
