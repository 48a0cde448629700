"""Shares of sampling points in concentric regions, and errors inside them."""

from __future__ import annotations

import numpy as np
import pytest

from dm_common.optics.sample_regions import AREA_FRACTIONS, EmptyRegionError, disc_shares, regional_rms
from dm_common.optics.sampling import SamplePoints, edge_clustered_points


@pytest.mark.parametrize("points", [edge_clustered_points(500), edge_clustered_points(300)])
def test_shares_of_the_points_make_up_the_area_of_each_disc(points: SamplePoints) -> None:
    shares = disc_shares(points)
    assert points.weight @ shares == pytest.approx(AREA_FRACTIONS, abs=1e-12)
    assert (np.diff(shares, axis=1) >= 0).all()
    # Points well inside or outside a disc are in or out.
    squared = points.x**2 + points.y**2
    for fraction, share in zip(AREA_FRACTIONS, shares.T, strict=True):
        assert (share[squared < fraction - 0.15] == 1.0).all()
        assert (share[squared > fraction + 0.15] == 0.0).all()


def test_a_region_without_data_is_named() -> None:
    points = edge_clustered_points(500)
    sag = np.ones((2, 500))
    sag[1, points.x**2 + points.y**2 <= 0.25] = np.nan
    with pytest.raises(EmptyRegionError, match="map 2: the concentric region of 10%"):
        regional_rms(sag, points)
