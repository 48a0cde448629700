"""From file to figures: aperture, orientation, pitch and refusals."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.interferometer_parameters import load_reference
from dm_calibration.map_files import NoValidPixelsError, SurfaceMap, read_map
from dm_calibration.map_files.fits import fits_bytes
from dm_calibration.optics.aperture import InsufficientDataError, MapRejectedError
from dm_calibration.optics.orientation import Orientation
from dm_common.measurement import Measurement
from dm_common.optics.conic import conic_sag, pitch_of_sphere
from dm_common.optics.zernike import DEFOCUS, basis, curvature_of_defocus
from map_fixtures import NO_DATA, WAVELENGTH, dat_bytes, disc_counts, write_datx

SIZE, PITCH = 120, 2e-4
COEFFICIENTS = np.zeros(21)
COEFFICIENTS[[0, 1, 2, 3, 5, 9]] = [2e-7, 1e-7, -3e-7, 5e-7, 4e-8, -6e-8]


@pytest.fixture
def surface(tmp_path: Path) -> Path:
    """A disc of 55 pixels radius around column 62, row 57, with known coefficients."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    x, y = (columns - 62) / 55, (57 - rows) / 55
    path = tmp_path / "map.datx"
    sag = basis(x, y) @ COEFFICIENTS
    write_datx(path, np.where(x**2 + y**2 <= 1, sag * 1e9, 1.7976931348623157e308), "NanoMeters", pitch=PITCH)
    return path


def test_found_aperture_and_coefficients(surface: Path) -> None:
    _, found = Ingest().read(surface, IngestSettings())
    assert found.pitch == PITCH
    assert found.radius_px == pytest.approx(55, abs=0.2)
    assert found.radius == pytest.approx(0.011, rel=0.004)
    assert found.centre == pytest.approx((62, 57), abs=0.2)
    np.testing.assert_allclose(found.coefficients, COEFFICIENTS, atol=5e-9)
    assert found.sag.shape == (500,)


def test_configured_aperture_gives_the_coefficients_exactly(surface: Path) -> None:
    settings = IngestSettings(aperture_radius=55 * PITCH, aperture_centre=(2.5 * PITCH, 2.5 * PITCH))
    _, found = Ingest().read(surface, settings)
    np.testing.assert_allclose(found.coefficients, COEFFICIENTS, atol=1e-15)
    assert found.valid_fraction == 1
    expected = basis(found.points.x, found.points.y) @ COEFFICIENTS
    np.testing.assert_allclose(found.sag, expected, atol=4e-8)  # half a pixel of slope at the rim


def test_an_aperture_larger_than_the_mirror_is_refused(surface: Path) -> None:
    with pytest.raises(MapRejectedError, match=r"aperture.radius = 0.05 m: the mirror has a radius of 0.015 m"):
        Ingest().read(surface, IngestSettings(aperture_radius=0.05, mirror_radius=0.015))
    Ingest().read(surface, IngestSettings(aperture_radius=0.01, mirror_radius=0.015))


def test_the_error_of_the_instrument_is_subtracted_before_the_map_is_turned(surface: Path, tmp_path: Path) -> None:
    content = read_map(surface)
    error = np.zeros(21)
    error[[4, 7, 11]] = [30e-9, -20e-9, 10e-9]
    rows, columns = np.mgrid[:SIZE, :SIZE]
    own = basis((columns - 62) / 55, (57 - rows) / 55) @ error
    seen = dataclasses.replace(content, sag=content.sag + own)
    reference = dataclasses.replace(content, sag=np.where(np.isfinite(content.sag), own, np.nan))
    settings = IngestSettings(
        orientation=Orientation(flip_x=True, rotate_deg=90.0),
        aperture_radius=54 * PITCH,
        aperture_centre=(2.5 * PITCH, 2.5 * PITCH),
    )
    absolute, measured = Ingest().measure(seen, dataclasses.replace(settings, reference=reference))
    alone = Ingest().measure(content, settings)[1]
    np.testing.assert_allclose(measured.coefficients, alone.coefficients, atol=1e-15)
    assert measured.reference_surface == f"map.datx, SHA-256 {hashlib.sha256(surface.read_bytes()).hexdigest()}"
    assert (measured.system_error_subtracted, alone.system_error_subtracted) == (1, -1)
    np.testing.assert_allclose(absolute.sag, settings.orientation.apply(content.sag), atol=1e-15)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"sag": np.zeros((SIZE, SIZE - 1))}, "120 x 120 pixels from column 0, row 0 .* has 119 x 120"),
        ({"origin": (3, 0)}, "reference_surface has 120 x 120 pixels from column 3"),
        ({"pitch": 2.1e-4}, "pitch 200.000 um, reference_surface has 210.000 um"),
        ({"wavelength": 1.064e-6}, "wavelength 632.800 nm, reference_surface has 1064.000 nm"),
    ],
)
def test_a_reference_of_another_setting_is_refused(surface: Path, change: dict[str, Any], text: str) -> None:
    reference = dataclasses.replace(read_map(surface), **change)
    with pytest.raises(MapRejectedError, match=f"map.datx: .*{text}"):
        Ingest().read(surface, IngestSettings(reference=reference))


