"""Reader of `.datx` (HDF5) against files made by hand."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_calibration.map_files import MapFileError, NoValidPixelsError, datx, read_map
from map_fixtures import ATTRIBUTES_PATH, NO_DATA, ORACLE_MISSING, SURFACE_PATH, WAVELENGTH, disc_counts, write_datx

INVALID = 1.7976931348623157e308
FRINGES = np.array([[0.0, 0.25, INVALID], [-1.5, 2.0, 0.125]])
SAG = np.where(FRINGES < INVALID, FRINGES, np.nan)


def test_fringes_become_metres(tmp_path: Path) -> None:
    path = tmp_path / "a.datx"
    extra = {
        "Data Context.Data Attributes.System Serial Number": np.array([651012]),
        "Data Context.Data Attributes.Software Info Name": np.array([b"Mx"]),
        "Data Context.Data Attributes.Subtract System Error": np.array([1]),
        "Data Context.Data Attributes.Part Number": np.array([b"PDM30-37"]),
        "Data Context.Data Attributes.Time Stamp": np.array([1571391436]),
    }
    write_datx(path, FRINGES, attributes={"Obliquity Factor": np.array([1.1])}, extra=extra)
    found = read_map(path)
    np.testing.assert_allclose(found.sag, SAG * 1.1 * 0.5 * WAVELENGTH, rtol=1e-14)
    assert (found.format, found.wavelength, found.pitch) == ("datx", WAVELENGTH, 24e-6)
    assert (found.serial, found.instrument) == ("651012", "Mx")
    assert found.system_error_subtracted is True
    assert found.time_stamp == 1571391436


def test_missing_obliquity_means_one(tmp_path: Path) -> None:
    path = tmp_path / "a.datx"
    write_datx(path, FRINGES, attributes={"Obliquity Factor": None})
    np.testing.assert_allclose(read_map(path).sag, SAG * 0.5 * WAVELENGTH, rtol=1e-14)


@pytest.mark.parametrize(("unit", "metres"), [("NanoMeters", 1e-9), ("MicroMeters", 1e-6), ("Meters", 1.0)])
def test_lengths_are_not_scaled_again(tmp_path: Path, unit: str, metres: float) -> None:
    path = tmp_path / "a.datx"
    less = 1.0 if metres < 1.0 else 1e-6  # no map is higher than 1 mm
    values = np.where(FRINGES < INVALID, less * FRINGES, 3.2e38).astype("f4")
    write_datx(path, values, unit, attributes={"No Data": np.array([3.0e38])})
    np.testing.assert_allclose(read_map(path).sag, SAG * less * metres, rtol=1e-6)


def test_whole_numbers_have_no_value_for_no_data(tmp_path: Path) -> None:
    write_datx(tmp_path / "a.datx", np.array([[1, 2], [3, -4]], dtype="<i4"), "NanoMeters")
    np.testing.assert_allclose(read_map(tmp_path / "a.datx").sag, [[1e-9, 2e-9], [3e-9, -4e-9]])


@pytest.mark.slow
def test_an_independent_reader_agrees(tmp_path: Path) -> None:
    """The file made here is legal: a program that shares nothing with this suite reads the same heights."""
    topography = pytest.importorskip("SurfaceTopography", reason=ORACLE_MISSING)
    path = tmp_path / "a.datx"
    counts = disc_counts(64)
    values = np.where(counts < NO_DATA, 0.25 * counts, INVALID)
    converter = np.dtype([("Category", h5py.string_dtype()), ("BaseUnit", h5py.string_dtype()), ("P", "f8", (4,))])
    height = np.array([(b"HeightCat", b"NanoMeters", [0, WAVELENGTH, 0.5, 1.0])], dtype=converter)
    write_datx(path, values, "NanoMeters", attributes={"Z Converter": height})
    other = topography.read_topography(str(path), format="datx").to_unit("m").heights()
    np.testing.assert_allclose(read_map(path).sag, np.ma.filled(other.astype(float), np.nan).T, rtol=1e-12)


def test_pitch_from_the_attributes_when_the_converters_are_not_calibrated(tmp_path: Path) -> None:
    path = tmp_path / "a.datx"
    write_datx(path, FRINGES, pitch=0.0, extra={"Data Context.Lateral Resolution:Value": np.array([31e-6])})
    assert read_map(path).pitch == 31e-6
    write_datx(path, FRINGES, pitch=0.0)
    assert read_map(path).pitch is None
    assert read_map(path).system_error_subtracted is None


@pytest.mark.parametrize("word", ["True", "False"])
def test_system_error_as_a_word(tmp_path: Path, word: str) -> None:
    path = tmp_path / "a.datx"
    write_datx(path, FRINGES, extra={"Surface Data Context.Subtract System Error": np.array([word.encode()])})
    assert read_map(path).system_error_subtracted is (word == "True")


@pytest.mark.parametrize(
    ("unit", "attributes", "words"),
    [
        ("NoUnits", {}, "Unit = 'NoUnits'.*no height map"),
        ("Furlongs", {}, "Unit = 'Furlongs': must be Fringes or a length"),
        ("Fringes", {"Unit": None}, "the attribute 'Unit' is missing"),
        ("Fringes", {"No Data": None}, "the attribute 'No Data' is missing"),
        ("Fringes", {"Wavelength": None}, "the attribute 'Wavelength' is missing"),
        ("Fringes", {"Interferometric Scale Factor": None}, "'Interferometric Scale Factor' is missing"),
        ("Fringes", {"Wavelength": np.array([0.0])}, "wavelength = 0"),
        ("Fringes", {"Wavelength": np.array([np.nan])}, "wavelength = nan"),
        ("Fringes", {"Wavelength": np.array([1.0, 2.0])}, "must be one number"),
        ("Fringes", {"Obliquity Factor": np.array([0.0])}, "Obliquity Factor = 0"),
        ("Fringes", {"X Converter": np.array([5.0])}, "'X Converter': must hold"),
    ],
)
def test_what_cannot_be_understood_is_refused_by_name(
    tmp_path: Path, unit: str, attributes: dict[str, Any], words: str
) -> None:
    path = tmp_path / "bad.datx"
    write_datx(path, FRINGES, unit, attributes=attributes)
    with pytest.raises(MapFileError, match=words):
        read_map(path)


def test_pixels_that_are_not_square_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.datx"
    write_datx(path, FRINGES)
    with h5py.File(path, "r+") as file:
        attributes = file[SURFACE_PATH].attrs
        converter = attributes["Y Converter"]
        converter[0][2][1] = 30e-6
        attributes.modify("Y Converter", converter)
    with pytest.raises(MapFileError, match="must be square"):
        read_map(path)


def test_map_without_any_data_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.datx"
    write_datx(path, np.full((2, 3), INVALID))
    with pytest.raises(NoValidPixelsError):
        read_map(path)


@pytest.mark.parametrize("missing", ["MetaData", SURFACE_PATH, "Data"])
def test_missing_pieces_are_named(tmp_path: Path, missing: str) -> None:
    path = tmp_path / "a.datx"
    write_datx(path, FRINGES)
    with h5py.File(path, "r+") as file:
        del file[missing]
    with pytest.raises(MapFileError, match=f"{missing}.*missing"):
        read_map(path)


def test_missing_link_in_the_metadata_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.datx"
    write_datx(path, FRINGES)
    with h5py.File(path, "r+") as file:
        table = file["MetaData"][()]
        del file["MetaData"]
        file["MetaData"] = np.delete(table, 1)
    with pytest.raises(MapFileError, match=r"no link 'Surface' from '\{M\}'"):
        read_map(path)


def test_attributes_group_may_be_absent(tmp_path: Path) -> None:
    path = tmp_path / "a.datx"
    write_datx(path, FRINGES)
    with h5py.File(path, "r+") as file:
        del file[ATTRIBUTES_PATH]
    assert read_map(path).instrument == "Mx"


@pytest.mark.parametrize("kind", ["external link", "soft link", "external storage", "virtual"])
def test_nothing_outside_the_file_is_followed(tmp_path: Path, kind: str) -> None:
    other, path = tmp_path / "secret.datx", tmp_path / "a.datx"
    write_datx(other, FRINGES)
    write_datx(path, FRINGES)
    with h5py.File(path, "r+") as file:
        attributes = dict(file[SURFACE_PATH].attrs)
        del file[SURFACE_PATH]
        if kind == "external link":
            file[SURFACE_PATH] = h5py.ExternalLink(str(other), SURFACE_PATH)
        elif kind == "soft link":
            file[SURFACE_PATH] = h5py.SoftLink("/elsewhere")
        elif kind == "external storage":
            (tmp_path / "raw").write_bytes(FRINGES.tobytes())
            file.create_dataset(SURFACE_PATH, FRINGES.shape, "f8", external=[(str(tmp_path / "raw"), 0, 48)])
        else:
            layout = h5py.VirtualLayout(FRINGES.shape, "f8")
            layout[...] = h5py.VirtualSource(str(other), SURFACE_PATH, shape=FRINGES.shape)
            file.create_virtual_dataset(SURFACE_PATH, layout)
        if kind in ("external storage", "virtual"):
            for name, value in attributes.items():
                file[SURFACE_PATH].attrs[name] = value
    with pytest.raises(MapFileError, match="not followed"):
        read_map(path)


def with_filter(path: Path, identifier: int) -> None:
    """Store the surface through an HDF5 filter of this number, whether or not the library knows it."""
    write_datx(path, FRINGES)
    with h5py.File(path, "r+") as file:
        attributes = dict(file[SURFACE_PATH].attrs)
        del file[SURFACE_PATH]
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk(FRINGES.shape)
        properties.set_filter(identifier, h5py.h5z.FLAG_OPTIONAL, ())
        space = h5py.h5s.create_simple(FRINGES.shape)
        dataset = h5py.h5d.create(file.id, SURFACE_PATH.encode(), h5py.h5t.IEEE_F64LE, space, properties)
        dataset.write_direct_chunk((0, 0), FRINGES.tobytes(), 0)
        for name, value in attributes.items():
            file[SURFACE_PATH].attrs[name] = value


def test_unknown_compression_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.datx"
    with_filter(path, 32099)  # a number nobody has registered
    assert not h5py.h5z.filter_avail(32099)
    with pytest.raises(MapFileError, match="HDF5 filter number 32099, which this h5py lacks"):
        read_map(path)


def test_szip_is_read_where_the_library_has_it_and_named_where_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.datx"
    if h5py.h5z.filter_avail(h5py.h5z.FILTER_SZIP):
        write_datx(path, np.tile(FRINGES, (8, 8)), compression="szip")
        assert np.isfinite(read_map(path).sag).any()
        # The same file on a machine whose HDF5 was built without Szip.
        available = h5py.h5z.filter_avail
        monkeypatch.setattr(
            datx.h5py.h5z, "filter_avail", lambda number: number != h5py.h5z.FILTER_SZIP and available(number)
        )
    else:
        with_filter(path, h5py.h5z.FILTER_SZIP)
    with pytest.raises(MapFileError, match=r"filter Szip, which this h5py lacks.*save the map uncompressed"):
        datx.parse_datx(path.read_bytes())


def test_compressed_file_that_promises_a_huge_map_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.datx"
    write_datx(path, FRINGES)
    with h5py.File(path, "r+") as file:
        attributes = dict(file[SURFACE_PATH].attrs)
        del file[SURFACE_PATH]
        surface = file.create_dataset(SURFACE_PATH, (10**6, 10**6), "f8", chunks=(100, 100))
        for name, value in attributes.items():
            surface.attrs[name] = value
    with pytest.raises(MapFileError, match="must be at most"):
        read_map(path)


def test_tables_that_are_no_maps_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.datx"
    write_datx(path, np.zeros((2, 2, 2)))
    with pytest.raises(MapFileError, match="two-dimensional"):
        read_map(path)
    with h5py.File(tmp_path / "other.datx", "w") as file:
        file["MetaData"] = 5
    with pytest.raises(MapFileError, match="/MetaData: must be a table"):
        read_map(tmp_path / "other.datx")


@settings(max_examples=60, deadline=None)
@given(
    changes=st.lists(st.tuples(st.integers(8, 100_000), st.integers(0, 255)), min_size=1, max_size=8),
    keep=st.floats(0.01, 1.0),
)
def test_damaged_files_raise_nothing_but_the_one_error(
    tmp_path_factory: pytest.TempPathFactory, changes: list[tuple[int, int]], keep: float
) -> None:
    whole = tmp_path_factory.getbasetemp() / "whole.datx"
    if not whole.exists():
        write_datx(whole, FRINGES)
    content = bytearray(whole.read_bytes())
    for position, value in changes:
        struct.pack_into("B", content, 8 + position % (len(content) - 8), value)
    path = tmp_path_factory.getbasetemp() / "damaged.datx"
    path.write_bytes(content[: max(int(keep * len(content)), 8)])
    try:
        found = read_map(path)
    except MapFileError:
        return
    assert found.sag.size < 10**6
