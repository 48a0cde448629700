"""The camera of the virtual bench: geometry, orientation, noise, dropouts."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dm_simulation.interferometer.interferometer import Interferometer, InterferometerConfig
from dm_simulation.mirror import zernike
from dm_simulation.mirror.plate import Plate

Array = NDArray[np.float64]
QUIET = InterferometerConfig(
    pixels=200,
    figure_rms=0.0,
    pixel_noise=0.0,
    low_order_noise=0.0,
    piston_spread=0.0,
    tilt_spread=0.0,
    specks=0,
    blobs=0,
)


@pytest.fixture(scope="module")
def plate() -> Plate:
    return Plate()


def make(config: InterferometerConfig, plate: Plate, seed: int = 1) -> Interferometer:
    return Interferometer(config, plate, np.random.default_rng(seed), np.random.default_rng(seed + 1))


def poke(actuator: int) -> Array:
    bases = np.zeros(37)
    bases[actuator - 1] = 4e-6
    return bases


def pixel_grid(camera: Interferometer) -> tuple[Array, Array]:
    """x right, y up, of every pixel of an unturned camera, m."""
    size = camera.config.pixels
    along = (np.arange(size) - (size - 1) / 2) * camera.config.field_diameter / size
    return np.meshgrid(along, -along)


@pytest.mark.slow
@pytest.mark.parametrize("diameter", [0.020, 0.022, 0.024, 0.030])
def test_the_map_is_the_plate_seen_from_above(plate: Plate, diameter: float) -> None:
    camera = make(replace(QUIET, field_diameter=diameter, pixels=90), plate)
    x, y = pixel_grid(camera)
    inside = np.hypot(x, y) <= diameter / 2
    sag = camera.measure(poke(10) - 0.5 * poke(3))
    np.testing.assert_array_equal(np.isfinite(sag), inside)
    direct = plate.influence_at(x[inside], y[inside]) @ (poke(10) - 0.5 * poke(3))
    np.testing.assert_allclose(sag[inside], direct, atol=1e-12)


def test_beyond_the_rim_of_the_mirror_there_is_nothing(plate: Plate) -> None:
    camera = make(replace(QUIET, mount_x=6e-3, pixels=90), plate)
    x, y = pixel_grid(camera)
    on_mirror = (np.hypot(x - 6e-3, y) <= 0.015) & (np.hypot(x, y) <= 0.011)
    np.testing.assert_array_equal(np.isfinite(camera.measure(poke(1))), on_mirror)


@pytest.mark.parametrize(
    ("turn", "right_and_up"),
    [
        ({}, (1, 1)),
        ({"flip_x": True}, (-1, 1)),
        ({"flip_y": True}, (1, -1)),
        ({"rotate_deg": 180}, (-1, -1)),
    ],
)
def test_where_a_poke_appears(plate: Plate, turn: dict[str, object], right_and_up: tuple[int, int]) -> None:
    """Actuator 9 lies at x = +6.45 mm, y = +3.72 mm."""
    camera = make(replace(QUIET, **turn), plate)  # type: ignore[arg-type]
    row, column = np.unravel_index(np.nanargmax(camera.measure(poke(9))), (200, 200))
    x, y = (column - 99.5) * camera.pitch, (99.5 - row) * camera.pitch
    assert (x, y) == pytest.approx((6.45e-3 * right_and_up[0], 3.72e-3 * right_and_up[1]), abs=0.4e-3)


def test_a_quarter_turn_is_anticlockwise_and_comes_before_mirroring(plate: Plate) -> None:
    camera = make(replace(QUIET, rotate_deg=90), plate)
    row, column = np.unravel_index(np.nanargmax(camera.measure(poke(9))), (200, 200))
    assert ((column - 99.5) * camera.pitch, (99.5 - row) * camera.pitch) == pytest.approx((-3.72e-3, 6.45e-3), abs=4e-4)
    mirrored = make(replace(QUIET, rotate_deg=90, flip_x=True), plate)
    np.testing.assert_array_equal(mirrored.measure(poke(9)), camera.measure(poke(9))[:, ::-1])
    with pytest.raises(ValueError, match=r"rotate_deg = 45"):
        make(replace(QUIET, rotate_deg=45), plate)


def test_full_camera_has_enough_valid_pixels_and_masks_differ(plate: Plate) -> None:
    camera = make(InterferometerConfig(), plate)
    maps = [camera.measure(np.zeros(37)) for _ in range(3)]
    for sag in maps:
        assert sag.shape == (944, 944)
        assert 685_000 <= np.isfinite(sag).sum() < 699_900
    assert np.any(np.isfinite(maps[0]) != np.isfinite(maps[1]))


@pytest.mark.slow
def test_initial_figure(plate: Plate) -> None:
    camera = make(replace(QUIET, figure_rms=40e-9), plate)
    sag = camera.measure(np.zeros(37))
    assert np.nanstd(sag) == pytest.approx(40e-9, rel=1e-6)
    x, y = pixel_grid(camera)
    inside = np.isfinite(sag)
    modes = zernike.evaluate(x[inside] / plate.radius, y[inside] / plate.radius, zernike.terms_to_order(12))
    fit = np.linalg.lstsq(modes, sag[inside], rcond=None)[0]
    np.testing.assert_allclose(modes @ fit, sag[inside], atol=1e-13)  # nothing beyond order 12
    other = make(replace(QUIET, figure_rms=40e-9), plate, seed=5).measure(np.zeros(37))
    assert np.nanstd(other - sag) > 10e-9
    same = make(replace(QUIET, figure_rms=40e-9), plate).measure(np.zeros(37))
    np.testing.assert_array_equal(same, sag)


def test_pixel_noise_is_white_and_as_large_as_stated(plate: Plate) -> None:
    camera = make(replace(QUIET, pixel_noise=1e-9), plate)
    noise = camera.measure(np.zeros(37))
    assert np.nanstd(noise) == pytest.approx(1e-9, rel=0.02)
    row = noise[100, 20:180]
    assert abs(np.corrcoef(row[1:], row[:-1])[0, 1]) < 0.4
    assert np.nanstd(camera.measure(np.zeros(37)) - noise) == pytest.approx(np.sqrt(2) * 1e-9, rel=0.02)


def test_low_order_noise_may_last(plate: Plate) -> None:
    camera = make(replace(QUIET, low_order_noise=1e-9, noise_time=60.0), plate)
    first, soon, later = (camera.measure(np.zeros(37), time) for time in (0.0, 0.06, 6e5))
    assert np.nanstd(soon - first) < 0.2 * np.nanstd(first)
    assert np.nanstd(later - first) > 0.8e-9


def test_low_order_noise_piston_and_tilt(plate: Plate) -> None:
    config = replace(QUIET, low_order_noise=0.3e-9, piston_spread=200e-9, tilt_spread=300e-9, pixels=64)
    camera = make(config, plate)
    x, y = pixel_grid(camera)
    inside = np.hypot(x, y) <= 0.011
    modes = zernike.evaluate(x[inside] / 0.011, y[inside] / 0.011, zernike.terms_to_order(5))
    solver = np.linalg.pinv(modes)
    fits = np.array([solver @ camera.measure(np.zeros(37))[inside] for _ in range(400)])
    assert fits[:, 0].std() == pytest.approx(200e-9, rel=0.15)
    assert 2 * fits[:, 1].std() == pytest.approx(300e-9, rel=0.15)  # sag at the edge of the field
    assert np.sqrt((fits[:, 3:] ** 2).sum(axis=1).mean()) == pytest.approx(0.3e-9, rel=0.1)


def test_true_sag_is_the_measurement_without_its_errors(plate: Plate) -> None:
    camera = make(replace(QUIET, figure_rms=40e-9, flip_x=True), plate)
    np.testing.assert_array_equal(camera.true_sag(poke(20)), camera.measure(poke(20)))


def test_the_reference_is_what_a_perfect_flat_shows(plate: Plate) -> None:
    camera = make(replace(QUIET, instrument_error=30e-9, distortion=0.03, rotate_deg=90), plate)
    np.testing.assert_array_equal(camera.reference(), camera.measure(np.zeros(37)))


def test_scale_and_place_of_the_maps_are_not_those_of_the_surface(plate: Plate) -> None:
    figured = replace(QUIET, figure_rms=40e-9, mount_angle=0.5)
    well, off = make(figured, plate), make(replace(figured, mount_scale=1.05, mount_x=4e-4), plate)
    at_true = well.true_surface(poke(20)) - well.true_surface(np.zeros(37))
    np.testing.assert_allclose(off.true_surface(poke(20)) - off.true_surface(np.zeros(37)), at_true, atol=1e-18)
    figure, seen = (camera.true_surface(np.zeros(37)).ravel() for camera in (well, off))
    np.testing.assert_allclose(seen / np.linalg.norm(seen), figure / np.linalg.norm(figure), atol=1e-12)
    assert np.abs(off.surface(poke(20)) - off.true_surface(poke(20))).max() > 1e-8
    np.testing.assert_array_equal(well.true_surface(poke(20)), well.surface(poke(20)))


def test_a_field_larger_than_the_plate_is_refused(plate: Plate) -> None:
    with pytest.raises(ValueError, match=r"field_diameter = 0.04 m: must not exceed the mirror, 0.03 m"):
        make(replace(QUIET, field_diameter=0.040), plate)


def test_with_noise_of_its_own_it_stays_the_same_instrument(plate: Plate) -> None:
    config = replace(QUIET, figure_rms=40e-9, pixel_noise=1e-9)
    camera, alike = make(config, plate), make(config, plate)
    one, other = copy.copy(camera), copy.copy(camera)
    one.noise, other.noise = np.random.default_rng(77), np.random.default_rng(77)
    np.testing.assert_array_equal(other.true_sag(poke(3)), camera.true_sag(poke(3)))
    first = other.measure(poke(3))
    np.testing.assert_array_equal(one.measure(poke(3)), first)
    expected = alike.measure(poke(3))
    np.testing.assert_array_equal(camera.measure(poke(3)), expected)  # its own noise has not been used up
    assert np.nanstd(expected - first) > 0.5e-9
