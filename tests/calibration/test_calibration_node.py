"""The node `calibration` over DDS, with a linear mirror behind stand-ins for driver and interferometer."""

from __future__ import annotations

import resource
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any, cast
from unittest.mock import MagicMock

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from dm_msgs.action import Calibrate
from dm_msgs.msg import ActuatorState, Capabilities, MirrorInfo
from dm_msgs.msg import Calibration as CalibrationMsg
from dm_msgs.srv import FitInfluenceFunction, ListCalibrations, LoadCalibration
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.parameter import Parameter

from calibration_stand_in import StandIn, doubles
from dm_calibration import calibration_action
from dm_calibration.calibration_node import CalibrationNode
from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.procedure.plan import PlanKind, PlanOptions
from dm_calibration.procedure.recorded_run import planned
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.errors import NO_CALIBRATION, ErrorCode, Refusal
from dm_common.messages import mirror_info_of
from dm_common.optics.piston_tilt import remove_piston_tilt
from dm_common.ros import qos
from linear_mirror import LinearMirror, hexagon, make_mirror
from recorded_bench import recorded
from support import NodeProcess, Observer, wait_until

RINGS = 2
ACTUATORS = 19


@pytest.fixture
def bench(observer: Observer) -> StandIn:
    mirror = make_mirror(RINGS)
    return StandIn(observer.node, mirror, LinearMirror(mirror.x, mirror.y, noise=1e-9, piston_tilt=1e-6))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "calibrations"


@pytest.fixture
def node(start: Callable[..., NodeProcess], bench: StandIn, folder: Path) -> Iterator[NodeProcess]:
    process = start("dm_calibration", "calibration", parameters(folder))
    yield process
    assert "Traceback" not in process.output, process.output


def parameters(folder: Path, **changes: Any) -> dict[str, Any]:
    return {
        "calibration_folder": str(folder),
        "settle_time": 0.01,
        "measure_retries": 1,
        "write_report": False,
    } | changes


def pokes(**fields: Any) -> Calibrate.Goal:
    return Calibrate.Goal(plan=Calibrate.Goal.PLAN_POKES, activate=True, **fields)


def ready(observer: Observer, process: NodeProcess) -> list[Any]:
    """Wait until the node has published and knows the mirror; returns what it publishes on `calibration`."""
    received = observer.record(CalibrationMsg, "calibration", qos.LATCHED)
    health = observer.record(DiagnosticArray, "/diagnostics")
    wait_until(
        lambda: received and any("no mirror_info" not in m.status[0].message for m in health), 60, process.output
    )
    return received