def test_an_error_is_not_subtracted_twice(surface: Path) -> None:
    corrected = dataclasses.replace(read_map(surface), system_error_subtracted=True)
    with pytest.raises(MapRejectedError, match="has subtracted its own error already"):
        Ingest().measure(corrected, IngestSettings(reference=read_map(surface)))


def test_a_reference_is_a_map_of_the_instruments_wavelength(surface: Path, tmp_path: Path) -> None:
    assert load_reference(str(surface), "", WAVELENGTH, 1e-9).file == str(surface)
    with pytest.raises(ValueError, match=r"wavelength 632.800 nm, must be 532.000 nm"):
        load_reference(str(surface), "", 532e-9, 1e-9)
    with pytest.raises(ValueError, match=r"reference_surface: .*missing.dat: No such file"):
        load_reference(str(tmp_path / "missing.dat"), "", 0.0, 1e-9)


def test_a_reference_that_does_not_tell_its_wavelength_is_believed_as_maps_are(surface: Path, tmp_path: Path) -> None:
    flat, content = tmp_path / "flat.fits", read_map(surface)
    flat.write_bytes(fits_bytes(dataclasses.replace(content, wavelength=0.0), "a test"))
    reference = load_reference(str(flat), "", WAVELENGTH, 1e-9)
    assert reference.wavelength == 0.0
    measured = Ingest().measure(content, IngestSettings(reference=reference, wavelength=WAVELENGTH))[1]
    np.testing.assert_allclose(measured.coefficients, 0.0, atol=1e-15)


def test_a_sphere_of_known_radius_gives_the_lateral_scale(surface: Path) -> None:
    """A file that is 0.3 % wrong about its pixels makes 9 nm of defocus at 0.05 1/m: none with the pitch found."""
    nominal, true = read_map(surface), 1.003 * PITCH
    rows, columns = np.mgrid[:SIZE, :SIZE]
    away = true * np.hypot(columns - 62, 57 - rows)

    def seen(curvature: float, settings: IngestSettings) -> Measurement:
        sag = np.where(nominal.valid, conic_sag(away, np.zeros_like(away), curvature), np.nan)
        return Ingest().measure(dataclasses.replace(nominal, sag=sag), settings)[1]

    sphere = seen(-1 / 1.5, IngestSettings())
    pitch, share = pitch_of_sphere(sphere.coefficients, sphere.radius_px, sphere.pitch, -1.5)
    assert pitch == pytest.approx(true, rel=2e-5) and share < 3e-5
    wrong, right = (seen(0.05, IngestSettings(pitch=each)) for each in (0.0, pitch))
    for seen_as, expected in ((wrong, 0.05 * 1.003**2), (right, 0.05)):
        found = curvature_of_defocus(seen_as.coefficients[DEFOCUS], seen_as.radius)
        assert found == pytest.approx(expected, rel=1e-4)
    for radius, text in (
        (1.5, "radius of curvature = 1.5 m: must have the sign of the map's defocus, -"),
        (-3.0, "not a sphere of -3 m"),
    ):
        with pytest.raises(ValueError, match=text):
            pitch_of_sphere(sphere.coefficients, sphere.radius_px, sphere.pitch, radius)
    with pytest.raises(
        MapRejectedError, match=r"pitch of the file = 200.000 um: must be 220.000 um within 5% .* another zoom"
    ):
        Ingest().read(surface, IngestSettings(pitch=1.1 * PITCH))


