"""Errors of the instrument: flats told from each other, retrace error, distortion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from dm_calibration.optics.aperture import InsufficientDataError, find_aperture
from dm_calibration.optics.flats import FlatTest, reference_from_flats
from dm_calibration.optics.instrument import find_retrace, lateral_scale, undistorted, without_retrace
from dm_calibration.optics.orientation import Orientation
from dm_common import Floats
from dm_common.optics.zernike import PISTON_TILT, TERMS, basis

SIZE = 120
X, Y = np.meshgrid(*((np.arange(SIZE) - 0.5 * (SIZE - 1)) * step / (0.5 * SIZE) for step in (1.0, -1.0)))
DISC = np.hypot(X, Y) <= 0.97
RNG = np.random.default_rng(5)
BEGINNING = RNG.bit_generator.state
FLATS = {name: RNG.normal(0.0, 10e-9, len(TERMS)) * (np.arange(len(TERMS)) >= PISTON_TILT) for name in "ABC"}


@pytest.fixture(autouse=True)
def same_numbers() -> None:
    """Whichever tests ran before."""
    RNG.bit_generator.state = BEGINNING


def against(reference: str, part: str, degrees: float = 0.0) -> FlatTest:
    """A map with piston and tilt of its own, noise and dropouts."""
    turn = np.radians(degrees)
    own_x, own_y = np.cos(turn) * X + np.sin(turn) * Y, np.cos(turn) * Y - np.sin(turn) * X
    behind = basis(-own_x, own_y) @ FLATS[part]  # flats are told as they are seen in the instrument, from behind
    sag = basis(X, Y) @ FLATS[reference] + behind + basis(X, Y)[..., :3] @ RNG.normal(0.0, 1e-7, 3)
    sag += RNG.normal(0.0, 0.3e-9, sag.shape)
    seen = DISC & (RNG.random(sag.shape) > 0.01)
    return FlatTest(np.where(seen, sag, np.nan), reference, part, turn)


def error_of(tests: list[FlatTest]) -> tuple[float, float, tuple[int, ...]]:
    """Largest error in a coefficient beyond tilt, the bound given on it, and the angular orders left open."""
    found = reference_from_flats(tests)
    left = (found.sag - basis(X, Y) @ FLATS[tests[0].reference])[DISC & np.isfinite(found.sag)]
    inside = DISC & np.isfinite(found.sag)
    coefficients = np.linalg.lstsq(basis(X[inside], Y[inside]), left, rcond=None)[0]
    return float(np.abs(coefficients[PISTON_TILT:]).max()), found.bound, found.open_orders


def test_three_flats_of_which_one_was_turned() -> None:
    tests = [against("A", "B"), against("A", "B", 37.0), against("A", "C"), against("B", "C"), against("B", "C", 90.0)]
    error, bound, left_open = error_of(tests)
    assert (left_open, error < bound < 0.5e-9) == ((), True)


@pytest.mark.parametrize("term", [3, 10, 20])
def test_what_the_maps_say_against_each_other_is_told_as_rms(term: int) -> None:
    turns = [("A", "B", 0.0), ("A", "B", 37.0), ("A", "C", 0.0), ("B", "C", 0.0), ("B", "C", 90.0)]
    apart = 20e-9 * basis(X, Y)[..., term]
    tests = [replace(test, sag=test.sag + sign * apart) for sign in (1, -1) for test in [against(*t) for t in turns]]
    assert reference_from_flats(tests).left == pytest.approx(np.sqrt(np.mean(apart[DISC] ** 2)), rel=0.03)


def test_maps_of_too_few_pixels_are_refused() -> None:
    tests = [replace(test, sag=test.sag[::6, ::6]) for test in (against("A", "B"), against("A", "B", 37.0))]
    with pytest.raises(InsufficientDataError, match=r"share \d+ valid pixels: must be 364 or more, for 91 terms"):
        reference_from_flats(tests)


def test_three_flats_without_a_turn_leave_the_odd_part_open() -> None:
    error, _, left_open = error_of([against("A", "B"), against("A", "C"), against("B", "C")])
    assert set(left_open) == set(range(1, 13)) and error > 3e-9


def test_one_part_that_is_turned_tells_all_but_the_symmetric_part() -> None:
    error, _, left_open = error_of([against("A", "B", degrees) for degrees in (0.0, 50.0, 100.0, 170.0, 260.0)])
    assert left_open == (0,)
    symmetric = [k for k, term in enumerate(TERMS) if term.m == 0]
    assert error == pytest.approx(np.abs(FLATS["A"][symmetric][1:]).max(), abs=0.5e-9)


@pytest.mark.parametrize("tests", [[], [against("A", "B")], [against("A", "B"), against("A", "B")]])
def test_maps_that_tell_nothing_are_refused(tests: list[FlatTest]) -> None:
    with pytest.raises(ValueError, match=r"maps: must be some|do not distinguish the flats"):
        reference_from_flats(tests)


def tilted(retrace: np.ndarray, tilts: list[tuple[float, float]]) -> list[np.ndarray]:
    shape = np.r_[np.zeros(3), RNG.normal(0.0, 20e-9, 18)]
    maps = []
    for tilt in tilts:
        coefficients = shape + np.r_[0.0, tilt, tilt @ retrace.reshape(2, -1)]
        maps.append(np.where(DISC, basis(X, Y) @ coefficients + RNG.normal(0.0, 0.5e-9, X.shape), np.nan))
    return maps


def test_retrace_error_is_found_from_tilted_maps_and_taken_off() -> None:
    retrace = RNG.normal(0.0, 2e-3, 36)
    tilts = [(x * 1e-6, y * 1e-6) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    found, before, left = find_retrace(tilted(retrace, tilts))
    assert np.abs(found - retrace).max() < 2e-4 and left < 0.5e-9 < 3e-9 < before
    flat, steep = tilted(retrace, [(0.0, 0.0), (2e-6, -1e-6)])
    apart = (without_retrace(steep, found) - flat)[DISC]
    assert np.abs(np.linalg.lstsq(basis(X[DISC], Y[DISC]), apart, rcond=None)[0][PISTON_TILT:]).max() < 1e-9


@pytest.mark.parametrize(
    ("tilts", "text"),
    [([(0.0, 0.0)] * 4, "4 maps of 120 x 120 pixels: must be 5 or more"), ([(1e-6, 0.0), (0.0, 0.0)] * 3, "tilt in x")],
)
def test_tilts_that_do_not_tell_are_refused(tilts: list[tuple[float, float]], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        find_retrace(tilted(np.zeros(36), tilts))


def test_maps_of_several_shapes_tell_no_retrace_error() -> None:
    """Maps of a mirror that moved passed for a retrace error of 0.46 m for each m of tilt."""
    maps = tilted(np.zeros(36), [(1e-6, 0.0), (0.0, 1e-6), (0.0, 0.0)] * 2)
    curved = [sag + 2e-7 * k * (X**2 + Y**2) for k, sag in enumerate(maps)]
    with pytest.raises(ValueError, match="take maps of one shape"):
        find_retrace(curved)


@pytest.mark.parametrize("other", [5e-9, 20e-9])
def test_one_map_of_another_shape_tells_no_retrace_error(other: float) -> None:
    """With 20 nm in one of nine maps 3 nm for each um of tilt were found that are not there."""
    maps = tilted(RNG.normal(0.0, 2e-3, 36), [(x * 1e-6, y * 1e-6) for x in (-1, 0, 1) for y in (-1, 0, 1)])
    maps[3] += other * (2.0 * (X**2 + Y**2) - 1.0)
    with pytest.raises(ValueError, match="take maps of one shape"):
        find_retrace(maps)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("distortion", [-0.01, 0.0, 0.004])
def test_scale_and_distortion_from_a_grid(mirrored: bool, distortion: float) -> None:
    pitch, half = 23.3e-6, 0.5 * SIZE
    true = np.array([complex(x, y) for x in np.linspace(-0.9, 0.9, 9) for y in np.linspace(-0.9, 0.9, 9)])
    seen = true * (1.0 + distortion * np.abs(true) ** 2) * half + RNG.normal(0.0, 0.03, (81, 2)) @ (1.0, 1j)
    place = true * np.exp(0.3j) * half * pitch + (0.01 + 0.02j)
    x = -place.real if mirrored else place.real
    marks = np.column_stack((0.5 * (SIZE - 1) + seen.real, 0.5 * (SIZE - 1) - seen.imag, x, place.imag))
    found = lateral_scale(marks, (SIZE, SIZE))
    assert abs(found.pitch / pitch - 1.0) < 1.5 * found.scale_error < 1e-3
    assert abs(found.distortion - distortion) < 1.5 * found.distortion_error < 1e-3
    assert found.left == pytest.approx(0.03 * np.sqrt(2.0) * pitch, rel=0.3)


@pytest.mark.parametrize("seen", [np.zeros((9, 2)), np.arange(9.0)[:, None] * (1.0, 2.0)])
@pytest.mark.parametrize("turned", [False, True])
def test_marks_on_a_line_are_refused(seen: np.ndarray, turned: bool) -> None:
    """Where they are seen too: a column written twice ended as "Singular matrix"."""
    places = 1e-3 * np.array([(x, y) for x in range(3) for y in range(3)])
    with pytest.raises(ValueError, match="9 marks: must be 8 or more, and not all on one line"):
        lateral_scale(np.hstack((places, seen) if turned else (seen, places)), (SIZE, SIZE))


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_marks_on_a_ring_tell_no_distortion(noise: float) -> None:
    ring = np.exp(2j * np.pi * np.arange(8) / 8)
    seen = 0.8 * 0.5 * SIZE * ring + RNG.normal(0.0, noise, (8, 2)) @ (1.0, 1j)
    marks = np.column_stack((0.5 * (SIZE - 1) + seen.real, 0.5 * (SIZE - 1) - seen.imag, ring.real, ring.imag))
    with pytest.raises(ValueError, match="do not separate scale from distortion"):
        lateral_scale(marks, (SIZE, SIZE))


def test_undistorted_is_where_it_is() -> None:
    distortion = 0.01
    share = np.ones_like(X)
    for _ in range(6):
        share = 1.0 / (1.0 + distortion * (X**2 + Y**2) * share**2)
    seen = basis(X * share, Y * share)[..., 3] * 1e-6
    there = undistorted(seen, distortion)
    good = np.isfinite(there)
    assert good.mean() > 0.95
    assert np.abs(there - basis(X, Y)[..., 3] * 1e-6)[good].max() < 1e-9


@pytest.mark.parametrize("resample", [Orientation(rotate_deg=33.0).apply, lambda sag: undistorted(sag, 1e-9)])
def test_interpolation_does_not_shrink_the_aperture(resample: Callable[[Floats], Floats]) -> None:
    """Where all four neighbours had to have data it was 0.6 or 1.3 pixels smaller: 1 or 2 % of every curvature here."""
    sag = np.where(np.hypot(X, Y) <= 0.9, 1e-6 * (X**2 + Y**2), np.nan)
    sag[40:43, 60:63] = np.nan
    there = resample(sag)
    assert find_aperture(np.isfinite(there)).radius_px == pytest.approx(0.9 * 0.5 * SIZE, abs=0.1)
    assert np.count_nonzero(np.isfinite(there)) == pytest.approx(np.count_nonzero(np.isfinite(sag)), abs=10)
    place = np.hypot(*(np.indices(there.shape).T - 0.5 * (np.array(there.shape) - 1.0)).T) / (0.5 * SIZE)
    off = np.abs(there - 1e-6 * place**2)
    assert np.nanmax(off) < 2e-9, "at the rim too, of a slope of 30 nm per pixel"
    assert np.nanquantile(off, 0.9) < 0.2e-9


def test_interpolation_does_not_flatten_the_rim() -> None:
    """The mean of those neighbours that have data looked like 2 nm of spherical aberration here."""
    rotate = Orientation(rotate_deg=33.0).apply
    sag = np.where(np.hypot(X, Y) <= 0.9, 4e-6 * (X**2 + Y**2), np.nan)
    there = rotate(sag)
    rows, columns = np.nonzero(np.isfinite(there))
    x, y = ((at - 0.5 * (size - 1)) / (0.45 * SIZE) for at, size in ((columns, there.shape[1]), (rows, there.shape[0])))
    found = np.linalg.lstsq(basis(x, y), there[rows, columns], rcond=None)[0]
    assert np.abs(found[4:]).max() < 0.2e-9


def test_a_lone_pixel_is_not_spread() -> None:
    """Where no two pixels with data are in line, nothing is known between them and the next."""
    sag = np.full((SIZE, SIZE), np.nan)
    sag[60, 60] = sag[80, 83] = 1e-6
    assert not np.isfinite(undistorted(sag, 1e-3)).any()
