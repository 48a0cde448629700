"""Maps of a simulated instrument with errors of its own, found by `./dm instrument` and taken off."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.interferometer_parameters import load_reference
from dm_calibration.map_files import SurfaceMap
from dm_calibration.map_files.fits import fits_bytes
from dm_calibration.optics.orientation import Orientation
from dm_common.optics.zernike import PISTON_TILT
from dm_simulation.bench import BenchConfig, FilesConfig, VirtualBench
from dm_simulation.electronics.server import OFF, PortsConfig
from dm_simulation.interferometer.interferometer import InterferometerConfig
from dm_tools.cli import make_app
from dm_tools.verbs.instrument import _table
from simulated_instrument import FIELD, PIXELS, SETTINGS, run


@contextmanager
def bench(folder: Path, **instrument: Any) -> Iterator[VirtualBench]:
    config = BenchConfig(
        seed=3,
        interferometer=InterferometerConfig(pixels=PIXELS, field_diameter=FIELD, **instrument),
        ports=PortsConfig(OFF, OFF, OFF),
        files=FilesConfig(folder, format="dat"),
        trigger_port=OFF,
    )
    running = VirtualBench(config)
    try:
        yield running
    finally:
        running.close()


def error(file: Path, truth: NDArray[np.float64], settings: IngestSettings) -> float:
    """Largest error of a coefficient beyond tilt, m."""
    ingest, plain = Ingest(), replace(SETTINGS, orientation=settings.orientation)
    wanted = ingest.measure(SurfaceMap(truth, 632.8e-9, None, "array"), plain)[1]
    found = ingest.read(file, settings)[1]
    return float(np.abs(found.coefficients - wanted.coefficients)[PISTON_TILT:].max())


@pytest.mark.parametrize("turned", [{}, {"rotate_deg": 90, "flip_x": True}])
def test_results_are_absolute_with_the_reference_that_the_bench_leaves(turned: dict[str, Any], tmp_path: Path) -> None:
    with bench(tmp_path, instrument_error=30e-9, **turned) as simulated:
        file, truth = simulated.measure(), simulated.interferometer.true_sag(simulated.displacement())
    settings = replace(SETTINGS, orientation=Orientation(rotate_deg=90.0))
    reference = load_reference(str(tmp_path / "reference" / "flat.datx"), "", 0.0, 0.0)
    assert error(file, truth, replace(settings, reference=reference)) < 1e-9 < 8e-9 < error(file, truth, settings)


@pytest.mark.slow
def test_retrace_error_from_the_tilts_that_maps_happen_to_have(tmp_path: Path) -> None:
    with bench(tmp_path, retrace=0.01, tilt_spread=2e-6) as simulated:
        files = [simulated.measure() for _ in range(13)]
        truth = simulated.interferometer.true_sag(simulated.displacement())
    found = run("retrace", *files[:-1])
    settings = replace(SETTINGS, retrace=tuple(found["retrace"]))
    # What is left is the tilt of the figure itself, which all maps share.
    assert error(files[-1], truth, settings) < 1.5e-9 < 6e-9 < error(files[-1], truth, SETTINGS)


def test_regions_that_stand_off_by_whole_fringes_are_brought_back(tmp_path: Path) -> None:
    with bench(tmp_path, phase_steps=3.0) as simulated:
        files = [simulated.measure() for _ in range(4)]
        truth = simulated.interferometer.true_sag(simulated.displacement())
    assert all(error(file, truth, SETTINGS) < 1.5e-9 for file in files)
    assert sum(Ingest().read(file, SETTINGS)[0].phase_steps for file in files) > 6


@pytest.mark.slow
def test_ripples_by_vibration_average_out(tmp_path: Path) -> None:
    with bench(tmp_path, vibration=10e-9, tilt_spread=0.0) as simulated:
        files = [simulated.measure() for _ in range(32)]
        truth = simulated.interferometer.true_sag(simulated.displacement())
    ingest = Ingest()
    wanted = ingest.measure(SurfaceMap(truth, 632.8e-9, None, "array"), SETTINGS)[1].coefficients
    apart = np.array([ingest.read(file, SETTINGS)[1].coefficients - wanted for file in files])[:, PISTON_TILT:]
    single = np.sqrt(np.square(apart).mean(axis=0)).max()
    assert np.abs(apart.mean(axis=0)).max() < 0.2 * single and single > 5e-9


def test_distortion_from_a_grid_of_marks(tmp_path: Path) -> None:
    distortion = 0.004
    quiet = {"pixel_noise": 0.0, "low_order_noise": 0.0, "specks": 0, "blobs": 0}
    with bench(tmp_path, distortion=distortion, figure_rms=300e-9, **quiet) as simulated:
        file, truth = simulated.measure(), simulated.interferometer.true_sag(simulated.displacement())
    table = tmp_path / "grid.csv"
    true = [complex(x, y) / 5 for x in range(-4, 5) for y in range(-4, 5)]
    rows = ["column, row, x, y"]
    for place in true:
        seen = place * (1.0 + distortion * abs(place) ** 2) * PIXELS / 2
        middle, metres = 0.5 * (PIXELS - 1), place * FIELD / 2
        rows.append(f"{middle + seen.real:.2f}, {middle - seen.imag:.2f}, {metres.real:.6f}, {metres.imag:.6f}")
    table.write_text("\n".join(rows))
    found = run("grid", table, file)
    assert found["pitch"] == pytest.approx(FIELD / PIXELS, rel=2e-4)
    settings = replace(SETTINGS, distortion=found["distortion"])
    assert error(file, truth, settings) < 0.3e-9 < 1e-9 < error(file, truth, SETTINGS)


@pytest.mark.slow
def test_the_reference_that_flats_give_is_one_that_the_interferometer_takes(tmp_path: Path) -> None:
    with bench(tmp_path, instrument_error=30e-9) as simulated:
        rows = ["file,reference,part,degrees", *(f"{simulated.measure()},A,B," for _ in range(2))]
        file = simulated.measure()
    # The bench cannot turn its mirror: a table that turns nothing is refused, one that says it was turned is believed.
    table, target = tmp_path / "flats.csv", tmp_path / "flat.fits"
    table.write_text("\n".join(rows))
    assert "do not distinguish the flats" in refused("flats", table, "--write", target)
    table.write_text("\n".join([*rows[:2], rows[2] + "77"]))
    for read in (table, rows[1].partition(",")[0]):
        assert "is one of the files to read" in refused("flats", table, "--write", read)
    target.write_text("of before")
    assert run("flats", table, "--write", target)["reference_surface"] == str(target)
    assert (tmp_path / "flat.fits.before").read_text() == "of before"
    reference = load_reference(str(target), "", 632.8e-9, 1e-12)
    assert Ingest().read(file, replace(SETTINGS, reference=reference))[1].reference_surface.startswith("flat.fits, SHA")


def test_tables_with_gaps_and_files_too_many_are_refused(tmp_path: Path) -> None:
    table = tmp_path / "grid.csv"
    table.write_text("\ufeffcolumn, row, x, y\n1, 2, 0.1, 0.2\n\n3, 4, 0.3\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"grid\.csv: row 2 below the headings has no y"):
        _table(table, "column", "row", "x", "y")
    table.write_text("file, reference, part, degrees\na.dat, A, B,\na.dat, A, B, 3O\n")
    with pytest.raises(ValueError, match="row 2 below the headings: degrees = '3O': must be a number"):
        _table(table, "file", "degrees")
    table.write_text("file, reference, part\na.dat, A, B\n")
    with pytest.raises(ValueError, match="has no column row"):
        _table(table, "file", "row")
    assert _table(table, "file", "reference", "part", "degrees") == [["a.dat", "A", "B", "0"]]
    for content in (b"\x88\x1b\x03\x6f", b"a" * 200_000):
        (tmp_path / "map.dat").write_bytes(content)
        with pytest.raises(ValueError, match=r"map\.dat: must be a table"):
            _table(tmp_path / "map.dat", "column")
    for files in ((table, table, "--write", tmp_path / "flat.fits"), (table,)):
        wrong = CliRunner().invoke(make_app(), ["instrument", "flats" if files[1:] else "grid", *map(str, files)])
        assert wrong.exit_code == 2 and f"{len(files[:2])} files: must be" in " ".join(wrong.output.split())


def test_numbers_that_are_found_are_numbers_in_a_parameter_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a point, 5e-09 is a text in YAML."""
    found = np.array([5e-9, 0.25, *np.zeros(34)])
    monkeypatch.setattr("dm_calibration.optics.instrument.find_retrace", lambda _maps: (found, 0.0, 0.0))
    file = tmp_path / "flat.fits"
    file.write_bytes(fits_bytes(SurfaceMap(np.zeros((20, 20)), 632.8e-9, None, "array"), "a test"))
    assert run("retrace", file)["retrace"] == found.tolist()


