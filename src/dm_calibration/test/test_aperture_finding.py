"""Finding the aperture on masks whose circle is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_calibration.optics.aperture import Aperture, InsufficientDataError, find_aperture


def disc(shape: tuple[int, int], x: float, y: float, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return (columns - x) ** 2 + (rows - y) ** 2 <= radius**2


@settings(max_examples=25, deadline=None)
@given(st.floats(55, 75), st.floats(50, 60), st.floats(20, 45))
def test_clean_disc_is_found_to_a_fraction_of_a_pixel(x: float, y: float, radius: float) -> None:
    found = find_aperture(disc((110, 130), x, y, radius))
    assert found.centre_x_px == pytest.approx(x, abs=0.15)
    assert found.centre_y_px == pytest.approx(y, abs=0.15)
    assert found.radius_px == pytest.approx(radius, abs=0.2)


def test_dropouts_bumps_and_specks_do_not_pull_the_circle() -> None:
    rng = np.random.default_rng(1)
    mask = disc((300, 320), 150, 140, 120) & (rng.random((300, 320)) > 0.02)
    mask &= ~disc((300, 320), 262, 140, 15)  # a bite out of the rim
    mask &= ~disc((300, 320), 140, 120, 20)  # a hole
    mask |= disc((300, 320), 150, 20, 12)  # a bump on the rim
    mask |= disc((300, 320), 305, 285, 9)  # a speck elsewhere
    found = find_aperture(mask)
    assert found.centre_x_px == pytest.approx(150, abs=0.4)
    assert found.centre_y_px == pytest.approx(140, abs=0.4)
    assert found.radius_px == pytest.approx(120, abs=0.5)


def test_disc_cut_off_by_the_frame_keeps_its_circle() -> None:
    found = find_aperture(disc((200, 180), 95, 100, 105))
    assert (found.centre_x_px, found.centre_y_px) == pytest.approx((95, 100), abs=0.3)
    assert found.radius_px == pytest.approx(105, abs=0.3)


def test_rectangular_field_gets_its_inscribed_circle() -> None:
    full = find_aperture(np.ones((48, 64), dtype=bool))
    assert (full.centre_x_px, full.centre_y_px) == pytest.approx((31.5, 23.5), abs=0.6)
    assert full.radius_px == pytest.approx(24, abs=0.6)
    framed = np.zeros((100, 120), dtype=bool)
    framed[20:80, 10:110] = True
    found = find_aperture(framed)
    assert (found.centre_x_px, found.centre_y_px) == pytest.approx((59.5, 49.5), abs=0.6)
    assert found.radius_px == pytest.approx(30, abs=0.6)
    assert framed[found.disc(framed.shape)].all()
    slanted = np.add.outer(-0.1 * np.arange(480), np.arange(640.0)) < 456  # one edge is no rim
    assert find_aperture(slanted).radius_px == pytest.approx(240, abs=1.5)


def test_two_mirrors_in_view_are_refused() -> None:
    both = disc((200, 400), 100, 100, 90) | disc((200, 400), 320, 100, 60)
    with pytest.raises(InsufficientDataError, match="two regions of 25445 and 11289 pixels: is another mirror in view"):
        find_aperture(both)


@pytest.mark.parametrize("apart", [150, 140])
def test_two_mirrors_that_touch_are_refused(apart: float) -> None:
    both = disc((200, 400), 100, 100, 90) | disc((200, 400), 100 + apart, 100, 60)
    with pytest.raises(InsufficientDataError, match=r"not one disc: circles of 90 and .* another mirror in view"):
        find_aperture(both)


def test_no_valid_pixel_is_refused() -> None:
    with pytest.raises(InsufficientDataError, match="no valid pixel"):
        find_aperture(np.zeros((5, 5), dtype=bool))


def test_configured_aperture_counts_from_the_maps_centre() -> None:
    found = Aperture.configured((101, 201), 1e-4, 3e-3, centre_x=1e-3, centre_y=2e-3)
    assert (found.centre_x_px, found.centre_y_px, found.radius_px) == pytest.approx((110, 30, 30))


@settings(max_examples=25, deadline=None)
@given(st.integers(-40, 200), st.integers(-40, 200), st.integers(4, 96))
def test_number_of_pixels_counts_those_beyond_the_map_too(x8: int, y8: int, radius8: int) -> None:
    # In eighths of a pixel, which add without rounding: else a pixel on the rim is in for one sum and out for another.
    x, y, radius = x8 / 8, y8 / 8, radius8 / 8
    expected = disc((60, 60), x + 20, y + 20, radius).sum()
    assert Aperture(x, y, radius).pixels() == expected


@pytest.mark.parametrize("radius", [2e5, 1e8])
def test_a_circle_beyond_any_camera_is_counted_without_its_pixels(radius: float) -> None:
    """As when the lateral scale in a file is damaged: an array of these would not fit into memory."""
    assert Aperture(30.0, 30.0, radius).pixels() == pytest.approx(np.pi * radius**2, rel=1e-6)