def test_orientation_turns_the_coefficients(surface: Path) -> None:
    def fitted(orientation: Orientation, x: float, y: float) -> np.ndarray:
        settings = IngestSettings(
            orientation=orientation, aperture_radius=55 * PITCH, aperture_centre=(x * PITCH, y * PITCH)
        )
        return Ingest().read(surface, settings)[1].coefficients

    mirrored = COEFFICIENTS.copy()
    mirrored[[1, 5]] *= -1  # x, 2xy ; the cosine of three times the angle turns over as well
    mirrored[8] *= -1
    expected = mirrored.copy()
    expected[9] = COEFFICIENTS[9]  # sin(3 theta) is even in x
    np.testing.assert_allclose(fitted(Orientation(flip_x=True), -2.5, 2.5), expected, atol=1e-15)
    turned = np.zeros(21)  # a quarter turn counter-clockwise: theta -> theta - 90 degrees
    turned[[0, 3]] = COEFFICIENTS[[0, 3]]
    turned[[1, 2]] = [-COEFFICIENTS[2], COEFFICIENTS[1]]
    turned[5] = -COEFFICIENTS[5]
    turned[8] = COEFFICIENTS[9]  # sin 3(theta - 90) = cos 3 theta
    np.testing.assert_allclose(fitted(Orientation(rotate_deg=90), -2.5, 2.5), turned, atol=1e-15)


def test_piston_and_tilt_go_from_the_map_only(surface: Path) -> None:
    settings = IngestSettings(aperture_radius=55 * PITCH, aperture_centre=(2.5 * PITCH, 2.5 * PITCH))
    surface_kept, kept = Ingest().read(surface, settings)
    surface_removed, removed = Ingest().read(surface, dataclasses.replace(settings, remove_piston_tilt=True))
    assert surface_removed.piston_tilt_removed
    np.testing.assert_array_equal(removed.coefficients, kept.coefficients)
    np.testing.assert_array_equal(removed.sag, kept.sag)
    bowl = COEFFICIENTS[[3, 5, 9]] * np.sqrt([1 / 3, 1 / 6, 1 / 8])
    assert surface_removed.rms == pytest.approx(np.sqrt((bowl**2).sum()), rel=0.01)
    assert surface_kept.rms == pytest.approx(np.sqrt((bowl**2).sum() + (1e-7**2 + 3e-7**2) / 4), rel=0.01)


def test_refusals_name_what_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "map.dat"
    path.write_bytes(dat_bytes(disc_counts(60), pitch=0.0))
    ingest = Ingest()
    with pytest.raises(MapRejectedError, match=r"wavelength = 632\.800 nm: must be 1064\.000 nm within 1 nm"):
        ingest.read(path, IngestSettings(wavelength=1064e-9))
    assert ingest.read(path, IngestSettings(wavelength=WAVELENGTH))[0].pitch is None
    with pytest.raises(MapRejectedError, match=r"aperture.radius = 0.011 m, but the file states no"):
        ingest.read(path, IngestSettings(aperture_radius=0.011))
    _, found = ingest.read(path, IngestSettings(aperture_radius=0.011, pitch=0.022 / 60))
    assert found.radius_px == pytest.approx(30)
    with pytest.raises(InsufficientDataError, match=r"valid fraction = 0\.\d+ of the aperture.*at least 0.7"):
        ingest.read(path, IngestSettings(aperture_radius=0.02, pitch=0.022 / 60))


def test_too_few_pixels_and_none(tmp_path: Path) -> None:
    counts = np.full((30, 30), NO_DATA)
    counts[10:14, 10:14] = 5
    path = tmp_path / "map.dat"
    path.write_bytes(dat_bytes(counts))
    with pytest.raises(InsufficientDataError, match=f"{path}: .*21 terms"):
        Ingest().read(path, IngestSettings())
    path.write_bytes(dat_bytes(np.full((30, 30), NO_DATA)))
    with pytest.raises(NoValidPixelsError):
        Ingest().read(path, IngestSettings())
    empty = SurfaceMap(np.full((30, 30), np.nan), WAVELENGTH, None, "array")
    with pytest.raises(InsufficientDataError, match="no valid pixel"):
        Ingest().measure(empty, IngestSettings(retrace=(1e-3,) * 36))


def test_one_ingest_serves_changing_masks(tmp_path: Path) -> None:
    ingest, path = Ingest(), tmp_path / "map.dat"
    for seed in (1, 2, 1):
        counts = disc_counts(50, seed=seed)
        counts[np.random.default_rng(seed).random(counts.shape) < 0.05] = NO_DATA
        path.write_bytes(dat_bytes(counts))
        (_, together), (_, alone) = ingest.read(path, IngestSettings()), Ingest().read(path, IngestSettings())
        np.testing.assert_array_equal(together.coefficients, alone.coefficients)