def test_calibrate_store_publish_and_serve(node: NodeProcess, bench: StandIn, observer: Observer, folder: Path) -> None:
    received = ready(observer, node)
    assert received[0].id == ""
    bench.failing = {"poke+04"}
    seen: list[Any] = []
    _, future = observer.send_goal(
        Calibrate, "calibrate", pokes(note="on the bench"), lambda message: seen.append(message.feedback)
    )
    wait_until(lambda: bench.measured, 60)
    second = observer.run_goal(Calibrate, "calibrate", pokes()).result
    assert second.error_code == ErrorCode.BUSY and "action calibrate has been running" in second.message
    wait_until(future.done, 60, node.output)
    result = future.result().result
    assert future.result().status == GoalStatus.STATUS_SUCCEEDED
    assert result.error_code == ErrorCode.OK, result.message
    assert "the mirror is back at mid range" in result.message
    assert (bench.signals == 0.0).all()
    assert bench.degaussed == 1
    assert bench.measured.count("poke+04") == 2
    assert result.maps == 2 * ACTUATORS + 5 - 1
    assert list(result.dropped) == ["poke+04: measure: no new file within 5 s (2 tries)"]
    assert result.maps_dropped == 1
    assert result.poke_check_passed and not result.poke_findings
    assert 0.0 < result.in_sample_rms < 1.5e-9 and result.held_out_rms < 4e-9
    assert result.duration > 0.0
    assert seen and all(feedback.steps == 2 * ACTUATORS + 6 for feedback in seen)
    assert [phase for phase, _ in groupby(feedback.phase for feedback in seen)][-3:] == ["pokes", "fit", "store"]
    plan, maps_per_state = planned(seen[0].plan, make_mirror(RINGS))
    assert plan.kind is PlanKind.POKES and len(plan.steps) == seen[0].steps and maps_per_state == 1

    message = wait_until(lambda: received[-1] if received[-1].id else None, 60)
    assert message.id == result.id and message.file == result.file == str(folder / f"{result.id}.h5")
    assert message.actuators == ACTUATORS
    true = remove_piston_tilt(bench.plant.influence.T, bench.plant.points).T
    assert np.abs(np.array(message.influence_sag).reshape(300, ACTUATORS) - true).max() < 15e-9
    assert np.array(message.influence_zernike).reshape(21, ACTUATORS)[3:] == pytest.approx(
        bench.plant.fit_terms(bench.plant.influence.T).T[3:], abs=5e-9
    )
    assert (message.mirror_serial, message.wavelength) == ("T-1", 632.8e-9)
    assert message.quality == Capabilities.CALIBRATED
    assert list(message.actuator_grade) == ["good"] * ACTUATORS
    assert message.header.frame_id == "mirror" and message.header.stamp.sec > 0

    stored = CalibrationStore(folder).load(result.id)
    assert stored.note == "on the bench"
    assert stored.maps.file[0] == "/maps/reference 1.dat"
    assert np.array_equal(stored.fit.influence_sag.ravel(), np.array(message.influence_sag))

    # Refit without one map, then list both and go back to the first.
    fitted = observer.call(
        FitInfluenceFunction, "fit_influence_function", FitInfluenceFunction.Request(exclude=["poke-02"], activate=True)
    )
    assert fitted.error_code == ErrorCode.OK, fitted.message
    assert fitted.id != result.id
    wait_until(lambda: received[-1].id == fitted.id, 60)
    assert received[-1].maps_used == result.maps - 1
    unknown = observer.call(
        FitInfluenceFunction, "fit_influence_function", FitInfluenceFunction.Request(exclude=["poke-99"])
    )
    assert unknown.error_code == ErrorCode.UNKNOWN_NAME and "poke-99" in unknown.message
    wrong = observer.call(FitInfluenceFunction, "fit_influence_function", FitInfluenceFunction.Request(method="AZx"))
    assert wrong.error_code == ErrorCode.UNKNOWN_NAME and "AZreg" in wrong.message
    few = [f"poke-{k:02d}" for k in range(1, ACTUATORS + 1)] + [f"reference {k}" for k in range(2, 6)]
    wrong = observer.call(
        FitInfluenceFunction, "fit_influence_function", FitInfluenceFunction.Request(exclude=few, activate=True)
    )
    assert wrong.error_code == ErrorCode.TOO_FEW_MAPS and "leave out fewer maps" in wrong.message, wrong.message
    assert received[-1].id == fitted.id

    (folder / "broken.h5").write_bytes(Path(result.file).read_bytes()[:5000])
    listed = observer.call(ListCalibrations, "list_calibrations")
    remarks = dict(zip(listed.ids, listed.remarks, strict=True))
    assert remarks[fitted.id] == "in use" and remarks[result.id] == ""
    assert "not a whole HDF5 file" in remarks["broken"]
    loaded = observer.call(LoadCalibration, "load_calibration", LoadCalibration.Request(calibration=result.id))
    assert loaded.error_code == ErrorCode.OK and loaded.id == result.id
    wait_until(lambda: received[-1].id == result.id, 60)
    for name, code in (
        ("broken", ErrorCode.CALIBRATION_UNREADABLE),
        ("../x", ErrorCode.UNKNOWN_NAME),
        ("nothing", ErrorCode.UNKNOWN_NAME),
    ):
        refused = observer.call(LoadCalibration, "load_calibration", LoadCalibration.Request(calibration=name))
        assert refused.error_code == code, refused.message

    # Another mirror: the calibration is withdrawn, and refused when asked for.
    bench.publish_info(make_mirror(RINGS, serial="T-2"))
    wait_until(lambda: received[-1].id == "", 60)
    refused = observer.call(LoadCalibration, "load_calibration", LoadCalibration.Request(calibration=result.id))
    assert refused.error_code == ErrorCode.CALIBRATION_MISMATCH
    assert "'T-1', this is 'T-2'" in refused.message
    newest = observer.call(LoadCalibration, "load_calibration")
    assert newest.error_code == ErrorCode.NOT_CALIBRATED
    bench.publish_info(bench.mirror)
    newest = wait_until(
        lambda: (r := observer.call(LoadCalibration, "load_calibration")).error_code == ErrorCode.OK and r, 10
    )
    assert newest.id == fitted.id


