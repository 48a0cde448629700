"""Errors inside concentric regions, on pixels and on sampling points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_calibration.optics.aperture import Aperture
from dm_common.optics.piston_tilt import remove_piston_tilt
from dm_common.optics.sample_regions import EmptyRegionError, disc_shares, regional_rms
from dm_common.optics.sampling import edge_clustered_points, sample_map
from dm_common.optics.zernike import basis
from studies.paper.regions import (
    ConcentricRegions,
    figure_5,
    levelled_rms,
    region_statistics,
    residual_map,
    row_spans,
    squared_distance,
)

SIZE = 301
APERTURE = Aperture(150.0, 150.0, 150.0)


def smooth_map(seed: int) -> np.ndarray:
    """Bumps about as wide as an actuator spacing, NaN outside the aperture."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[1 : -1 : SIZE * 1j, -1 : 1 : SIZE * 1j]
    sag = np.zeros((SIZE, SIZE))
    for cx, cy, height in random.uniform(-1, 1, (12, 3)):
        sag += height * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 0.25**2))
    return np.where(APERTURE.disc(sag.shape), sag, np.nan)


def test_residual_map() -> None:
    sag = smooth_map(7)
    coefficients = 1e-8 * np.arange(1.0, 22.0)
    row, column = np.nonzero(np.isfinite(sag))
    expected = sag[row, column] - basis(column / 150.0 - 1.0, 1.0 - row / 150.0) @ coefficients
    np.testing.assert_allclose(residual_map(sag, coefficients, APERTURE)[row, column], expected, atol=1e-15)


def test_points_tell_the_regional_errors_of_the_map() -> None:
    maps = [smooth_map(seed) for seed in range(6)]
    on_pixels = ConcentricRegions((SIZE, SIZE), APERTURE).rms_of_each(maps)
    points = edge_clustered_points(500)
    sag = np.stack([sample_map(m, 150.0, 150.0, 150.0, points) for m in maps])
    on_points = regional_rms(sag, points)
    assert on_points.shape == (6, 10)
    assert on_points == pytest.approx(on_pixels, rel=0.12)
    assert on_points[:, -1] == pytest.approx(on_pixels[:, -1], rel=0.02)
    assert np.sqrt(np.square(sag) @ points.weight) == pytest.approx(on_points[:, -1])


def test_levelled_regions() -> None:
    points = edge_clustered_points(500)
    sag = np.random.default_rng(7).standard_normal((2, 21)) @ basis(points.x, points.y).T
    sag[0, :40] = np.nan
    found = levelled_rms(sag, points)
    plane = np.column_stack((np.ones(500), points.x, points.y))
    shares = points.weight[:, None] * disc_shares(points)
    for m, r in ((0, 4), (1, 0), (1, 9)):
        weight = np.where(np.isfinite(sag[m]), shares[:, r], 0.0)
        root = np.sqrt(weight)
        z = np.nan_to_num(sag[m])
        fit = np.linalg.lstsq(root[:, None] * plane, root * z, rcond=None)[0]
        assert found[m, r] == pytest.approx(np.sqrt(weight @ (z - plane @ fit) ** 2 / weight.sum()), rel=1e-6)
    tilted = sag + 3.0 - 2.0 * points.x + points.y
    assert levelled_rms(tilted, points) == pytest.approx(found, rel=1e-6)
    levelled = remove_piston_tilt(sag, points)
    assert (found <= regional_rms(levelled, points) * (1 + 1e-9)).all()
    assert found[:, -1] == pytest.approx(regional_rms(levelled, points)[:, -1])


def test_a_region_without_data_is_named() -> None:
    regions = ConcentricRegions((SIZE, SIZE), APERTURE)
    whole, holed = smooth_map(1), smooth_map(2)
    holed[squared_distance(APERTURE, holed.shape) <= 0.25] = np.nan
    with pytest.raises(EmptyRegionError, match=r"p07: the concentric region of 10% of the area holds no valid data"):
        regions.rms_of_each([whole, holed], ["p06", "p07"])
    points = edge_clustered_points(500)
    sag = np.stack([sample_map(m, 150.0, 150.0, 150.0, points) for m in (whole, holed)])
    with pytest.raises(EmptyRegionError, match="map 2: the concentric region of 10%"):
        regional_rms(sag, points)
    with pytest.raises(ValueError, match="compare only maps of one camera and one aperture"):
        regions.rms_of_each([whole, whole[1:]])
    with pytest.raises(ValueError, match="no map given"):
        regions.rms_of_each([])
    with pytest.raises(ValueError, match=r"must be \(maps, 500 sampling points\)"):
        regional_rms(sag[:, 1:], points)


