"""Readers of `.dat`, `.asc` and `.xyz` against files made byte by byte from the description of the formats."""

from __future__ import annotations

import hashlib
import math
import os
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_calibration.map_files import MapFileError, NoValidPixelsError, read_map
from map_fixtures import NO_DATA, ORACLE_MISSING, asc_bytes, dat_bytes, disc_counts, fits_bytes, text_header, xyz_bytes

UNSEALED = fits_bytes(np.arange(6.0).reshape(2, 3), checksum=False)
COUNTS = np.array([[0, 1000, -2000], [NO_DATA, 123456, 2**31 - 1]])
W32 = struct.unpack(">f", struct.pack(">f", 632.8e-9))[0]  # as a 32-bit file stores it


def write(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def heights(per_count: float) -> Any:
    return np.where(COUNTS < NO_DATA, COUNTS * per_count, np.nan)


@pytest.mark.parametrize(("code", "counts_per_fringe"), [(0, 4096), (1, 32768), (2, 131072)])
@pytest.mark.parametrize("sign", [0, 1])
def test_dat_heights_and_facts(tmp_path: Path, code: int, counts_per_fringe: int, sign: int) -> None:
    content = dat_bytes(COUNTS, resolution=code, sign=sign, O=1.25)
    found = read_map(write(tmp_path, "a.dat", content))
    np.testing.assert_allclose(found.sag, heights((-1) ** sign * 0.5 * 1.25 * W32 / counts_per_fringe), rtol=1e-14)
    assert found.sag.dtype == np.float64
    assert found.wavelength == W32
    assert found.pitch == pytest.approx(24e-6, rel=1e-7)
    assert found.origin == (12, 34)
    assert (found.format, found.serial) == ("dat", "62398")
    assert found.instrument == "MetroPro, system type 4"
    assert found.time_stamp == 1429905292
    assert found.system_error_subtracted is False
    assert found.sha256 == hashlib.sha256(content).hexdigest()
    assert found.file == str(tmp_path / "a.dat")


@pytest.mark.parametrize(("magic", "form", "size"), [(0x881B0370, 2, 834), (0x881B0371, 3, 4096)])
def test_dat_of_every_header_with_intensity_before_the_phase(tmp_path: Path, magic: int, form: int, size: int) -> None:
    intensity = np.arange(2 * 4 * 5).reshape(2, 4, 5)
    content = dat_bytes(COUNTS, intensity, magic=magic, format=form, header_size=size)
    np.testing.assert_array_equal(read_map(write(tmp_path, "b.dat", content)).sag, heights(0.5 * W32 / 32768))


def test_format_is_found_from_the_content(tmp_path: Path) -> None:
    assert read_map(write(tmp_path, "map.bin", dat_bytes(COUNTS))).format == "dat"
    assert read_map(write(tmp_path, "map.dat", asc_bytes(COUNTS))).format == "asc"


def test_pitch_zero_is_unknown_and_other_codes_are_not_told(tmp_path: Path) -> None:
    found = read_map(write(tmp_path, "c.dat", dat_bytes(COUNTS, pitch=0.0, subtracted=1, time=0, serial=0)))
    assert found.pitch is None
    assert found.system_error_subtracted is True
    assert found.time_stamp is None
    assert found.serial == ""
    assert read_map(write(tmp_path, "d.dat", dat_bytes(COUNTS, subtracted=7))).system_error_subtracted is None


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"magic": 0x881B0372}, "not a ZYGO"),
        ({"format": 2}, "format = 2"),
        ({"header_size": 4096}, "header size = 4096"),
        ({"W": 0.0}, "wavelength = 0"),
        ({"W": math.nan}, "wavelength = nan"),
        ({"W": 632.8}, "wavelength = 632.8"),
        ({"O": 0.0}, "obliquity factor = 0"),
        ({"O": math.nan}, "obliquity factor = nan"),
        ({"S": 0.0}, "scale factor = 0"),
        ({"S": math.inf}, "scale factor = inf"),
        ({"resolution": 3}, "phase resolution code = 3"),
        ({"sign": 2}, "data sign = 2"),
        ({"pitch": math.nan}, "lateral resolution = nan"),
        ({"pitch": -1e-5}, "lateral resolution = -1e-05"),
    ],
)
def test_dat_with_a_meaningless_field_is_refused_by_name(tmp_path: Path, fields: dict[str, Any], words: str) -> None:
    with pytest.raises(MapFileError, match=words) as caught:
        read_map(write(tmp_path, "bad.dat", dat_bytes(COUNTS, **fields)))
    assert str(tmp_path / "bad.dat") in str(caught.value)