def test_a_fit_in_the_middle_of_a_run_is_reported_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[Any] = []
    action = MagicMock(_feedback=Calibrate.Feedback(phase="hysteresis", step=9))

    def report(phase: str, _label: str, step: int) -> None:
        action._feedback.phase = phase
        said.append((phase, step))

    action._report = report
    for name in ("plan_text", "procedure_options"):
        monkeypatch.setattr(calibration_action, name, MagicMock(return_value=""))
    monkeypatch.setattr(calibration_action, "Procedure", lambda *_parts, **options: options["enough"])
    enough: Any = calibration_action.CalibrateAction._procedure(action, MagicMock(), cast(Any, said.append))
    enough("fitted")
    assert said == [("fit", 9), "fitted"] and action._feedback.phase == "hysteresis"


@pytest.mark.parametrize("deactivated", [False, True])
def test_cancel_brings_the_mirror_back(
    node: NodeProcess, bench: StandIn, observer: Observer, folder: Path, deactivated: bool
) -> None:
    received = ready(observer, node)
    handle, future = observer.send_goal(Calibrate, "calibrate", pokes(settle_time=0.2))
    wait_until(lambda: len(bench.measured) >= 3, 60, node.output)
    if deactivated:
        rest = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
        assert observer.call(ChangeState, "calibration/change_state", rest).success
    else:
        handle.cancel_goal_async()
    wait_until(future.done, 60, node.output)
    result = future.result().result
    assert future.result().status == (GoalStatus.STATUS_ABORTED if deactivated else GoalStatus.STATUS_CANCELED)
    if deactivated:
        assert "calibration was deactivated" in result.message
        assert observer.call(ListCalibrations, "list_calibrations").error_code == ErrorCode.NODE_INACTIVE
    assert result.error_code == ErrorCode.CANCELED
    assert "the mirror is back at mid range" in result.message
    assert (bench.signals == 0.0).all()
    assert len(bench.measured) < 8
    assert not list(folder.glob("*.h5")) and received[-1].id == ""


def test_poke_check_names_what_differs(start: Callable[..., NodeProcess], observer: Observer, folder: Path) -> None:
    mirror = make_mirror(RINGS)
    x, y = hexagon(RINGS)
    order = np.arange(ACTUATORS)
    order[[2, 6]] = order[[6, 2]]
    bench = StandIn(observer.node, mirror, LinearMirror(x[order], y[order], noise=1e-9))
    process = start("dm_calibration", "calibration", parameters(folder))
    received = ready(observer, process)
    check = Calibrate.Goal(plan=Calibrate.Goal.PLAN_POKE_CHECK)
    result = observer.run_goal(Calibrate, "calibrate", check, 60).result
    assert result.error_code == ErrorCode.POKE_CHECK_FAILED
    assert list(result.poke_findings) == ["actuators 3 and 7 are exchanged"]
    assert not result.poke_check_passed and not list(folder.glob("*.h5"))
    assert (bench.signals == 0.0).all()
    # A calibration is stored all the same, with the finding in it, and used, with a warning if this cannot be noted.
    (folder / "in_use_T-1.txt").mkdir()
    result = observer.run_goal(Calibrate, "calibrate", pokes(), 60).result
    assert result.error_code == ErrorCode.OK and not result.poke_check_passed
    assert "could not be noted" in result.warning and result.warning in result.message
    wait_until(lambda: received[-1].id == result.id, 60)
    assert any("actuators 3 and 7 are exchanged" in sentence for sentence in received[-1].known_limitations)


