"""Calibration files: whole or not at all, and read with suspicion."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import fields, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_calibration.calibration import Calibration, CalibrationFileError, to_columns
from dm_calibration.calibrator import Provenance, calibrate, refit
from dm_calibration.influence.fit import FitOptions
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.procedure.outcome import Outcome
from dm_calibration.procedure.plan import PlanKind, PlanOptions, make_plan
from dm_calibration.store.calibration_store import CalibrationStore
from dm_calibration.store.hdf5_image import content_hash, read_image, write_image
from dm_common.atomic_write import StoreError
from dm_common.errors import UnknownNameError
from dm_common.measurement import Measurement, Setup
from linear_mirror import LinearMirror, make_mirror

MIRROR = make_mirror(rings=1, serial="S 7/é")


def make_calibration(identifier: str = "PDM_1", created_ns: int = 10**18) -> Calibration:
    plant = LinearMirror(MIRROR.x, MIRROR.y, noise=1e-9)
    outcome = Outcome(setup=Setup(plant.points, 632.8e-9, -1), dropped=["poke+02 (2): no map within 5 s"])
    for number, step in enumerate(make_plan(PlanKind.POKES, MIRROR, PlanOptions(degauss=False)).steps):
        assert step.signals is not None
        sag = plant.sag(step.signals)
        outcome.records.append(
            Measurement(
                points=plant.points,
                sag=sag,
                coefficients=plant.fit_terms(sag),
                sigma=np.full(21, 1e-10),
                stamp_ns=number * 10**9,
                residual_rms=1e-9,
                valid_fraction=0.99,
                file=f"/maps/{number}.dat",
                sha256="ab" * 32,
                label=step.label,
                kind=step.kind.value,
                step=number,
                signals=step.signals,
                applied=step.signals,
            )
        )
    calibration = calibrate(outcome, mirror=MIRROR, provenance=Provenance(identifier, created_ns, "bench 3, cold"))
    assert not any("Poke check" in sentence for sentence in calibration.limitations)
    return calibration


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return make_calibration()


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory, calibration: Calibration) -> tuple[CalibrationStore, bytes]:
    """A store whose one file is overwritten with damaged copies of the image."""
    store = CalibrationStore(tmp_path_factory.mktemp("damaged"))
    return store, store.save(calibration).read_bytes()


def assert_equal(a: object, b: object) -> None:
    assert type(a) is type(b)
    for field in fields(a):  # type: ignore[arg-type]
        one, other = getattr(a, field.name), getattr(b, field.name)
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype
            assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f"), field.name
        elif hasattr(one, "__dataclass_fields__"):
            assert_equal(one, other)
        else:
            assert one == other, field.name


def test_what_was_saved_is_loaded(tmp_path: Path, calibration: Calibration) -> None:
    store = CalibrationStore(tmp_path / "new" / "folder")
    file = store.save(calibration)
    assert file == tmp_path / "new" / "folder" / "PDM_1.h5"
    for name in ("PDM_1", "PDM_1.h5", str(file)):
        assert_equal(store.load(name), calibration)
    assert [path.name for path in file.parent.iterdir()] == ["PDM_1.h5"]


def test_the_file_tells_what_it_is_to_any_hdf5_tool(tmp_path: Path, calibration: Calibration) -> None:
    file = CalibrationStore(tmp_path).save(calibration)
    with h5py.File(file) as content:
        assert content.attrs["schema_version"] == 1
        assert content.attrs["mirror_serial"] == "S 7/é"
        assert content.attrs["wavelength"] == 632.8e-9
        assert content.attrs["note"] == "bench 3, cold"
        assert content.attrs["fit_held_out_rms"] == calibration.fit.held_out_rms
        assert len(content.attrs["content_sha256"]) == 64
        assert content["maps/label"].asstr()[0] == "reference 1"
        assert content["maps/sag"].shape == (len(calibration.maps), 300)
        assert content["maps/reference"][()].sum() == 3
        assert content["result/influence_sag"].shape == (300, 7)
        assert "hysteresis" in content.attrs["known_limitations"][0]


def test_a_second_save_never_replaces(tmp_path: Path, calibration: Calibration) -> None:
    store = CalibrationStore(tmp_path)
    before = store.save(calibration).read_bytes()
    with pytest.raises(StoreError, match="exists already"):
        store.save(replace(calibration, note="other"))
    assert (tmp_path / "PDM_1.h5").read_bytes() == before


@pytest.mark.slow
def test_disk_full_leaves_everything_as_it_was(tmp_path: Path, calibration: Calibration) -> None:
    """A child process whose files may not grow beyond 20 kB meets a failing write, as on a full disk."""
    CalibrationStore(tmp_path).save(calibration)
    before = (tmp_path / "PDM_1.h5").read_bytes()
    program = (
        "import resource, sys\n"
        "from dataclasses import replace\n"
        "from dm_calibration.store.calibration_store import CalibrationStore, StoreError\n"
        "store = CalibrationStore(sys.argv[1])\n"
        "calibration = replace(store.load('PDM_1'), id='PDM_2')\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))\n"
        "try:\n    store.save(calibration)\n"
        "except StoreError as error:\n    print(error)\n    sys.exit(7)\n"
    )
    child = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=False)
    assert child.returncode == 7, child.stderr
    assert "calibration PDM_2 was not stored" in child.stdout and "File too large" in child.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["PDM_1.h5"]
    assert (tmp_path / "PDM_1.h5").read_bytes() == before


def test_read_only_folder(calibration: Calibration) -> None:
    root = os.geteuid() == 0  # who may write everywhere, and whose folder of the test nobody else may enter
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o555)
        try:
            if root:
                os.seteuid(65534)
            with pytest.raises(StoreError, match="Permission denied"):
                CalibrationStore(Path(folder)).save(calibration)
        finally:
            if root:
                os.seteuid(0)


def test_folder_that_is_a_file(tmp_path: Path, calibration: Calibration) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(StoreError, match="was not stored"):
        CalibrationStore(tmp_path / "file").save(calibration)
    assert CalibrationStore(tmp_path / "file").entries() == []


@pytest.mark.parametrize(
    "name", ["../PDM_1", "/etc/passwd", "a/b", ".hidden", "", "..", "PDM_1.h5/..", "x\ny", "~/PDM_1.h5", "~no/PDM_1.h5"]
)
def test_names_do_not_leave_the_folder(name: str, tmp_path: Path, calibration: Calibration) -> None:
    (tmp_path / "inner").mkdir()
    CalibrationStore(tmp_path).save(calibration)
    with pytest.raises(UnknownNameError):
        CalibrationStore(tmp_path / "inner").load(name)


def test_links_out_of_the_folder_are_not_followed(tmp_path: Path, calibration: Calibration) -> None:
    file = CalibrationStore(tmp_path / "other").save(calibration)
    inner = tmp_path / "inner"
    inner.mkdir()
    (inner / "PDM_1.h5").symlink_to(file)
    with pytest.raises(UnknownNameError, match="link out of"):
        CalibrationStore(inner).load("PDM_1")


@pytest.mark.parametrize("identifier", ["", "../a", "a/b", ".a", "a b", "x" * 129])
def test_unsafe_ids_are_refused(tmp_path: Path, calibration: Calibration, identifier: str) -> None:
    with pytest.raises(ValueError, match="calibration id"):
        CalibrationStore(tmp_path).save(replace(calibration, id=identifier))


def test_new_ids_are_unique_and_safe(tmp_path: Path, calibration: Calibration) -> None:
    store = CalibrationStore(tmp_path)
    first = store.new_id("PDM30-37", "S 7/é", 10**18)
    assert first == "PDM30-37_S-7_20010909T014640Z"
    store.save(replace(calibration, id=first))
    assert store.new_id("PDM30-37", "S 7/é", 10**18) == first + "-2"


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(truncate=st.booleans(), share=st.floats(0.0, 1.0, exclude_max=True), bit=st.integers(0, 7))
def test_damage_is_noticed(truncate: bool, share: float, bit: int, damaged: tuple[CalibrationStore, bytes]) -> None:
    store, image = damaged
    at = int(share * len(image))
    content = bytearray(image)
    if truncate:
        del content[at:]
    else:
        content[at] ^= 1 << bit
    (store.folder / "PDM_1.h5").write_bytes(bytes(content))
    try:
        loaded = store.load("PDM_1")
    except CalibrationFileError as error:
        assert "PDM_1.h5" in str(error)
        assert store.entries()[0].remark == str(error)
    else:  # a bit in unused space: nothing that counts has changed
        assert not truncate
        assert content_hash(*to_columns(loaded)) == content_hash(*to_columns(make_calibration()))


def test_foreign_and_changed_files(tmp_path: Path, calibration: Calibration) -> None:
    store = CalibrationStore(tmp_path)
    store.save(calibration)
    (tmp_path / "text.h5").write_text("no HDF5")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["a"] = [1, 2]
    (tmp_path / "renamed.h5").write_bytes((tmp_path / "PDM_1.h5").read_bytes())
    with h5py.File(tmp_path / "linked.h5", "w") as file:
        file["a"] = h5py.ExternalLink(str(tmp_path / "PDM_1.h5"), "/maps/sag")
    with h5py.File(tmp_path / "external.h5", "w") as file:
        file.create_dataset("a", (4,), "u1", external=[("/etc/hostname", 0, 4)])
    words = {
        "text": "not a whole HDF5 file",
        "foreign": "content_sha256 is missing",
        "renamed": "holds the calibration PDM_1",
        "linked": "is a link, which is not followed",
        "external": "keeps its data outside the file",
    }
    for name, expected in words.items():
        with pytest.raises(CalibrationFileError, match=expected):
            store.load(name)
    listed = {entry.id: entry for entry in store.entries()}
    assert listed.keys() == {"PDM_1", *words}
    assert listed["PDM_1"].remark == ""
    assert all(listed[name].calibration is None and expected in listed[name].remark for name, expected in words.items())


def rewrite(source: Path, target: Path, **changes: object) -> None:
    """A file with some attributes or datasets changed and a hash that agrees again."""
    columns, attributes = read_image(source)
    for name, value in changes.items():
        path = name.replace("__", "/")
        if value is None:
            columns.pop(path)
        elif isinstance(value, np.ndarray):
            columns[path] = value
        else:
            attributes[path] = value  # type: ignore[assignment]
    target.write_bytes(write_image(columns, attributes))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"schema_version": 2}, "schema version 2: this software reads 1"),
        ({"schema": "other"}, "not a calibration of this suite"),
        ({"result__sag_offset": None}, "sag_offset.* is missing"),
        ({"result__influence_sag": np.zeros((300, 6))}, r"influence_sag has the shape \(300, 6\)"),
        ({"result__zernike_offset": np.full(21, np.nan)}, "zernike_offset holds values that are not finite"),
        ({"points__weight": np.full(300, np.inf)}, "points/weight holds values that are not finite"),
        ({"aperture_radius": -1.0}, "aperture_radius = -1.0"),
        ({"mirror_serial": 5}, "mirror_serial = 5"),
        ({"maps__sag": np.zeros((2, 300))}, "sag has the shape"),
    ],
)
def test_wrong_content_is_refused_in_words(
    changes: dict[str, object], words: str, tmp_path: Path, calibration: Calibration
) -> None:
    file = CalibrationStore(tmp_path / "a").save(calibration)
    (tmp_path / "b").mkdir()
    rewrite(file, tmp_path / "b" / "PDM_1.h5", **changes)
    with pytest.raises(CalibrationFileError, match=words):
        CalibrationStore(tmp_path / "b").load("PDM_1")


def test_newest_first(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path)
    for identifier, created in (("a", 2 * 10**18), ("b", 10**18), ("c", 3 * 10**18)):
        store.save(make_calibration(identifier, created))
    assert [entry.id for entry in store.entries()] == ["c", "a", "b"]


def test_hash_covers_names_shapes_and_values() -> None:
    base = content_hash({"a": np.zeros((2, 3)), "t": ("x", "y")}, {"n": 1})
    others = [
        content_hash({"a": np.zeros((3, 2)), "t": ("x", "y")}, {"n": 1}),
        content_hash({"b": np.zeros((2, 3)), "t": ("x", "y")}, {"n": 1}),
        content_hash({"a": np.zeros((2, 3)), "t": ("xy", "")}, {"n": 1}),
        content_hash({"a": np.zeros((2, 3)), "t": ("x", "y")}, {"n": 2}),
        content_hash({"a": np.zeros((2, 3), dtype=np.float32), "t": ("x", "y")}, {"n": 1}),
    ]
    assert len({base, *others}) == 6
    assert base == content_hash({"t": ("x", "y"), "a": np.zeros((2, 3), dtype=">f8")}, {"n": 1})


def test_refit_of_stored_data(tmp_path: Path, calibration: Calibration) -> None:
    store = CalibrationStore(tmp_path)
    store.save(calibration)
    again = refit(store.load("PDM_1"), FitOptions(), [], Provenance("PDM_2", 2 * 10**18))
    assert again.fit.influence_sag == pytest.approx(calibration.fit.influence_sag, abs=1e-15)
    less = refit(calibration, FitOptions(), ["poke+03"], Provenance("PDM_3", 2 * 10**18))
    assert less.fit.used.sum() == calibration.fit.used.sum() - 1
    assert less.maps_dropped == calibration.maps_dropped + 1
    assert "Fitted again from the raw data of PDM_1 without poke+03." in less.limitations
    assert len(less.maps) == len(calibration.maps)
    with pytest.raises(UnknownNameError, match=r"poke\+3"):
        refit(calibration, FitOptions(), ["poke+3"], Provenance("x", 0))
    with pytest.raises(TooFewMapsError):
        refit(calibration, FitOptions(), calibration.maps.label[2:], Provenance("x", 0))
    store.save(again)
    assert_equal(store.load("PDM_2"), again)


def test_serial_numbers_that_look_alike_as_file_names_are_told_apart(tmp_path: Path, calibration: Calibration) -> None:
    store = CalibrationStore(tmp_path)
    for serial in ("12/3", "12-3", "Ω1", "Ж1", ""):
        store.note_in_use(replace(calibration, id=f"of-{len(list(tmp_path.iterdir()))}", mirror_serial=serial))
    assert [store.last_in_use(serial) for serial in ("12/3", "12-3", "Ω1", "Ж1", "")] == [f"of-{n}" for n in range(5)]


def test_a_file_whose_maps_have_no_rows_is_listed_as_unreadable(tmp_path: Path, calibration: Calibration) -> None:
    store = CalibrationStore(tmp_path)
    store.save(calibration)
    for name, change in (("flat", lambda signals: signals.ravel()), ("none", lambda signals: signals[:0])):
        columns, attributes = to_columns(replace(calibration, id=name))
        columns["maps/signals"] = change(columns["maps/signals"])
        (tmp_path / f"{name}.h5").write_bytes(write_image(columns, attributes))
    remarks = {entry.id: entry.remark for entry in store.entries()}
    assert remarks.pop("PDM_1") == "" and all("signals" in remark for remark in remarks.values()), remarks


def test_a_bound_that_is_no_number_is_no_calibration_and_grades_are_known(
    tmp_path: Path, calibration: Calibration
) -> None:
    unknown = replace(calibration, fit=replace(calibration.fit, held_out_max_zernike=float("nan")))
    assert "the promise is above" in " ".join(unknown.doubts())
    columns, attributes = to_columns(calibration)
    columns["result/grades"] = np.full_like(columns["result/grades"], 9)
    (tmp_path / f"{calibration.id}.h5").write_bytes(write_image(columns, attributes))
    with pytest.raises(CalibrationFileError, match="result/grades: must be 0 to 3"):
        CalibrationStore(tmp_path).load(calibration.id)


def test_a_refit_has_the_poke_check_of_its_own_fit(calibration: Calibration) -> None:
    found = "Poke check: actuator 1 shows no response above the noise."
    limited = replace(calibration, limitations=(*calibration.limitations, found))
    again = refit(limited, FitOptions(), (), Provenance("again", 2))
    assert found not in again.limitations and again.limitations[-1].startswith("Fitted again")