@pytest.mark.parametrize("writer", [dat_bytes, asc_bytes])
def test_a_height_that_no_mirror_has_is_refused(tmp_path: Path, writer: Any) -> None:
    """A single bit of a damaged file makes a spike of centimetres, as in the formats whose heights are in m."""
    with pytest.raises(MapFileError, match=r"height = 0 to 0\.0207255 m: must be -0\.001 to 0\.001 m"):
        read_map(write(tmp_path, "spike", writer(np.array([[0, 0], [0, 0x7FF00000]]))))


@pytest.mark.parametrize("change", [-1, -4, 1, 4])
def test_dat_of_another_length_is_refused(tmp_path: Path, change: int) -> None:
    content = dat_bytes(COUNTS)
    content = content[:change] if change < 0 else content + bytes(change)
    with pytest.raises(MapFileError, match=f"file length = {len(content)} bytes: must be {834 + 24}"):
        read_map(write(tmp_path, "e.dat", content))


def test_dat_without_phase_data_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match="0 x 0 pixels"):
        read_map(write(tmp_path, "g.dat", dat_bytes(np.empty((0, 0), dtype=int))))


def test_header_that_promises_a_huge_map_is_refused_before_reading(tmp_path: Path) -> None:
    content = bytearray(dat_bytes(COUNTS))
    struct.pack_into(">HH", content, 68, 65535, 65535)
    path = tmp_path / "h.dat"
    path.write_bytes(content)
    os.truncate(path, 834 + 4 * 65535**2)  # sparse: the length agrees, the disk stays empty
    with pytest.raises(MapFileError, match="must be at most"):
        read_map(path)


@pytest.mark.parametrize("writer", [dat_bytes, asc_bytes])
def test_map_without_any_data_is_refused(tmp_path: Path, writer: Any) -> None:
    with pytest.raises(NoValidPixelsError, match="none of the 3 x 2 pixels"):
        read_map(write(tmp_path, "i.dat", writer(np.full((2, 3), NO_DATA))))


def test_what_is_no_regular_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.dat")
    with pytest.raises(MapFileError, match="not a regular file"):
        read_map(tmp_path / "pipe.dat")
    with pytest.raises(MapFileError, match="Is a directory"):
        read_map(tmp_path)
    with pytest.raises(MapFileError, match=r"absent\.dat: No such file"):
        read_map(tmp_path / "absent.dat")


@pytest.mark.parametrize("intensity", [(), None])
def test_asc_heights_and_facts(tmp_path: Path, intensity: Any) -> None:
    found = read_map(write(tmp_path, "a.asc", asc_bytes(COUNTS, intensity, sign=1, resolution=2, subtracted=1)))
    np.testing.assert_allclose(found.sag, heights(-0.5 * 632.8e-9 / 131072), rtol=1e-14)
    assert (found.wavelength, found.pitch, found.origin) == (632.8e-9, 24e-6, (12, 34))
    assert (found.format, found.serial, found.time_stamp) == ("asc", "651012", 1571391436)
    assert found.system_error_subtracted is True


def test_asc_skips_its_intensity_and_takes_any_line_ends(tmp_path: Path) -> None:
    content = asc_bytes(COUNTS, [1, 2, 3, 4], intensity_line="0 0 2 1 2 255").replace(b"\n", b"\r\n")
    np.testing.assert_allclose(
        read_map(write(tmp_path, "b.asc", content)).sag, heights(0.5 * 632.8e-9 / 32768), rtol=1e-14
    )