@pytest.mark.parametrize(("x", "y"), [(0.41e-3, -0.73e-3), (-1.5e-3, 0.2e-3)])
def test_an_aperture_that_follows_the_mirror_is_registered_to_a_tenth_of_a_pixel(
    x: float, y: float, tmp_path: Path
) -> None:
    with bench(tmp_path, mask_diameter=0.0185, mount_x=x, mount_y=y) as simulated:
        file = simulated.measure()
    settings = replace(SETTINGS, aperture_radius=0.0088, aperture_follow=True)
    column, row = Ingest().read(file, settings)[1].centre
    pitch, middle = FIELD / PIXELS, 0.5 * (PIXELS - 1)
    assert (column, row) == pytest.approx((middle + x / pitch, middle - y / pitch), abs=0.1)


def save(path: Path, sag: NDArray[np.float64], **others: Any) -> Path:
    facts: dict[str, Any] = {"wavelength": 632.8e-9, "pitch": FIELD / PIXELS, "format": "array"} | others
    path.write_bytes(fits_bytes(SurfaceMap(sag, **facts), "test"))
    return path


def refused(*words: object) -> str:
    """What is said of files that do not serve: the usage is right, so the exit status is not 2."""
    done = CliRunner().invoke(make_app(), ["instrument", *map(str, words)])
    assert done.exit_code == 1
    return str(done.exception)


