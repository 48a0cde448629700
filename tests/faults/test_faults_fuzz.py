"""Every reader against damaged files, and the fuzzer against readers that are wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from dm_calibration.map_files import MapFileError, SurfaceMap, read_map
from dm_calibration.store.hdf5_image import ImageError, read_image, write_image
from dm_calibration.store.hdf5_sandbox import Hdf5Sandbox, SandboxError
from fault_injection.fuzz.classify import Verdict, classify
from fault_injection.fuzz.fuzz import fuzz
from fault_injection.fuzz.mutations import Mutation, mutate
from fault_injection.fuzz.reference_files import FORMATS, XYZ_UNIT, ReferenceFile, reference_file

pytestmark = pytest.mark.processes

#: HDF5 files take longer: the library crashes now and then, and its process is started again.
FILES = {"dat": 1000, "asc": 1000, "xyz": 1000, "fits": 500, "datx": 250, "h5": 250, "4D": 100, "calibration": 250}


@pytest.mark.parametrize("name", FORMATS)
def test_no_damaged_file_crashes_hangs_or_becomes_a_wrong_map(name: str, tmp_path: Path) -> None:
    result = fuzz(name, FILES[name], tmp_path, seed=2011)
    assert result.files == FILES[name]
    assert (result.crashes, result.hangs, result.wrong_maps) == (0, 0, 0), result.findings
    assert result.refused > 0.3 * result.files
    if name == "calibration":  # its content has a hash
        assert result.other_samples == result.other_header == 0


def test_a_damaged_file_can_be_made_again() -> None:
    file = reference_file("datx")
    assert mutate(file, 1, 17) == mutate(file, 1, 17)
    assert len({mutate(file, 1, number).content for number in range(30)}) > 25


def read_reference(name: str, folder: Path) -> tuple[ReferenceFile, SurfaceMap]:
    file = reference_file(name)
    path = folder / f"whole{file.suffix}"
    path.write_bytes(file.content)
    return file, read_map(path, xyz_unit=XYZ_UNIT)


@pytest.mark.parametrize("name", ["dat", "datx", "asc", "xyz", "fits", "h5", "4D"])
def test_maps_that_the_damage_does_not_explain_are_called_wrong(name: str, tmp_path: Path) -> None:
    file, whole = read_reference(name, tmp_path)
    nothing = Mutation("none", file.content)
    assert classify(file, whole, nothing, whole) is Verdict.INTACT
    for sag in (2 * whole.sag, np.roll(whole.sag, 1), whole.sag.T, np.where(whole.sag > 0, whole.sag, np.nan)):
        assert classify(file, whole, nothing, replace(whole, sag=sag)) is Verdict.WRONG_MAP
    assert classify(file, whole, nothing, replace(whole, wavelength=5e-7)) is Verdict.WRONG_MAP
    assert classify(file, whole, nothing, replace(whole, pitch=5e-5)) is Verdict.WRONG_MAP


def test_a_changed_sample_and_a_changed_scale_are_told_apart(tmp_path: Path) -> None:
    file, whole = read_reference("dat", tmp_path)
    for place, verdict in (("samples", Verdict.OTHER_SAMPLES), ("scale", Verdict.OTHER_HEADER)):
        content = bytearray(file.content)
        ((start, end),) = file.places[place]
        content[(start + end) // 2 + 1] ^= 1
        path = tmp_path / "changed.dat"
        path.write_bytes(content)
        assert classify(file, whole, Mutation("one bit", bytes(content)), read_map(path)) is verdict


def test_a_reader_that_kills_its_process_is_told_and_the_next_file_is_read(tmp_path: Path) -> None:
    sandbox = Hdf5Sandbox()
    try:
        with pytest.raises(SandboxError, match="ended the helper process with status 1"):
            sandbox.read("no such reader", b"")
        file = reference_file("datx")
        answer = sandbox.read("datx", file.content)
        assert answer.arrays["sag"].shape == (20, 24)
    finally:
        sandbox.close()


def test_groups_that_hold_themselves_end(tmp_path: Path) -> None:
    path = tmp_path / "loop.h5"
    with h5py.File(path, "w") as file:
        file["loop"] = file["/"]
    with pytest.raises(ImageError, match="more than 1000 objects"):
        read_image(path)


def test_promises_of_gigabytes_cost_nothing(tmp_path: Path) -> None:
    path = tmp_path / "huge.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("a", (2**40,), "f8", chunks=(1024,), compression="gzip")
    assert path.stat().st_size < 20_000
    with pytest.raises(ImageError, match="stored in chunks"):
        read_image(path)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (72, (4).to_bytes(4, "big"), "phase bytes = 4: must be 1920"),
        (60, (4).to_bytes(4, "big"), "intensity bytes = 4: must be 960"),
        (64, (1).to_bytes(2, "big"), "must lie on the camera, 24 pixels"),
    ],
)
def test_sizes_of_a_dat_file_that_contradict_each_other(tmp_path: Path, place: int, value: bytes, words: str) -> None:
    content = bytearray(reference_file("dat").content)
    content[place : place + len(value)] = value
    path = tmp_path / "a.dat"
    path.write_bytes(content)
    with pytest.raises(MapFileError, match=words):
        read_map(path)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("Wavelength", np.array([532e-9]), "Wavelength = 5.32e-07, but elsewhere 6.328e-07"),
        ("Interferometric Scale Factor", np.array([1.0]), "Interferometric Scale Factor = 1, but elsewhere 0.5"),
        ("No Data", np.array([2.0]), "No Data = 2: must be NaN or at least 1e"),
    ],
)
def test_values_of_a_datx_file_that_contradict_each_other(
    tmp_path: Path, name: str, value: np.ndarray, words: str
) -> None:
    path = tmp_path / "a.datx"
    path.write_bytes(reference_file("datx").content)
    with h5py.File(path, "r+") as file:
        (surface,) = file["Data/Surface"].values()
        surface.attrs[name] = value
    with pytest.raises(MapFileError, match=words):
        read_map(path)


def test_a_datx_file_that_goes_on_beyond_its_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.datx"
    path.write_bytes(reference_file("datx").content + b"more")
    with pytest.raises(MapFileError, match="longer than its superblock says"):
        read_map(path)


def test_texts_that_are_no_text_disagree_with_the_hash(tmp_path: Path) -> None:
    """h5py hands such bytes over as lone surrogates, which cannot be encoded."""
    path = tmp_path / "a.h5"
    path.write_bytes(write_image({}, {"texts": ("whole",)}))
    with h5py.File(path, "r+") as file:
        del file.attrs["texts"]
        file.attrs["texts"] = np.array([b"\xe8"], dtype=h5py.string_dtype())
    with pytest.raises(ImageError, match="does not agree with its hash"):
        read_image(path)


@pytest.mark.parametrize("shift", [-256, -128, -8, 8, 32, 640])
def test_a_damaged_address_of_a_datx_map_is_noticed(tmp_path: Path, shift: int) -> None:
    """Nothing in the format tells twice where the values stand."""
    file = reference_file("datx")
    ((start, _end),) = file.places["samples"]
    old, new = (address.to_bytes(8, "little") for address in (start, start + shift))
    assert file.content.count(old) == 1
    path = tmp_path / "a.datx"
    path.write_bytes(file.content.replace(old, new))
    with pytest.raises(MapFileError, match=r"they go on outside|which are no heights|do not agree"):
        read_map(path)