def test_asc_header_texts_may_be_damaged(tmp_path: Path) -> None:
    content = asc_bytes(COUNTS, comment='"half a # quote \xe4')
    assert read_map(write(tmp_path, "c.asc", content)).sag.shape == (2, 3)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (asc_bytes(COUNTS)[:-3], "do not end with '#'"),
        (asc_bytes(COUNTS)[:200], "header"),
        (asc_bytes(COUNTS).replace(b"123456", b"12x456"), "phase data"),
        (asc_bytes(COUNTS).replace(b"123456", b""), "5 values, must be 6"),
        (asc_bytes(COUNTS).replace(b"123456", b"1" * 99), "more than 40 characters"),
        (asc_bytes(COUNTS, intensity_line="0 0 9 9 1 255"), "intensity data: .* must be 81|cannot hold 81"),
        (asc_bytes(COUNTS, None, intensity_line="0 0 2 1 2 255"), "must be intensity and phase"),
        (asc_bytes(COUNTS, W="red"), "wavelength: no number at position 3 of header line 8"),
        (asc_bytes(COUNTS, resolution=1.5), "must be an integer"),
        (asc_bytes(COUNTS, W=0), "wavelength = 0"),
        (text_header(60000, 500).encode() + b"#\n1 2 3\n#\n", "cannot hold"),
    ],
)
def test_asc_that_is_not_whole_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    with pytest.raises(MapFileError, match=words):
        read_map(write(tmp_path, "bad.asc", content))


def test_a_text_of_more_numbers_than_pixels_is_refused_before_all_are_taken_apart(tmp_path: Path) -> None:
    content = text_header(1, 1).encode() + b"#\n" + 300_000 * b"11 " + b"#\n"
    path = write(tmp_path, "long.asc", content)
    tracemalloc.start()
    try:
        with pytest.raises(MapFileError, match="more than 1 values, must be 1"):
            read_map(path)
        assert tracemalloc.get_traced_memory()[1] < 8 * len(content)
    finally:
        tracemalloc.stop()


XYZ = np.array([[0.5, -0.25, np.nan], [0.0, 1.5, 2.0]])


@pytest.mark.parametrize(
    ("unit", "metres"), [("m", 1), ("mm", 1e-3), ("um", 1e-6), ("nm", 1e-9), ("angstrom", 1e-10), ("waves", 632.8e-9)]
)
def test_xyz_heights(tmp_path: Path, unit: str, metres: float) -> None:
    heights = XYZ if metres < 1e-3 else 1e-3 / metres * 0.5 * XYZ  # at most 1 mm
    found = read_map(write(tmp_path, "a.xyz", xyz_bytes(heights)), xyz_unit=unit)
    np.testing.assert_allclose(found.sag, heights * metres, rtol=1e-14)
    assert (found.format, found.pitch, found.wavelength) == ("xyz", 24e-6, 632.8e-9)


def test_xyz_needs_its_unit(tmp_path: Path) -> None:
    path = write(tmp_path, "a.xyz", xyz_bytes(XYZ))
    with pytest.raises(MapFileError, match="xyz_unit = not given"):
        read_map(path)
    with pytest.raises(MapFileError, match=r"xyz_unit = 'inch'.* nm"):
        read_map(path, xyz_unit="inch")


def test_xyz_with_the_title_of_the_other_text_format_is_known_by_its_suffix(tmp_path: Path) -> None:
    path = write(tmp_path, "a.xyz", xyz_bytes(XYZ, title="Zygo ASCII Data File - Format 2"))
    np.testing.assert_allclose(read_map(path, xyz_unit="um").sag, 1e-6 * XYZ)


def test_xyz_may_count_pixels_from_its_own_corner_and_in_any_order(tmp_path: Path) -> None:
    header = text_header(3, 2, "Zygo XYZ Data File - Format 1")
    lines = [f"{column} {row} {XYZ[row, column]}".replace("nan", "No Data") for column in range(3) for row in range(2)]
    path = write(tmp_path, "a.xyz", (header + "\n".join(lines) + "\n").encode())
    np.testing.assert_allclose(read_map(path, xyz_unit="um").sag, 1e-6 * XYZ)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ((b"12 34 0.5\n", b""), "15 values, must be 18"),
        ((b"12 34 0.5\n", b"13 34 0.5\n"), "some pixel is missing"),
        ((b"12 34 0.5\n", b"11 34 0.5\n"), "column numbers 11 to 14: must be integers from 12 to 14"),
        ((b"12 34 0.5\n", b"12.5 34 0.5\n"), "column numbers"),
        ((b"12 34 0.5\n", b"12 34 high\n"), "data lines"),
        ((b"2.0\n#\n", b"2."), "not ended"),
    ],
)
def test_xyz_that_is_not_whole_is_refused(tmp_path: Path, change: tuple[bytes, bytes], words: str) -> None:
    content = xyz_bytes(XYZ)
    assert change[0] in content
    with pytest.raises(MapFileError, match=words):
        read_map(write(tmp_path, "bad.xyz", content.replace(*change)), xyz_unit="um")