@pytest.mark.parametrize(
    ("other", "text"), [({"wavelength": 532e-9}, "wavelength 532.000 nm"), ({"pitch": 3e-4}, "pitch 300.000 um")]
)
def test_flats_of_another_setting_are_not_mixed(other: dict[str, float], text: str, tmp_path: Path) -> None:
    sag, rows = np.zeros((120, 120)), ["file, reference, part, degrees"]
    for turn in (0, 37, 80):
        name = save(tmp_path / f"{turn}.fits", sag, **(other if turn else {})).name
        rows.append(f"{name}, A, B, {turn}")
    table = tmp_path / "flats.csv"
    table.write_text("\n".join(rows))
    assert text in refused("flats", table, "--write", tmp_path / "flat.fits")
    assert not (tmp_path / "flat.fits").exists()


def test_a_decimal_comma_is_not_the_end_of_an_angle(tmp_path: Path) -> None:
    table = tmp_path / "flats.csv"
    table.write_text("file, reference, part, degrees\nturned.fits, A, B, 37,5\n")
    assert "row 1 below the headings has more values than headings" in refused("flats", table, "--write", "f")


def test_flats_that_leave_only_high_orders_open_bound_the_coefficients(tmp_path: Path) -> None:
    """Headings in columns, as an editor aligns them, are headings too."""
    y, x = (np.mgrid[:120, :120] - 59.5) / 60.0
    noise, rows = np.random.default_rng(2), ["file , reference , part , degrees"]
    for number, row in enumerate(("A, B,", "A, B, 37", "A, C,", "B, C,")):
        sag = np.where(np.hypot(x, y) < 0.97, noise.normal(0.0, 1e-9, x.shape), np.nan)
        rows.append(f"{save(tmp_path / f'{number}.fits', sag).name}, {row}")
    table = tmp_path / "flats.csv"
    table.write_text("\n".join(rows))
    found = run("flats", table, "--write", tmp_path / "flat.fits")
    assert 0.0 < found["instrument_error"] < 1e-9  # orders 9 and 10 are open, which no coefficient is of


def test_marks_in_millimetres_are_not_taken_for_metres(tmp_path: Path) -> None:
    surface = save(tmp_path / "any.fits", np.zeros((PIXELS, PIXELS)))
    table = tmp_path / "marks.csv"
    millimetres = 1e3 * FIELD / PIXELS
    places = [(column, row) for column in (9, 30, 50) for row in (8, 30, 50)]
    rows = [f"{column},{row},{column * millimetres},{row * millimetres}" for column, row in places]
    table.write_text("\n".join(["column,row,x,y", *rows]))
    assert "x and y must be in m" in refused("grid", table, surface)
    unknown = save(tmp_path / "other.fits", np.zeros((PIXELS, PIXELS)), pitch=None)
    assert "m per pixel: x and y must be in m" in refused("grid", table, unknown)
