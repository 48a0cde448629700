"""What every reader owes; those of FITS files and of 4Sight's against files made from their description."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.map_files import MapFileError, read_map
from map_fixtures import NO_DATA, asc_bytes, dat_bytes, datx_bytes, fits_bytes, four_d_bytes, h5_bytes, xyz_bytes

#: (height, width) sag in nm, NaN = no data, no two rows alike.
SAG = np.where(np.hypot(*np.mgrid[-1:1:12j, -1:1:14j]) > 1.1, np.nan, 90.0 + np.arange(168.0).reshape(12, 14))


#: The same in counts of the ZYGO formats.
COUNTS = np.where(np.isfinite(SAG), np.rint(np.nan_to_num(SAG) * 32768 / (0.5 * 632.8)), NO_DATA).astype(int)


def write(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.fits", fits_bytes(SAG)),
        ("b.fits", fits_bytes(SAG.astype("f4"))),
        (
            "c.fits",
            fits_bytes(1e-9 * SAG, BUNIT="m", PUPLSCAL=None, CDELT1=-0.024, CUNIT1="mm", CDELT2=24.0, CUNIT2="um"),
        ),
        (
            "d.fits",
            fits_bytes(np.where(np.isfinite(SAG), 2 * SAG, -7).astype("i2"), BLANK=-7, BSCALE=0.5, BUNIT="Nanometer"),
        ),
        ("e.fits", fits_bytes(SAG, BUNIT=None)),
        ("f.h5", h5_bytes(SAG / 632.8)),
        ("g.4D", four_d_bytes(SAG / 632.8)),
        ("h.dat", dat_bytes(COUNTS)),
        ("i.asc", asc_bytes(COUNTS)),
        ("j.xyz", xyz_bytes(SAG)),
        ("k.datx", datx_bytes(SAG, "NanoMeters")),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_maps_of_all_makers(tmp_path: Path, name: str, content: bytes) -> None:
    """What every format owes: m of sag, row 0 = top, NaN = no data, wavelength, pitch; and no half file is a map."""
    found = read_map(write(tmp_path, name, content), xyz_unit="nm")
    np.testing.assert_allclose(found.sag, 1e-9 * SAG, rtol=1e-6, atol=5e-12)
    assert found.format == name.partition(".")[2] and found.sag.dtype == np.float64
    assert found.wavelength == pytest.approx(632.8e-9)
    assert found.pitch == (None if found.format == "4D" else pytest.approx(24e-6))
    whole = len(content.rstrip(b" \n#"))  # behind the last value a text says nothing of the map
    for cut in (0, 3, 30, whole // 2, whole - 1):
        with pytest.raises(MapFileError):
            read_map(write(tmp_path, "cut", content[:cut]), xyz_unit="nm")


def test_a_name_that_is_no_text_goes_into_messages_all_the_same(tmp_path: Path) -> None:
    name = os.fsdecode(b"Pr\xfcfung.dat")  # of a machine with another code page
    assert read_map(write(tmp_path, name, dat_bytes(COUNTS))).file.encode().endswith(b"Pr\\udcfcfung.dat")
    with pytest.raises(MapFileError) as caught:
        read_map(write(tmp_path, name, b"no map"))
    assert b"Pr\\udcfcfung.dat: begins with" in str(caught.value).encode()


def test_facts_of_a_fits_file(tmp_path: Path) -> None:
    cards: dict[str, Any] = {
        "INSTRUME": "Hara''s",
        "DATE-OBS": "2015-04-24T19:34:52",
        "WAVELEN": None,
        "PUPLSCAL": None,
        "CDELT1": 1.0,  # without the other axis and a unit of it they tell nothing
        "CUNIT1": "mm",
    }
    found = read_map(write(tmp_path, "a.fits", fits_bytes(SAG, **cards)))
    assert (found.instrument, found.time_stamp, found.wavelength, found.pitch) == ("Hara's", 1429904092.0, 0.0, None)
    settings = IngestSettings(wavelength=532e-9)
    assert Ingest().measure(found, settings)[1].wavelength == 532e-9


@pytest.mark.parametrize(
    ("date", "stamp"),
    [
        ("2015-04-24T19:34:52Z", 1429904092.0),
        ("2015-04-24T21:34:52+02:00", 1429904092.0),
        ("2015-04-24", None),
        ("yesterday", None),
        ("0001-01-01T00:00:00", -62135596800.0),
    ],
)
def test_the_date_of_a_fits_file(tmp_path: Path, date: str, stamp: float | None) -> None:
    cards: dict[str, Any] = {"DATE-OBS": date}
    assert read_map(write(tmp_path, "a.fits", fits_bytes(SAG, **cards))).time_stamp == stamp


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({"BUNIT": None}, "BUNIT is missing: the values have no unit"),
        ({"BUNIT": "waves"}, "BUNIT = 'waves': must be a length"),
        ({"NAXIS": 3}, "NAXIS = 3: must be one of 2"),
        ({"BITPIX": 12}, "BITPIX = 12: must be one of 8"),
        ({"NAXIS1": 13}, "the file holds more values"),
        ({"NAXIS2": 40000}, "file length = 5760 bytes: must be"),
        ({"BSCALE": 1e30}, "height = "),
        ({"WAVELEN": 0.5}, "wavelength = 0.5 m"),
        ({"WAVELEN": "red"}, "WAVELEN = 'red': must be a finite number"),
        ({"PUPLSCAL": -1.0}, "lateral resolution = -1"),
        ({"PUPLSCAL": None, "CDELT1": 1.0, "CUNIT1": "mm", "CDELT2": 2.0, "CUNIT2": "mm"}, "must be square"),
    ],
)
def test_a_fits_file_that_makes_no_sense_is_refused(tmp_path: Path, cards: dict[str, Any], words: str) -> None:
    with pytest.raises(MapFileError, match=re.escape(words)):
        read_map(write(tmp_path, "bad.fits", fits_bytes(SAG, **cards)))


def test_a_fits_file_of_integers_without_a_number_for_no_data_is_refused(tmp_path: Path) -> None:
    """Ignored, its pixels without data were heights."""
    with pytest.raises(MapFileError, match="BLANK = '-7': must be a finite number"):
        read_map(write(tmp_path, "bad.fits", fits_bytes(np.full((4, 5), -7, "i2"), BLANK="-7")))


def test_a_unit_that_no_fits_file_has_is_told_as_the_parameter(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match="xyz_unit = 'waves': must be a length"):
        read_map(write(tmp_path, "bad.fits", fits_bytes(SAG, BUNIT=None)), xyz_unit="waves")


def test_a_fits_file_whose_checksum_does_not_agree_is_refused(tmp_path: Path) -> None:
    content = bytearray(fits_bytes(SAG))
    content[2880 + 300] ^= 1
    with pytest.raises(MapFileError, match="CHECKSUM does not agree"):
        read_map(write(tmp_path, "bad.fits", bytes(content)))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (h5_bytes(SAG, wavelength="red"), "wavelength = 'red': must be a length"),
        (h5_bytes(SAG, xpix="3 px"), "xpix = '3 px'"),
        (h5_bytes(SAG[0]), "must be a two-dimensional table"),
        (four_d_bytes(SAG, other=1), "/Measurement: the attribute 'WavelengthInNanometers' is missing"),
        (four_d_bytes(SAG, WavelengthInNanometers=0.0), "wavelength = 0"),
        (four_d_bytes(SAG, WavelengthInNanometers="red"), "'WavelengthInNanometers' = ['red']: must be one number"),
        (four_d_bytes(SAG, WavelengthInNanometers=632.8, NumOfMeasurements=3), "NumOfMeasurements = 3: must be a file"),
        (h5_bytes(np.full((4, 4), np.nan)), "none of the 4 x 4 pixels is valid"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_file_of_4sight_that_makes_no_sense_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    with pytest.raises(MapFileError, match=re.escape(words)):
        read_map(write(tmp_path, "bad.h5", content))
    assert read_map(write(tmp_path, "a.h5", h5_bytes(SAG / 632.8, xpix=None))).pitch is None