def test_failures_are_told_and_leave_things_as_they_were(
    start: Callable[..., NodeProcess], bench: StandIn, observer: Observer, folder: Path
) -> None:
    first = start("dm_calibration", "calibration", parameters(folder))
    ready(observer, first)
    kept = observer.run_goal(Calibrate, "calibrate", pokes(), 60).result
    assert kept.error_code == ErrorCode.OK, kept.message
    assert first.stop() == 0

    process = start("dm_calibration", "calibration", parameters(folder, load_on_start="newest"))
    received = ready(observer, process)
    wait_until(lambda: received[-1].id == kept.id, 60, process.output)

    def run(goal: Calibrate.Goal, code: int, words: str) -> Any:
        result = observer.run_goal(Calibrate, "calibrate", goal, 60).result
        assert (result.error_code, words in result.message) == (code, True), result.message
        assert (bench.signals == 0.0).all()
        assert received[-1].id == kept.id
        return result

    run(pokes(poke_amplitude=float("nan")), ErrorCode.NOT_FINITE, "poke_amplitude = nan: must be float, 0.01 to 1")
    run(pokes(settle_time=-1.0), ErrorCode.OUT_OF_RANGE, "settle_time = -1.0")
    run(Calibrate.Goal(plan="all"), ErrorCode.UNKNOWN_NAME, "plan = 'all': must be one of empty, full, pokes")
    unknown = Calibrate.Goal(plan=Calibrate.Goal.PLAN_SURFACES, surfaces=["p60"])
    run(unknown, ErrorCode.UNKNOWN_NAME, "surface 'p60' is unknown; did you mean")
    all_pokes = {f"poke{mark}{k:02d}" for mark in "+-" for k in range(1, 20)}
    bench.failing = all_pokes
    result = run(pokes(), ErrorCode.MAP_TIMEOUT, "3 states in a row gave no map")
    assert len(result.dropped) == 3 and result.maps == 1
    bench.failing, bench.other_wavelength = set(), all_pokes
    run(
        pokes(),
        ErrorCode.MAP_REJECTED,
        "wavelength 635.000 nm, in the maps before 632.800 nm (0 = not known): never mix",
    )
    bench.other_wavelength, bench.other_aperture = set(), all_pokes
    run(pokes(), ErrorCode.MAP_REJECTED, "aperture radius 10.000 mm, the mirror's is 11.000 mm")
    bench.other_aperture = set()
    few = Calibrate.Goal(plan=Calibrate.Goal.PLAN_SURFACES, surfaces=["p01", "p05"])
    run(few, ErrorCode.TOO_FEW_MAPS, "good maps")
    bench.publish_state(ActuatorState.STATE_INACTIVE)
    run(pokes(), ErrorCode.DRIVER_INACTIVE, "pdm_driver is not active")
    bench.publish_state(ActuatorState.STATE_ACTIVE)

    # Files of the node may not grow any more, as on a full disk.
    files = sorted(path.name for path in folder.glob("*.h5"))
    resource.prlimit(process.process.pid, resource.RLIMIT_FSIZE, (20000, resource.RLIM_INFINITY))
    result = run(pokes(), ErrorCode.STORAGE_FAILED, "no room for the maps of a run")
    assert result.id == "" and result.file == ""
    assert sorted(path.name for path in folder.glob("*.h5")) == files
    # The limit counts for files in memory too, through which the node's helper reads HDF5; a full disk does not.
    resource.prlimit(process.process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    again = observer.call(LoadCalibration, "load_calibration", LoadCalibration.Request(calibration=kept.id))
    assert again.error_code == ErrorCode.OK


def test_somebody_else_commands_meanwhile(node: NodeProcess, bench: StandIn, observer: Observer) -> None:
    ready(observer, node)
    bench.disturbed_at = "poke+02"
    result = observer.run_goal(Calibrate, "calibrate", pokes(), 60).result
    assert result.error_code == ErrorCode.PREEMPTED
    assert "another program commanded the mirror" in result.message
    assert (bench.signals == 0.0).all()


def test_the_driver_is_deactivated_meanwhile(node: NodeProcess, bench: StandIn, observer: Observer) -> None:
    def deactivate() -> None:
        bench.driver_state = ActuatorState.STATE_INACTIVE
        bench.move(bench.mirror.rest)

    ready(observer, node)
    bench.on_label["poke+02"] = deactivate
    result = observer.run_goal(Calibrate, "calibrate", pokes(), 60).result
    assert result.error_code == ErrorCode.DRIVER_INACTIVE
    assert "activate it first" in result.message and "the mirror is left as it is" in result.message


def test_neighbours_that_are_not_there(start: Callable[..., NodeProcess], observer: Observer, folder: Path) -> None:
    process = start("dm_calibration", "calibration", parameters(folder, driver_timeout=0.3, degauss_timeout=0.3))
    observer.record(CalibrationMsg, "calibration", qos.LATCHED)
    result = observer.run_goal(Calibrate, "calibrate", pokes(), 60).result
    assert result.error_code == ErrorCode.DRIVER_UNAVAILABLE and "no mirror_info yet" in result.message
    publisher = observer.node.create_publisher(MirrorInfo, "mirror_info", qos.LATCHED)
    mirror = make_mirror(RINGS)
    message = MirrorInfo(name="m", serial="s", actuators=ACTUATORS, working_aperture_diameter=22e-3)
    message.signal_min, message.signal_max, message.neighbour_difference_max = -1.0, 1.0, 2.0
    publisher.publish(message)  # without positions: refused, the node lives on
    wait_until(lambda: "mirror_info refused: mirror_info: actuator_x has 0 values" in process.output, 60)
    message.actuator_x, message.actuator_y = doubles(mirror.x), doubles(mirror.y)
    publisher.publish(message)
    health = observer.record(DiagnosticArray, "/diagnostics")
    wait_until(lambda: any(m.status[0].message == NO_CALIBRATION for m in health), 60)
    result = observer.run_goal(Calibrate, "calibrate", pokes(), 60).result
    assert result.error_code == ErrorCode.DRIVER_UNAVAILABLE
    assert "the node pdm_driver is not running: start it" in result.message


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ended_in_the_middle_the_mirror_still_goes_back(
    number: int, start: Callable[..., NodeProcess], bench: StandIn, observer: Observer, folder: Path
) -> None:
    process = start("dm_calibration", "calibration", parameters(folder))
    ready(observer, process)
    observer.send_goal(Calibrate, "calibrate", pokes(settle_time=0.3))
    wait_until(lambda: (bench.signals != 0.0).any() and len(bench.measured) > 2, 60, process.output)
    assert process.stop(number) == 0
    assert (bench.signals == 0.0).all(), process.output
    assert "Traceback" not in process.output, process.output


def test_ended_in_a_dry_run_the_mirror_stays_where_it_is(observer: Observer, monkeypatch: pytest.MonkeyPatch) -> None:
    node, moved = CalibrationNode(), list[Any]()
    monkeypatch.setattr(node._bench_services, "rest_at_exit", moved.append)
    node._manager.set_mirror(make_mirror(RINGS))
    node._server._running = 1
    node.make_safe()
    assert not moved
    with node._bench_services.hold._one:  # a run has the mirror
        node.make_safe()
    assert len(moved) == 1
    node.destroy_node()


def test_another_folder_or_name_takes_effect_with_the_next_activation(
    observer: Observer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, outcome = recorded(PlanKind.POKES, PlanOptions())
    folders = {"first": ("a", "b"), "other": ("c",)}
    for name, identifiers in folders.items():
        for created, identifier in enumerate(identifiers):
            made = calibrate(outcome, mirror=run.mirror, provenance=Provenance(identifier, created + 1))
            CalibrationStore(tmp_path / name).save(made)
    node = CalibrationNode()
    manager = node._manager

    def activate(in_use: str, **changes: str) -> None:
        if node.active:
            node.trigger_deactivate()
        results = node.set_parameters([Parameter(name, value=value) for name, value in changes.items()])
        assert all(result.successful for result in results)
        node.trigger_activate()
        wait_until(lambda: manager.in_use is not None and manager.in_use.id == in_use)

    manager.set_mirror(run.mirror)
    node.trigger_configure()
    activate("b", calibration_folder=str(tmp_path / "first"), load_on_start="newest")
    activate("a", load_on_start="a")
    activate("a")  # nothing changed: what is in use stays
    activate("c", calibration_folder=str(tmp_path / "other"), load_on_start="newest")
    activate("c", load_on_start="")
    activate("c", calibration_folder="")
    assert not node.active and "calibration_folder is empty" in node.inactive()
    activate("c", calibration_folder=str(tmp_path / "other"))
    assert node.active
    sent: list[Any] = []  # what others judge by reaches them at once
    monkeypatch.setattr(node._publisher, "publish", sent.append)
    assert node.set_parameters([Parameter("aperture_tolerance", value=0.05)])[0].successful
    assert (sent[-1].id, sent[-1].aperture_tolerance) == ("c", 0.05)
    sent.clear()
    assert node.set_parameters([Parameter("updates.surprises_max", value=5)])[0].successful and sent
    followed: list[float] = []  # so does the mid range that a degauss ends at, whose limits may be set anew
    monkeypatch.setattr(node._listener.history, "follow", lambda _law, middle: followed.append(middle))
    mirror, known = run.mirror, {"neighbour_difference_max": 2.0, "signal_min": -0.5, "signal_max": 1.0}
    message = MirrorInfo(name=mirror.name, serial=mirror.serial, actuators=mirror.actuators, **known)
    message.working_aperture_diameter = 2.0 * mirror.working_radius
    message.actuator_x, message.actuator_y = doubles(mirror.x), doubles(mirror.y)
    node._on_mirror_info(message)
    assert followed == [0.25] and sent[-1].id == "c"
    node.trigger_shutdown()
    assert manager.in_use is None
    node.destroy_node()


def test_each_mirror_gets_the_calibration_that_it_used_last(observer: Observer, tmp_path: Path) -> None:
    run, outcome = recorded(PlanKind.POKES, PlanOptions())
    store = CalibrationStore(tmp_path)
    for created, serial in enumerate("AB"):
        store.save(
            calibrate(outcome, mirror=replace(run.mirror, serial=serial), provenance=Provenance(serial, created + 1))
        )
    node = CalibrationNode()
    assert node.set_parameters([Parameter("calibration_folder", value=str(tmp_path))])[0].successful
    node.trigger_configure()
    node.trigger_activate()
    manager = node._manager
    for serial in "ABAB":
        node._on_mirror_info(mirror_info_of(replace(run.mirror, serial=serial)))
        wait_until(lambda serial=serial: manager.in_use is not None and manager.in_use.id == serial)  # type: ignore[misc]
    # One of another mirror, as at the end of a run in which the mirror was changed, is not put into use.
    with pytest.raises(Refusal, match="A is stored, but not used: measured on mirror serial 'A', this is 'B'"):
        manager.use(store.load("A"))
    assert manager.in_use is not None and manager.in_use.id == "B"
    node.destroy_node()
