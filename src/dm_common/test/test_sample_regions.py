"""Shares of sampling points in concentric regions, and errors inside them."""

from __future__ import annotations

import numpy as np
import pytest

from dm_common.optics.piston_tilt import remove_piston_tilt
from dm_common.optics.sample_regions import AREA_FRACTIONS, EmptyRegionError, disc_shares, regional_rms
from dm_common.optics.sampling import SamplePoints, edge_clustered_points, uniform_points
from dm_common.optics.zernike import basis


@pytest.mark.parametrize("points", [edge_clustered_points(500), edge_clustered_points(300), uniform_points(500)])
def test_shares_of_the_points_make_up_the_area_of_each_disc(points: SamplePoints) -> None:
    shares = disc_shares(points)
    assert points.weight @ shares == pytest.approx(AREA_FRACTIONS, abs=1e-12)
    assert (np.diff(shares, axis=1) >= 0).all()
    # Points well inside or outside a disc are in or out.
    squared = points.x**2 + points.y**2
    for fraction, share in zip(AREA_FRACTIONS, shares.T, strict=True):
        assert (share[squared < fraction - 0.15] == 1.0).all()
        assert (share[squared > fraction + 0.15] == 0.0).all()


def test_weights_that_are_no_shares_of_an_area_are_refused() -> None:
    points = edge_clustered_points(100)
    with pytest.raises(ValueError, match="must be positive shares of the area that sum to 1"):
        disc_shares(SamplePoints(points.x, points.y, 2 * points.weight))


def test_levelled_regions() -> None:
    points = edge_clustered_points(500)
    sag = np.random.default_rng(7).standard_normal((2, 21)) @ basis(points.x, points.y).T
    sag[0, :40] = np.nan
    found = regional_rms(sag, points, level_each=True)
    plane = np.column_stack((np.ones(500), points.x, points.y))
    shares = points.weight[:, None] * disc_shares(points)
    for m, r in ((0, 4), (1, 0), (1, 9)):
        weight = np.where(np.isfinite(sag[m]), shares[:, r], 0.0)
        root = np.sqrt(weight)
        z = np.nan_to_num(sag[m])
        fit = np.linalg.lstsq(root[:, None] * plane, root * z, rcond=None)[0]
        assert found[m, r] == pytest.approx(np.sqrt(weight @ (z - plane @ fit) ** 2 / weight.sum()), rel=1e-6)
    tilted = sag + 3.0 - 2.0 * points.x + points.y
    assert regional_rms(tilted, points, level_each=True) == pytest.approx(found, rel=1e-6)
    levelled = remove_piston_tilt(sag, points)
    assert (found <= regional_rms(levelled, points) * (1 + 1e-9)).all()
    assert found[:, -1] == pytest.approx(regional_rms(levelled, points)[:, -1])


def test_a_region_without_data_is_named() -> None:
    points = edge_clustered_points(500)
    sag = np.ones((2, 500))
    sag[1, points.x**2 + points.y**2 <= 0.25] = np.nan
    with pytest.raises(EmptyRegionError, match="map 2: the concentric region of 10%"):
        regional_rms(sag, points)
