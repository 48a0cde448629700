"""The moment fit against plain least squares over the pixels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dm_calibration.optics.aperture import Aperture, InsufficientDataError
from dm_calibration.optics.map_fit import MapFitter
from dm_calibration.optics.orientation import Orientation
from dm_common.optics.zernike import basis


def unit_coordinates(shape: tuple[int, int], x: float, y: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return (columns - x) / radius, (y - rows) / radius


def plain_fit(sag: np.ndarray, x: float, y: float, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coefficients, residual and (A^T A)^-1 by least squares over the valid pixels."""
    u, v = unit_coordinates(sag.shape, x, y, radius)
    used = (u**2 + v**2 <= 1) & np.isfinite(sag)
    terms = basis(u[used], v[used])
    coefficients = np.linalg.lstsq(terms, sag[used], rcond=None)[0]
    return coefficients, sag[used] - terms @ coefficients, np.linalg.inv(terms.T @ terms)


def rough_map(shape: tuple[int, int], seed: int, dropout: float = 0.05) -> np.ndarray:
    rng = np.random.default_rng(seed)
    u, v = unit_coordinates(shape, shape[1] / 2, shape[0] / 2, max(shape) / 2)
    sag = basis(u, v) @ rng.normal(size=21) * 1e-6 + 40e-9 * np.cos(9 * u + 3 * v) + rng.normal(size=shape) * 1e-9
    return np.where(rng.random(shape) < dropout, np.nan, sag)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    x=st.floats(40, 80),
    y=st.floats(30, 70),
    radius=st.floats(15, 60),
    dropout=st.floats(0, 0.6),
)
def test_equals_plain_least_squares(seed: int, x: float, y: float, radius: float, dropout: float) -> None:
    sag = rough_map((100, 120), seed, dropout)
    u, v = unit_coordinates(sag.shape, x, y, radius)
    assume(np.abs(u**2 + v**2 - 1.0).min() > 1e-12)  # rounding says on which side of the rim such a pixel lies
    expected, residual, inverse = plain_fit(sag, x, y, radius)
    found = MapFitter(np.isfinite(sag), x, y, radius).fit(sag)
    np.testing.assert_allclose(found.coefficients, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
    assert found.residual_rms == pytest.approx(np.sqrt((residual**2).mean()), rel=1e-6)
    noise = np.sqrt((residual**2).sum() / (residual.size - 21))
    np.testing.assert_allclose(found.sigma, noise * np.sqrt(np.diag(inverse)), rtol=1e-6)
    assert found.valid_pixels == residual.size
    assert found.valid_fraction == residual.size / Aperture(x, y, radius).pixels()


@pytest.mark.parametrize("offset", [0.0, 1e-3])
def test_exact_surface_leaves_no_residual(offset: float) -> None:
    u, v = unit_coordinates((200, 200), 99.5, 99.5, 100)
    coefficients = np.linspace(-1e-6, 1e-6, 21)
    coefficients[0] += offset
    sag = basis(u, v) @ coefficients
    found = MapFitter(np.ones(sag.shape, dtype=bool), 99.5, 99.5, 100).fit(sag)
    np.testing.assert_allclose(found.coefficients, coefficients, atol=1e-12 * max(offset, 1e-6))
    assert found.residual_rms < 1e-12 * max(offset, 1e-6)


def test_small_residual_under_a_large_piston_keeps_its_digits() -> None:
    rng = np.random.default_rng(0)
    sag = 5e-3 + rng.normal(size=(150, 150)) * 1e-9  # one part in five million
    _coefficients, residual, _inverse = plain_fit(sag - 5e-3, 74.5, 74.5, 75)
    found = MapFitter(np.ones(sag.shape, dtype=bool), 74.5, 74.5, 75).fit(sag)
    assert found.residual_rms == pytest.approx(np.sqrt((residual**2).mean()), rel=1e-6)


def test_sigma_covers_the_scatter_of_repeated_fits() -> None:
    rng = np.random.default_rng(5)
    fitter = MapFitter(np.ones((60, 60), dtype=bool), 29.5, 29.5, 30)
    fits = [fitter.fit(rng.normal(size=(60, 60))) for _ in range(200)]
    scatter = np.std([fit.coefficients for fit in fits], axis=0)
    np.testing.assert_allclose(scatter / fits[0].sigma, 1, atol=0.25)  # 5 standard errors of a scatter of 200


def test_workspace_keeps_nothing_from_one_map_to_the_next() -> None:
    sag = rough_map((90, 90), 1)
    fitter = MapFitter(np.isfinite(sag), 44.5, 44.5, 45)
    first = fitter.fit(sag)
    fitter.fit(np.where(np.isfinite(sag), sag * 3 + 1e-6, 77.0))
    np.testing.assert_array_equal(fitter.fit(sag).coefficients, first.coefficients)


def test_too_few_or_badly_placed_pixels_are_refused() -> None:
    mask = np.zeros((50, 50), dtype=bool)
    mask[25, 10:30] = True
    with pytest.raises(InsufficientDataError, match=r"20 valid pixels .* need at least 21"):
        MapFitter(mask, 24.5, 24.5, 25)
    mask[25] = True  # enough pixels, but all on one line
    with pytest.raises(InsufficientDataError, match="cannot separate the 21 terms"):
        MapFitter(mask, 24.5, 24.5, 25)
    with pytest.raises(InsufficientDataError, match="0 valid pixels"):
        MapFitter(np.ones((50, 50), dtype=bool), 500, 500, 25)


def test_value_missing_under_the_mask_is_refused_and_the_fitter_goes_on() -> None:
    sag = rough_map((60, 60), 2, dropout=0)
    fitter = MapFitter(np.isfinite(sag), 29.5, 29.5, 30)
    good = fitter.fit(sag)
    hole = sag.copy()
    hole[30, 30] = np.nan
    with pytest.raises(ValueError, match="no data in 1 pixels"):
        fitter.fit(hole)
    with pytest.raises(ValueError, match="shape"):
        fitter.fit(sag[:50])
    np.testing.assert_array_equal(fitter.fit(sag).coefficients, good.coefficients)


def test_fitter_knows_what_it_was_made_for() -> None:
    mask = np.isfinite(rough_map((60, 60), 3))
    fitter = MapFitter(mask, 29.5, 29.5, 20)
    assert fitter.fits(mask, Aperture(29.5, 29.5, 20))
    outside = mask.copy()
    outside[0, 0] ^= True  # beyond the aperture
    assert fitter.fits(outside, Aperture(29.5, 29.5, 20))
    inside = mask.copy()
    inside[30, 30] ^= True
    assert not fitter.fits(inside, Aperture(29.5, 29.5, 20))
    assert not fitter.fits(mask, Aperture(29.5, 29.5, 21))


LETTER_F = np.array([[1, 1, 1], [1, 0, 0], [1, 1, 0], [1, 0, 0]], dtype=float)


@pytest.mark.parametrize(
    ("orientation", "expected"),
    [
        (Orientation(), ["###", "#..", "##.", "#.."]),
        (Orientation(flip_x=True), ["###", "..#", ".##", "..#"]),
        (Orientation(flip_y=True), ["#..", "##.", "#..", "###"]),
        (Orientation(rotate_deg=90), ["#...", "#.#.", "####"]),
        (Orientation(rotate_deg=180), ["..#", ".##", "..#", "###"]),
        (Orientation(rotate_deg=270), ["####", ".#.#", "...#"]),
        (Orientation(flip_x=True, rotate_deg=90), ["####", "#.#.", "#..."]),
    ],
)
def test_orientation_of_a_letter(orientation: Orientation, expected: list[str]) -> None:
    found = ["".join("#" if value else "." for value in row) for row in orientation.apply(LETTER_F)]
    assert found == expected


def hill(height: int, width: int, x: float, y: float) -> np.ndarray:
    """A hill at `x`, `y` from the centre of the map, pixels, y up."""
    column, row = np.arange(width) - (width - 1) / 2 - x, (height - 1) / 2 - y - np.arange(height)
    return np.asarray(np.exp(-(column**2 + row[:, None] ** 2) / 200.0))


@pytest.mark.parametrize("degrees", [35.0, -100.0, 217.5])
def test_any_angle_turns_about_the_centre_and_loses_nothing(degrees: float) -> None:
    turned = Orientation(rotate_deg=degrees).apply(hill(120, 160, 30.0, 20.0))
    place = (30.0 + 20.0j) * np.exp(1j * np.radians(degrees))
    expected = hill(turned.shape[0], turned.shape[1], place.real, place.imag)
    valid = np.isfinite(turned)
    assert abs(turned - expected)[valid].max() < 0.003
    assert valid.sum() == pytest.approx(120 * 160, rel=0.03)


def test_a_rotation_keeps_holes_and_edges_empty() -> None:
    sag = np.zeros((50, 50))
    sag[20, 30] = np.nan
    turned = Orientation(rotate_deg=45.0).apply(sag)
    assert turned.shape == (71, 71) and np.isnan(turned[0, 0])
    place = (30 - 24.5 + 1j * (24.5 - 20)) * np.exp(0.25j * np.pi)
    rows, columns = np.nonzero(np.isnan(turned[20:50, 20:50]))
    assert 1 <= len(rows) <= 6
    assert columns.mean() + 20 - 35.0 == pytest.approx(place.real, abs=1.0)
    assert 35.0 - rows.mean() - 20 == pytest.approx(place.imag, abs=1.0)


@settings(max_examples=30, deadline=None)
@given(st.booleans(), st.booleans(), st.floats(-180, 180), st.floats(-3.0, 3.0), st.booleans())
def test_the_orientation_that_puts_a_turned_mirror_right(
    flip_x: bool, flip_y: bool, rotate_deg: float, turn: float, mirrored: bool
) -> None:
    before = Orientation(flip_x, flip_y, rotate_deg)

    def oriented(orientation: Orientation, place: complex) -> complex:
        x, y = -place.real if orientation.flip_x else place.real, -place.imag if orientation.flip_y else place.imag
        return complex(x, y) * complex(np.exp(1j * np.radians(orientation.rotate_deg)))

    camera = 1.7 - 0.6j
    seen = oriented(before, camera) * np.exp(-1j * turn)
    configured = complex(-seen.conjugate() if mirrored else seen)
    assert oriented(before.after(turn, mirrored), camera) == pytest.approx(configured, abs=1e-9)
