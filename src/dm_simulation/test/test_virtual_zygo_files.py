"""The map files of the virtual bench, taken apart byte by byte."""

from __future__ import annotations

import io
import os
import struct
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from dm_simulation.interferometer.zygo_files import deliver, encode_dat, encode_datx, prune

WAVELENGTH = 632.8e-9


@pytest.fixture
def sag() -> NDArray[np.float64]:
    """An F in 6 x 4 pixels: nothing about it is symmetric. Its lower right corner has no data."""
    picture = np.array([[1, 1, 1, 1], [1, 0, 0, 0], [1, 1, 1, 0], [1, 0, 0, 0], [1, 0, 0, 0], [-1, 0, 0, np.nan]])
    return picture * 123.4e-9


@pytest.mark.parametrize("intensity", [False, True])
@pytest.mark.parametrize(("code", "counts_per_fringe"), [(0, 4096), (1, 32768), (2, 131072)])
def test_dat(sag: NDArray[np.float64], intensity: bool, code: int, counts_per_fringe: int) -> None:
    data = encode_dat(
        sag, 23.3e-6, WAVELENGTH, 1_700_000_000, intensity=intensity, phase_resolution=code, part_name="mirror 7"
    )
    assert data[:10] == bytes.fromhex("881B036F 0001 00000342")
    frame = 2 * 24 if intensity else 0
    assert len(data) == 834 + frame + 4 * 24
    assert struct.unpack(">HHHxxI", data[52:64]) == ((4, 6, 1, 48) if intensity else (0, 0, 0, 0))
    assert struct.unpack(">HHI", data[68:76]) == (4, 6, 96)
    assert struct.unpack(">I", data[76:80]) == (1_700_000_000,)
    scale, wavelength = struct.unpack(">ff", data[164:172])
    (obliquity,) = struct.unpack(">f", data[176:180])
    (pitch,) = struct.unpack(">f", data[184:188])
    (resolution,) = struct.unpack(">h", data[218:220])
    (inverted,) = struct.unpack(">h", data[232:234])
    assert (scale, obliquity, resolution, inverted) == (0.5, 1.0, code, 0)
    assert wavelength == pytest.approx(WAVELENGTH, rel=1e-7)
    assert pitch == pytest.approx(23.3e-6, rel=1e-7)
    assert data[258:298].rstrip(b"\0") == b"mirror 7"
    counts = np.array(struct.unpack(">24i", data[834 + frame :])).reshape(6, 4)
    assert counts[5, 3] >= 2147483640
    height = counts * scale * obliquity * wavelength / counts_per_fringe
    valid = np.isfinite(sag)
    np.testing.assert_allclose(height[valid], sag[valid], atol=0.51 * 0.5 * WAVELENGTH / counts_per_fringe)


def test_dat_refuses_heights_that_do_not_fit(sag: NDArray[np.float64]) -> None:
    sag[0, 0] = 0.1
    with pytest.raises(ValueError, match="does not fit"):
        encode_dat(sag, 0.0, WAVELENGTH, 0)


@pytest.mark.parametrize(("unit", "metres"), [("NanoMeters", 1e-9), ("Fringes", 0.5 * WAVELENGTH)])
def test_datx(sag: NDArray[np.float64], unit: str, metres: float) -> None:
    with h5py.File(io.BytesIO(encode_datx(sag, 23.3e-6, WAVELENGTH, 0, unit=unit)), "r") as file:
        links = {(row["Source"], row["Link"]): row["Destination"] for row in file["MetaData"][()]}
        measurement = links[b"Root", b"Measurement"]
        data = file[links[links[measurement, b"Surface"], b"Path"]]
        assert data.name.startswith("/Data/Surface/")
        values = data[()]
        attributes = data.attrs
        valid = values < attributes["No Data"][0]
        np.testing.assert_array_equal(valid, np.isfinite(sag))
        np.testing.assert_allclose(values[valid] * metres, sag[valid], rtol=1e-12)
        assert attributes["Unit"][0] == unit
        assert attributes["Wavelength"][0] == WAVELENGTH
        assert attributes["Interferometric Scale Factor"][0] == 0.5
        assert attributes["Obliquity Factor"][0] == 1.0
        assert attributes["X Converter"][0]["Parameters"][1] == 23.3e-6
        group = next(iter(file["Attributes"].values()))
        assert group.attrs["Data Context.Lateral Resolution:Value"][0] == 23.3e-6
        assert group.attrs["Subtract System Error"][0] == 0


def test_a_file_appears_whole(tmp_path: Path) -> None:
    content = bytes(range(256)) * 4000
    target = tmp_path / "map.dat"
    seen: set[int] = set()
    stop = threading.Event()

    def look() -> None:
        while not stop.is_set():
            seen.update(file.stat().st_size for file in tmp_path.glob("*.dat"))

    watcher = threading.Thread(target=look)
    watcher.start()
    for _ in range(20):
        deliver(content, target)
    stop.set()
    watcher.join()
    assert target.read_bytes() == content
    assert seen <= {len(content)}
    assert [file.name for file in tmp_path.iterdir()] == ["map.dat"]


def test_a_slow_file_that_cannot_be_written_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_seconds: float) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(time, "sleep", full)
    with pytest.raises(OSError, match="No space"):
        deliver(bytes(80_000), tmp_path / "map.dat", 0.4)
    assert not list(tmp_path.iterdir())


def test_a_slow_file_grows_in_pieces(tmp_path: Path) -> None:
    content = bytes(80_000)
    target = tmp_path / "map.dat"
    writer = threading.Thread(target=deliver, args=(content, target, 0.4))
    writer.start()
    sizes = set()
    while writer.is_alive():
        if target.exists():
            sizes.add(target.stat().st_size)
        time.sleep(0.005)
    assert target.read_bytes() == content
    assert sizes - {0, len(content)}  # seen unfinished


def test_a_missing_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        deliver(b"x", tmp_path / "none" / "map.dat")


def test_the_oldest_maps_go_and_nothing_else(tmp_path: Path) -> None:
    maps = [tmp_path / f"measure_{number}_1.dat" for number in range(3)] + [tmp_path / "map_000001.datx"]
    others = [tmp_path / "my_map.dat", tmp_path / "measure_notes.dat", tmp_path / "map_1.txt"]
    others.append(tmp_path / "map_2024-05-01_before_repair.datx")
    for number, path in enumerate([*others, *maps]):
        path.write_bytes(bytes(100))
        os.utime(path, (number, number))
    prune(tmp_path, 250)
    assert [path for path in (*others, *maps) if path.exists()] == [*others, *maps[2:]]
    prune(tmp_path, 1)
    assert [path for path in maps if path.exists()] == maps[3:], "the newest stays"
    late = tmp_path / "map_000002.datx"  # written after the clock was set back
    late.write_bytes(bytes(100))
    os.utime(late, (1, 1))
    prune(tmp_path, 1, late)
    assert late.exists() and maps[3].exists()
