"""The node `calibration` keeps its calibration true: maps over topics and by service, storage, diagnostics."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from dm_msgs.msg import Calibration as CalibrationMsg
from dm_msgs.msg import Capabilities
from dm_msgs.msg import RecipeBook as RecipeBookMsg
from dm_msgs.srv import HoldMirror, LoadCalibration, StoreRecipes, UpdateCalibration

from calibration_stand_in import StandIn
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.errors import HISTORY_UNKNOWN, NO_CALIBRATION, ErrorCode
from dm_common.hysteresis.creep_record import CreepRecord, write_record
from dm_common.hysteresis.model import CREEP_TIMES
from dm_common.messages import recipe_book_message
from dm_common.recipes import Recipe, RecipeBook
from dm_common.ros import qos
from dm_tools.running_suite import promise_of
from linear_mirror import LinearMirror
from steady_mirror import NOISE, SteadyMirror, without_effect
from support import NodeProcess, Observer, wait_until

STILL_S = 0.1


class Suite:
    """A calibration node with a calibration in use, its mirror, and an observer of both."""

    def __init__(self, observer: Observer, process: NodeProcess, bench: StandIn, folder: Path) -> None:
        self.observer, self.process, self.bench, self.folder = observer, process, bench, folder
        self.received = observer.record(CalibrationMsg, "calibration", qos.LATCHED)
        self.health = observer.record(DiagnosticArray, "/diagnostics")
        wait_until(lambda: self.received and self.received[-1].id == "steady", 60, process.output)
        self.random = np.random.default_rng(3)

    @property
    def calibration(self) -> Any:
        return self.received[-1]

    def status(self, words: str) -> Any:
        """The first status that says `words`, from now on."""
        self.health.clear()

        def found() -> Any:
            return next((m.status[0] for m in self.health if words in m.status[0].message), None)

        return wait_until(found, 60, f"diagnostics with {words!r}: {[m.status[0].message for m in self.health]}")

    def shape(self) -> None:
        """Another shape, and long enough for a map of it."""
        self.bench.move(self.random.uniform(-0.7, 0.7, self.bench.mirror.actuators))
        time.sleep(2 * STILL_S)

    def drift(self, gain: float) -> None:
        """Gains become this much larger, of every other actuator."""
        plant = self.bench.plant
        plant.influence = plant.influence * (1.0 + gain * (np.arange(self.bench.mirror.actuators) % 2))

    def call(self, **fields: Any) -> Any:
        return self.observer.call(UpdateCalibration, "update_calibration", UpdateCalibration.Request(**fields))

    def expect(self, revision: int) -> None:
        wait_until(lambda: self.calibration.revision == revision, 60, f"revision {revision}: {self.process.output}")


@pytest.fixture
def steady() -> SteadyMirror:
    return SteadyMirror()


@pytest.fixture
def begin(
    start: Callable[..., NodeProcess], observer: Observer, steady: SteadyMirror, tmp_path: Path
) -> Callable[..., Suite]:
    """begin(memory=..., **parameters) starts a node with a calibration of the steady mirror in use."""
    folder = tmp_path / "calibrations"
    plant = LinearMirror(steady.mirror.x, steady.mirror.y, noise=NOISE, seed=2)

    def begin(hysteresis: HysteresisFit | None = None, **changes: Any) -> Suite:
        if not folder.exists():
            CalibrationStore(folder).save(replace(steady.calibrate(time.time_ns()), hysteresis=hysteresis))
        values = {
            "calibration_folder": str(folder),
            "load_on_start": "newest",
            "hysteresis_allowance": 0.0,
            "write_report": False,
            "updates.still_time": STILL_S,
            **changes,
        }
        process = start("dm_calibration", "calibration", values)
        return Suite(observer, process, StandIn(observer.node, steady.mirror, plant), folder)

    return begin


@pytest.fixture
def suite(begin: Callable[..., Suite]) -> Iterator[Suite]:
    suite = begin()
    yield suite
    assert "Traceback" not in suite.process.output, suite.process.output


def test_update_by_service_is_stored_published_and_forgotten(suite: Suite, begin: Callable[..., Suite]) -> None:
    file = suite.folder / "steady.h5"
    content = file.read_bytes()
    suite.shape()
    dry = suite.call(dry_run=True)
    assert (dry.error_code, dry.accepted, dry.revision) == (ErrorCode.OK, True, 0), dry.message
    assert 0.2 < dry.surprise < 3.0
    assert 0.0 < dry.max_zernike < 5e-9
    assert 0.0 < dry.rms < 5e-9
    suite.drift(2e-3)
    for revision in (1, 2):  # the second map bears out what the first one says
        suite.shape()
        taken = suite.call()
        assert (taken.error_code, taken.accepted, taken.revision) == (ErrorCode.OK, True, revision), taken.message
    assert 0.0 < taken.gain_drift < 0.01
    suite.expect(2)
    assert suite.calibration.checked.sec > 0
    stored = CalibrationStore(suite.folder).load("steady")
    assert not np.array_equal(stored.fit.influence_sag.ravel(), np.array(suite.calibration.influence_sag))
    again = suite.observer.call(LoadCalibration, "load_calibration", LoadCalibration.Request(calibration="steady"))
    assert again.error_code == ErrorCode.OK
    assert suite.calibration.revision == 2
    assert file.read_bytes() == content

    both = suite.call(dry_run=True, forget=True)
    assert both.error_code == ErrorCode.INVALID_ARGUMENT
    assert "only one of them" in both.message
    assert suite.call(forget=True).revision == 0
    suite.expect(0)
    assert np.array_equal(stored.fit.influence_sag.ravel(), np.array(suite.calibration.influence_sag))
    assert sorted(path.name for path in suite.folder.iterdir()) == ["in_use_T-1.txt", "steady.checks.csv", "steady.h5"]


def test_updates_outlive_the_node(suite: Suite, begin: Callable[..., Suite]) -> None:
    suite.drift(2e-3)
    suite.shape()
    suite.call()
    suite.shape()
    taken = suite.call()
    assert suite.process.stop() == 0
    later = begin()
    later.expect(2)
    assert later.call(dry_run=True).gain_drift == taken.gain_drift > 0.0


def test_maps_that_the_interferometer_publishes_are_taken_once(suite: Suite) -> None:
    for revision in (1, 2, 3):
        suite.shape()
        message = suite.bench.map()
        suite.bench.publish_map(message)
        suite.expect(revision)
    suite.bench.publish_map(message)
    suite.shape()
    suite.bench.publish_map(suite.bench.map())
    suite.expect(4)


def test_the_command_checks_and_tells_by_its_exit_status(suite: Suite, tmp_path: Path) -> None:
    suite.shape()
    figures = tmp_path / "figures.json"
    command = [sys.executable, "-m", "dm_tools", "check", "--json", str(figures)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    check = json.loads(figures.read_text())["check"]
    assert check["revision"] == 1
    assert check["promised_nm"] == pytest.approx(1e9 * promise_of(suite.calibration))  # no controller is there
    suite.bench.plant.figure_coefficients[4] += 1e-9 * (check["promised_nm"] + check["max_zernike_nm"])
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "outside" in done.stdout and "the map disagrees" not in done.stdout, done.stdout
    suite.bench.plant.figure_coefficients[4] += 100e-9
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "the map disagrees" in done.stdout


def test_a_controller_that_was_restarted_alone_is_not_judged_by_what_another_node_knows(
    begin: Callable[..., Suite], tmp_path: Path
) -> None:
    """Its wide bound was held against the error of a prediction that it cannot make."""
    suite = begin(hysteresis=without_effect())
    suite.bench.on_degauss(0)
    suite.shape()
    node, figures = suite.observer.node, tmp_path / "figures.json"
    able = node.create_publisher(Capabilities, "capabilities", qos.LATCHED)
    command = [sys.executable, "-m", "dm_tools", "check", "--json", str(figures)]
    for lost in ("the mirror moved before this node followed it", ""):
        able.publish(
            Capabilities(error_bound=2.5e-7, message=f"all; {lost and HISTORY_UNKNOWN}{lost}; without actuator 6")
        )
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stdout + done.stderr
        promised = 1e-9 * json.loads(figures.read_text())["check"]["promised_nm"]
        assert promised == pytest.approx(promise_of(suite.calibration) if lost else 2.5e-7)
        assert (f"does not know their history ({lost})" in done.stdout) == bool(lost), done.stdout


def test_it_goes_on_without_an_actuator_that_died(suite: Suite) -> None:
    moved = suite.bench.plant.influence
    suite.bench.plant.influence = moved * (np.arange(suite.bench.mirror.actuators) != 6)
    suite.bench.move(np.full(suite.bench.mirror.actuators, 0.4))
    time.sleep(2 * STILL_S)
    named = suite.call()
    assert not named.accepted and named.message.endswith("./dm check --without 7 continues without what does not move")
    assert suite.call(without=[99]).error_code == ErrorCode.OUT_OF_RANGE
    assert suite.call(without=[7], forget=True).error_code == ErrorCode.INVALID_ARGUMENT
    suite.status("The last map disagrees with this calibration: bounds are wider until one agrees")
    command = [sys.executable, "-m", "dm_tools", "check", "--without", "7"]
    tried = subprocess.run([*command, "--dry-run"], capture_output=True, text=True, timeout=60)
    assert tried.returncode == 0 and "nothing is changed yet" in tried.stdout, tried.stdout + tried.stderr
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and "Used without actuator 7 (fixed at " in done.stdout, done.stdout + done.stderr
    suite.expect(1)
    assert suite.calibration.actuator_grade[6] == "dead"
    assert any("Used without actuator 7" in sentence for sentence in suite.calibration.known_limitations)
    suite.shape()
    assert suite.call().accepted
    suite.status("Used without actuator 7")


def test_switched_off_only_the_service_takes_maps(begin: Callable[..., Suite]) -> None:
    suite = begin(**{"updates.enable": False})
    suite.shape()
    suite.bench.publish_map(suite.bench.map())
    assert suite.call().revision == 1


def test_the_mirror_moved_or_the_map_is_another(suite: Suite) -> None:
    suite.shape()
    old = suite.bench.map()
    time.sleep(STILL_S / 2)
    suite.bench.move(suite.bench.mirror.rest)
    suite.bench.publish_map(old)
    wait_until(lambda: "map not used: the mirror moved" in suite.process.output, 60, suite.process.output)
    figures = {pair.key: pair.value for pair in suite.status("calibration steady").values}
    assert figures["maps_refused"] == "1"
    assert "s after the stamp of the map: must stand still for 0.1 s" in figures["last_refusal"]
    suite.shape()
    suite.bench.other_wavelength = {"calibration check"}
    refused = suite.call()
    assert refused.error_code == ErrorCode.MAP_REJECTED
    assert "wavelength 635.000 nm, the calibration's is 632.800 nm" in refused.message
    suite.bench.other_wavelength, suite.bench.failing = set(), {"calibration check"}
    refused = suite.call()
    assert refused.error_code == ErrorCode.MAP_TIMEOUT
    assert not refused.accepted
    assert refused.revision == suite.calibration.revision == 0


def test_what_waits_for_the_mirror_waits_until_the_map_can_be_judged(
    suite: Suite, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite.shape()
    handle = suite.bench.hold.handle

    def move_when_released(operation: str, *rest: Any) -> None:
        handle(operation, *rest)
        if operation == HoldMirror.Request.RELEASE:
            suite.bench.move(suite.bench.mirror.rest)

    monkeypatch.setattr(suite.bench.hold, "handle", move_when_released)
    answer = suite.call(dry_run=True)
    assert answer.accepted, answer.message


def test_a_dry_run_goes_on_while_somebody_else_holds_the_mirror(suite: Suite) -> None:
    suite.shape()
    suite.bench.hold.handle(HoldMirror.Request.HOLD, "operator", "a test", 0.0, 60.0)
    assert suite.call().error_code == ErrorCode.BUSY
    answer = suite.call(dry_run=True)
    assert answer.accepted and suite.bench.hold.holder == "operator", answer.message


def test_a_mirror_that_has_changed_is_told(suite: Suite) -> None:
    quality = suite.calibration.quality
    before = np.array(suite.calibration.influence_sag)
    books = suite.observer.record(RecipeBookMsg, "recipes", qos.LATCHED)
    values = np.linspace(-0.5, 0.5, suite.bench.mirror.actuators)
    book = RecipeBook((Recipe(0.02, 0.0, values, values, 3e-10, 2e-9, 24),), 100, 1e-10)
    message = recipe_book_message(book, suite.calibration.id)
    stored = suite.observer.call(StoreRecipes, "store_recipes", StoreRecipes.Request(recipes=message))
    assert stored.error_code == ErrorCode.OK, stored.message
    wait_until(lambda: books and books[-1].recipes, 60)
    for bad in (1, 2, 3):
        suite.shape()
        suite.bench.publish_map(suite.bench.map(bump=100e-9))
        warned = partial(lambda number: suite.process.output.count("bad map, or the mirror has changed") == number, bad)
        wait_until(warned, 60)
        wait_until(lambda: not books[-1].recipes, 60, "recipes of the mirror as it was to be withdrawn")
        assert books[-1].degauss_steps == 100, "there are some"
        wait_until(lambda: suite.calibration.quality == Capabilities.APPROXIMATE, 60)
    assert quality == Capabilities.CALIBRATED
    told = "The last 3 maps disagree with this calibration"
    wait_until(lambda: suite.calibration.known_limitations[-1].startswith(told), 60, told)
    assert suite.calibration.quality == Capabilities.APPROXIMATE
    assert np.array_equal(np.array(suite.calibration.influence_sag), before)
    status = suite.status("the mirror has changed, calibrate again")
    assert status.level == b"\x01"


def test_a_stale_calibration_says_so(begin: Callable[..., Suite]) -> None:
    suite = begin(**{"updates.stale_after": 5.0})
    assert suite.status("Stale: no map has agreed with this calibration").level == b"\x01"
    wait_until(lambda: any(s.startswith("Stale") for s in suite.calibration.known_limitations), 60)
    suite.shape()
    assert suite.call().accepted
    wait_until(lambda: not any(s.startswith("Stale") for s in suite.calibration.known_limitations), 60)


def test_drift_beyond_its_limit_is_a_warning(begin: Callable[..., Suite]) -> None:
    suite = begin(**{"updates.gain_drift_max": 1e-9})
    suite.drift(2e-3)
    for _ in range(2):
        suite.shape()
        suite.call()
    status = suite.status("the gain of actuator")
    assert status.level == b"\x01"
    figures = {pair.key: pair.value for pair in status.values}
    assert f"actuator {figures['gain_drift_actuator']} has drifted by" in status.message
    assert figures["maps_taken"] == figures["revision"] == "2"


def test_with_a_hysteresis_an_unknown_history_is_refused_until_a_degauss(begin: Callable[..., Suite]) -> None:
    suite = begin(hysteresis=without_effect())
    suite.shape()
    refused = suite.call()
    assert refused.error_code == ErrorCode.MAP_REJECTED
    assert "the history of the actuators is not known" in refused.message
    suite.bench.on_degauss(0)
    suite.shape()
    taken = suite.call()
    assert taken.accepted, taken.message


@pytest.mark.parametrize("read", [True, False])
def test_maps_are_compared_with_the_creep_on_record(
    read: bool, begin: Callable[..., Suite], steady: SteadyMirror, tmp_path: Path
) -> None:
    """After a restart it compared with actuators that had crept to nothing, other than the controller's."""
    slowest = np.eye(len(CREEP_TIMES))[-1]
    fit = without_effect()
    fit = replace(fit, law=replace(fit.law, creep_rate=0.02, creep_time=CREEP_TIMES, creep_spectrum=slowest))
    bowl = 1e4 * (steady.mirror.x**2 + steady.mirror.y**2)
    crept = np.repeat(bowl[:, None], len(CREEP_TIMES), axis=1)
    record = CreepRecord(time.time() - 1.0, CREEP_TIMES, crept, np.zeros(len(CREEP_TIMES)), np.zeros((len(bowl), 0)))
    write_record(tmp_path / f"{steady.mirror.serial}.creep.npz", record)
    suite = begin(hysteresis=fit, state_folder=str(tmp_path) if read else "")
    suite.bench.on_degauss(0)
    suite.shape()
    taken = suite.call(dry_run=True)
    assert taken.error_code == ErrorCode.OK, taken.message
    # The mirror itself has no creep: what the record says of it is missing in the map.
    assert (taken.max_zernike > 1e-8) == read, taken.max_zernike


def test_a_damaged_file_of_updates_is_told(suite: Suite, begin: Callable[..., Suite]) -> None:
    suite.shape()
    suite.call()
    assert suite.process.stop() == 0
    (suite.folder / "steady.updates.hdf5").write_bytes(b"damaged")
    suite.received.clear()
    later = begin()
    assert later.calibration.revision == 0
    assert "updates of steady are ignored: steady.updates.hdf5: not a whole HDF5 file" in later.process.output


def test_without_a_calibration(start: Callable[..., NodeProcess], observer: Observer, tmp_path: Path) -> None:
    start("dm_calibration", "calibration", {"calibration_folder": str(tmp_path)})
    for fields in ({}, {"forget": True}):
        answer = observer.call(UpdateCalibration, "update_calibration", UpdateCalibration.Request(**fields))
        assert answer.error_code == ErrorCode.NOT_CALIBRATED
        assert answer.message == NO_CALIBRATION