@settings(max_examples=150, deadline=None)
@given(
    which=st.sampled_from([dat_bytes(COUNTS), asc_bytes(COUNTS), xyz_bytes(XYZ), UNSEALED]),
    changes=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=6),
    cut=st.integers(0, 10_000),
)
def test_damaged_files_raise_nothing_but_the_one_error(
    tmp_path_factory: pytest.TempPathFactory, which: bytes, changes: list[tuple[int, int]], cut: int
) -> None:
    content = bytearray(which)
    for position, value in changes:
        content[position % len(content)] = value
    if cut < len(content):
        del content[cut:]
    path = write(tmp_path_factory.getbasetemp(), "damaged", bytes(content))
    try:
        found = read_map(path, xyz_unit="nm")
    except MapFileError:
        return
    assert np.isfinite(found.sag).any()
    assert found.sag.size * 2 <= len(content)


#: Maps as instruments make them, by name: counts, further arguments of the writer, share of pixels without data.
INSTRUMENTS: dict[str, tuple[Any, dict[str, Any], float]] = {
    # A large-aperture Fizeau: header of 834 bytes, an intensity frame of the whole camera before the phase.
    "fizeau": (
        np.pad(disc_counts(400, 34000), 10, constant_values=NO_DATA),
        {"intensity": np.full((1, 480, 640), 200), "pitch": 117.9e-6, "origin_x": 116, "origin_y": 30},
        0.288,
    ),
    # What newer programs write: header of 4096 bytes, two buckets of intensity, the finest resolution, sign inverted.
    "new program": (
        disc_counts(201, 120000),
        {
            "intensity": np.full((2, 240, 256), 9),
            "magic": 0x881B0371,
            "format": 3,
            "header_size": 4096,
            "resolution": 2,
            "sign": 1,
        },
        0.214,
    ),
    # A microscope: every pixel holds data, and the obliquity factor of its objective counts.
    "microscope": (disc_counts(96, 700).clip(max=5000), {"pitch": 1.098e-6, "O": 1.04}, 0.0),
}


def true_sag(name: str) -> Any:
    """Sag (m) of one of INSTRUMENTS: counts S O W / R, worked out here from the format's description."""
    counts, fields, _ = INSTRUMENTS[name]
    fringe = {0: 4096, 1: 32768, 2: 131072}[fields.get("resolution", 1)]
    scale = struct.unpack(">f", struct.pack(">f", fields.get("O", 1.0)))[0]
    sign = -1 if fields.get("sign") else 1
    return np.where(counts < NO_DATA, sign * counts * 0.5 * scale * W32 / fringe, np.nan)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_maps_of_instruments(tmp_path: Path, name: str) -> None:
    counts, fields, invalid = INSTRUMENTS[name]
    found = read_map(write(tmp_path, "map.dat", dat_bytes(counts, **fields)))
    np.testing.assert_allclose(found.sag, true_sag(name), rtol=1e-14)
    assert 1 - found.valid.mean() == pytest.approx(invalid, abs=6e-4)
    assert found.pitch == pytest.approx(fields.get("pitch", 24e-6), rel=1e-6)


def test_both_formats_of_one_measurement_hold_the_same_counts(tmp_path: Path) -> None:
    counts = INSTRUMENTS["fizeau"][0]
    binary = read_map(write(tmp_path, "map.dat", dat_bytes(counts, pitch=0.0)))
    text = read_map(write(tmp_path, "map.asc", asc_bytes(counts, None, pitch=0)))
    found = [np.rint(one.sag / (0.5 * one.wavelength / 32768)) for one in (binary, text)]
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], np.where(counts < NO_DATA, counts, np.nan))
    assert binary.pitch is text.pitch is None
    assert binary.origin == text.origin


@pytest.mark.slow
@pytest.mark.parametrize("name", INSTRUMENTS)
def test_an_independent_reader_agrees(tmp_path: Path, name: str) -> None:
    """The files made here are legal: a program that shares nothing with this suite reads the same heights."""
    topography = pytest.importorskip("SurfaceTopography", reason=ORACLE_MISSING)
    counts, fields, _ = INSTRUMENTS[name]
    path = write(tmp_path, "map.dat", dat_bytes(counts, **fields))
    other = topography.read_topography(str(path)).to_unit("m").heights()
    np.testing.assert_allclose(read_map(path).sag, np.ma.filled(other.astype(float), np.nan).T, rtol=1e-6)