def test_mean_and_variance_over_surfaces() -> None:
    rms = np.random.default_rng(3).uniform(1.0, 2.0, (5, 10))
    found = region_statistics(rms)
    assert found.mean == pytest.approx(rms.sum(axis=0) / 5)
    assert found.variance == pytest.approx(((rms - rms.mean(axis=0)) ** 2).sum(axis=0) / 4)
    with pytest.raises(ValueError, match="1 surfaces to average: a variance needs at least 2"):
        region_statistics(rms[:1])
    with pytest.raises(ValueError, match=r"must be \(5 surfaces, 10 regions\)"):
        region_statistics(rms[:, 1:])


def test_both_panels_of_figure_5() -> None:
    labels = ["reference 1", *(f"p{k:02d}" for k in range(1, 59)), *(f"pz{k:02d}" for k in range(1, 12)), "poke+01"]
    rms = np.random.default_rng(4).uniform(1.0, 2.0, (len(labels), 10))
    rms[[labels.index("pz02"), labels.index("pz03")]] = 9.0
    actuators, zernikes = figure_5(rms, labels)
    assert actuators.labels == tuple(labels[1:59]) and actuators.averaged.all()
    assert actuators.mean == pytest.approx(rms[1:59].mean(axis=0))
    assert zernikes.labels == tuple(labels[59:70]) and zernikes.averaged.sum() == 9
    assert (zernikes.mean < 2.0).all() and zernikes.rms.max() == 9.0
    with pytest.raises(ValueError, match="0 surfaces to average"):
        figure_5(rms[:59], labels[:59])


def test_rms_inside_each_disc_of_a_rough_map() -> None:
    aperture = Aperture(40.2, 39.1, 35.0)
    y, x = np.mgrid[:80, :80]
    u, v = (x - 40.2) / 35.0, (39.1 - y) / 35.0
    residual = np.where(u**2 + v**2 <= 1.0, np.random.default_rng(4).standard_normal((80, 80)), np.nan)
    found = ConcentricRegions((80, 80), aperture).rms(residual)
    for share, rms in zip(np.arange(1, 11) / 10, found, strict=True):
        inside = (u**2 + v**2 <= share) & np.isfinite(residual)
        assert rms == pytest.approx(np.sqrt((residual[inside] ** 2).mean()), rel=1e-9)


def test_regions_have_the_stated_share_of_the_area() -> None:
    aperture = Aperture(149.5, 149.5, 150)
    step = np.where(squared_distance(aperture, (300, 300)) <= 0.3, 1.0, 0.0)
    found = ConcentricRegions((300, 300), aperture).rms(step)
    np.testing.assert_allclose(found**2, np.minimum(1, 0.3 / (np.arange(1, 11) / 10)), rtol=2e-3)
    assert np.isnan(ConcentricRegions((300, 300), aperture).rms(np.full((300, 300), np.nan))).all()
    with pytest.raises(ValueError, match="must rise within 0 to 1"):
        ConcentricRegions((3, 3), aperture, [0.5, 0.4])


@settings(max_examples=60, deadline=None)
@given(
    x=st.one_of(st.floats(-20, 80), st.integers(0, 60).map(lambda n: n / 2)),
    y=st.one_of(st.floats(-20, 80), st.integers(0, 60).map(lambda n: n / 2)),
    radius=st.one_of(st.floats(0.2, 60), st.sampled_from([2.5, 5.0, 12.5, 25.0, 32.5])),
    fraction=st.sampled_from([0.1, 0.36, 0.64, 1.0]),
)
def test_row_spans_are_the_pixels_inside(x: float, y: float, radius: float, fraction: float) -> None:
    """Also where pixels lie on the circle to the last bit, as with whole-numbered right triangles."""
    aperture, shape = Aperture(x, y, radius), (50, 60)
    start, end = row_spans(aperture, shape, fraction)
    column = np.arange(shape[1])
    found = (column >= start[:, None]) & (column < end[:, None])
    np.testing.assert_array_equal(found, squared_distance(aperture, shape) <= fraction)
    if fraction == 1.0:
        on_the_circle = np.isclose(squared_distance(aperture, shape), 1.0, rtol=0.0, atol=1e-12)
        np.testing.assert_array_equal(aperture.disc(shape) | on_the_circle, found | on_the_circle)
