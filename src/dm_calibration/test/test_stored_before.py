"""What version 0.1.0 stored still loads, is published, and predicts the numbers that it predicted then."""

from __future__ import annotations

import gzip
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dm_msgs.msg import Calibration as CalibrationMsg

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_messages import calibration_message, put_updates
from dm_calibration.hysteresis.features import follow
from dm_calibration.procedure.plan import PlanKind, PlanOptions, make_plan
from dm_calibration.procedure.resumable_run import identity_of, open_run
from dm_calibration.procedure.unfinished_runs import UnfinishedRuns
from dm_calibration.recalibration.drift import UpdateOptions
from dm_calibration.recalibration.updates import RecalibrationManager
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common import Floats
from dm_common.measurement import Setup
from dm_common.messages import hysteresis_model_from
from linear_mirror import make_mirror
from map_hashes import record_hash

STORED = Path(__file__).with_name("stored")
EXPECTED: dict[str, Floats] = dict(np.load(STORED / "expected.npz"))


@pytest.fixture
def store(tmp_path: Path) -> CalibrationStore:
    for packed in STORED.glob("*.gz"):
        (tmp_path / packed.stem).write_bytes(gzip.decompress(packed.read_bytes()))
    return CalibrationStore(tmp_path)


def published(store: CalibrationStore, identifier: str) -> tuple[Calibration, CalibrationMsg]:
    calibration = store.load(identifier)
    return calibration, calibration_message(calibration, store.folder / f"{identifier}.h5", "mirror", 1e-8)


def check(message: CalibrationMsg, name: str) -> None:
    """Compare what `message` predicts for the commands, and its figures, with what was expected then."""
    commands = EXPECTED["commands"]
    for field, offset, matrix in (
        ("coefficients", message.zernike_offset, message.influence_zernike),
        ("sag", message.sag_offset, message.influence_sag),
    ):
        found = np.array(offset) + commands @ np.array(matrix).reshape(len(offset), message.actuators).T
        np.testing.assert_allclose(found, EXPECTED[f"{name}/{field}"], rtol=0.0, atol=1e-18)
    held_out, max_zernike, _condition, quality, maps = EXPECTED[f"{name}/figures"]
    assert (message.held_out_rms, message.held_out_max_zernike) == (held_out, max_zernike)
    assert (message.quality, message.maps_used) == (quality, maps)


def test_an_influence_function(store: CalibrationStore) -> None:
    calibration, message = published(store, "linear")
    check(message, "linear")
    assert message.id == "linear"
    assert calibration.note == "made before the house"
    assert calibration.region_weights.size == 10
    assert calibration.hysteresis is None
    assert not calibration.recipes.recipes


def test_what_later_maps_changed(store: CalibrationStore) -> None:
    calibration, message = published(store, "linear")
    options = UpdateOptions(signal_sigma=1e-3, gain_rate=0.0, figure_rate=0.0)
    manager = RecalibrationManager(store.folder, lambda: options)
    assert manager.begin(calibration) == ""
    kept = manager.in_use
    assert kept is not None
    assert kept.drift.trust == 1.0  # all of it was used then
    put_updates(message, kept, np.nan, [], False)
    check(message, "updated")
    drift = (message.revision, abs(kept.drift.largest_gain[0]), kept.drift.offset_rms)
    np.testing.assert_allclose(drift, EXPECTED["updated/drift"], rtol=1e-12)


def test_hysteresis_and_recipes(store: CalibrationStore) -> None:
    calibration, message = published(store, "hysteresis")
    check(message, "hysteresis")
    model = hysteresis_model_from(message.hysteresis)
    assert model is not None
    rest = model.demagnetised(message.actuators, 0.0)
    effective = follow(model, rest, EXPECTED["commands"], EXPECTED["times"])[0]
    np.testing.assert_allclose(effective, EXPECTED["hysteresis/effective"], rtol=0.0, atol=1e-14)
    assert calibration.hysteresis is not None
    np.testing.assert_array_equal(calibration.hysteresis.zernike_sigma, EXPECTED["hysteresis/sigma"])
    rows = [[recipe.curvature, *recipe.effective, *recipe.signals] for recipe in calibration.recipes.recipes]
    np.testing.assert_array_equal(rows, EXPECTED["hysteresis/recipes"])


def test_a_run_that_was_cut_off_goes_on(store: CalibrationStore) -> None:
    folder = store.folder / "unfinished" / "20251122T000000Z"
    folder.mkdir(parents=True)
    for name in ("manifest.json", "events"):
        shutil.copyfile(STORED / name, folder / name)
    os.utime(folder / "events")
    linear = store.load("linear")
    mirror = replace(make_mirror(rings=1), x=linear.actuator_x, y=linear.actuator_y)  # to the last bit
    plan = make_plan(PlanKind.POKES, mirror)
    other = PlanOptions(hysteresis_maps=301)  # than it had: pokes are the same whatever a hysteresis plan would be
    identity = identity_of(plan, other, mirror, {"settle_time_s": 0.5}, {"wiring": "w"})
    with UnfinishedRuns(store.folder) as runs:
        run = open_run(runs, identity, plan, 3600.0)
        run.journal.keep(Setup(run.outcome.maps().points, 0.0, 0))  # it goes on behind the frames of then
        run.journal.close()
    assert run.resumed == f"resumed run {folder.name} with 4 maps"
    assert [record_hash(record) for record in run.outcome.records] == list(EXPECTED["unfinished/hashes"])
    assert run.outcome.maps().sag.shape == (4, 30)
