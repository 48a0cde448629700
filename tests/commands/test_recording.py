"""Recordings: as rosbag2 writes them, read by others, published again, and a calibration made again from one."""

from __future__ import annotations

import json
import math
import os
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from dm_msgs.action import Calibrate
from dm_msgs.msg import (
    ActuatorCommand,
    ActuatorHysteresis,
    ActuatorState,
    Calibration,
    MirrorInfo,
    SurfaceMapInfo,
    SurfaceSamples,
    ZernikeCoefficients,
)
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from sensor_msgs.msg import Image
from typer.testing import CliRunner

from dm_calibration.calibration_messages import calibration_message
from dm_calibration.calibration_parameters import PARAMETERS
from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.influence.fit import FitOptions
from dm_calibration.procedure.plan import PlanKind, PlanOptions
from dm_calibration.procedure.recorded_run import RecordedRun, RecordingError
from dm_common.messages import doubles, mirror_info_of, taken, time_message
from dm_common.ros import qos
from dm_tools.cli import make_app
from dm_tools.output import NotRunningError
from dm_tools.recording.bag import PARAMETER_EVENTS, BagError, BagReader, BagWriter, Message, Topic, offered
from dm_tools.recording.interfaces import UnknownTypeError, definition, message_class
from dm_tools.recording.player import play, replayed
from dm_tools.recording.recorder import Recorder
from dm_tools.recording.session import COMPARED, _parameters, differences, read_session, recalibrate
from dm_tools.verbs.record import record
from dm_tools.verbs.replay import _recalibrated
from recorded_bench import recorded
from support import Observer, wait_until

FEEDBACK_TYPE = "dm_msgs/action/Calibrate_FeedbackMessage"
#: Of a type that another version recorded.
OTHER_LAYOUT = "RIHS01_" + 64 * "0"


def write_bag(folder: Path, messages: list[tuple[str, Any]]) -> BagReader:
    """A recording of (topic, message) pairs, a millisecond apart; what is on `/old` had another layout."""
    with closing(BagWriter(folder)) as bag:
        for number, (name, message) in enumerate(messages, start=1):
            kind = type(message)
            action = kind.__name__ == "Calibrate_FeedbackMessage"
            type_name = FEEDBACK_TYPE if action else f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
            if name not in bag.counts:
                type_hash = OTHER_LAYOUT if name == "/old" else "INVALID"
                bag.add_topic(Topic(name, type_name, [offered(qos.STATE)], type_hash), definition(type_name))
            bag.write(name, serialize_message(message), number * 10**6)
    return BagReader(folder)


def nodes_recorded(recorder: Recorder) -> int:
    """How many nodes have told their parameters, one that was started anew counted again."""
    return sum(again == math.inf for again in recorder._retry_at.values())


def write_rosbag2(folder: Path, messages: list[Message], storage: str) -> None:
    """A recording of another tool, which asks no node for its parameters; the hashes of types are not known."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]) as bag:
        topics = {message.topic.name: message.topic for message in messages}
        connections = {
            name: bag.add_connection(
                name,
                topic.type_name,
                msgdef=definition(topic.type_name),
                rihs01=topic.type_hash,
                offered_qos_profiles=topic.qos,
            )
            for name, topic in topics.items()
        }
        for message in messages:
            bag.write(connections[message.topic.name], message.log_time, message.data)


def session_messages(run: RecordedRun) -> list[tuple[str, Any]]:
    """The topics of a run as the nodes publish them: feedback, then moves and maps in the order of their stamps."""
    rest = doubles(run.mirror.rest)
    messages: list[tuple[str, Any]] = [
        ("/mirror_info", mirror_info_of(run.mirror)),
        ("/actuator_state", ActuatorState(requested=rest, applied=rest, turns=7, degausses=2)),
    ]
    message = Calibrate.Impl.FeedbackMessage(feedback=Calibrate.Feedback(plan=run.plan))
    messages.append(("/calibrate/_action/feedback", message))
    events: list[tuple[int, list[tuple[str, Any]]]] = []
    degausses = 2
    for number, move in enumerate(run.moves, start=8):
        degausses += move.degauss
        state = ActuatorState(requested=doubles(move.requested), applied=doubles(move.applied))
        state.header.stamp, state.turns, state.degausses = time_message(move.stamp_ns), number, degausses
        # The driver reports periodically too: the same state twice is one move.
        events.append((move.stamp_ns, [("/actuator_state", state), ("/actuator_state", state)]))
    for measured in run.maps:
        zernike = ZernikeCoefficients(
            radius=measured.radius,
            wavelength=measured.wavelength,
            coefficients=doubles(measured.coefficients),
            sigma=doubles(measured.sigma),
            residual_rms=measured.residual_rms,
        )
        points = measured.points
        samples = SurfaceSamples(
            x=doubles(points.x), y=doubles(points.y), weight=doubles(points.weight), sag=doubles(measured.sag)
        )
        info = SurfaceMapInfo(
            system_error_subtracted=-1,
            valid_fraction=measured.valid_fraction,
            **taken(measured, "file", "sha256"),
        )
        named = {"/surface_map_info": info, "/zernike": zernike, "/surface_samples": samples}
        for message in named.values():
            message.header.stamp = time_message(measured.stamp_ns)
        events.append((measured.stamp_ns, list(named.items())))
    for _stamp, published in sorted(events, key=lambda event: event[0]):
        messages += published
    return messages


@pytest.fixture(scope="module")
def run_and_bag(tmp_path_factory: pytest.TempPathFactory) -> tuple[RecordedRun, Any, BagReader]:
    """A run, the message it ended with live, and its recording."""
    run, outcome = recorded(PlanKind.FULL, PlanOptions(poke_amplitude=0.4))
    live = calibrate(outcome, mirror=run.mirror, options=FitOptions(), provenance=Provenance("live", 1))
    message = calibration_message(live, None, "mirror", 32e-9)
    folder = tmp_path_factory.mktemp("bag") / "session"
    values = {parameter.name: parameter.default for parameter in PARAMETERS} | {"poke_amplitude": 0.4}
    changes = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    event = (PARAMETER_EVENTS, ParameterEvent(node="/calibration", new_parameters=changes))
    bag = write_bag(folder, [*session_messages(run), event, ("/calibration", message)])
    return run, message, bag


@pytest.mark.slow
def test_a_calibration_made_again_is_the_same_to_the_last_bit(run_and_bag: tuple[RecordedRun, Any, BagReader]) -> None:
    _run, live, bag = run_and_bag
    session = read_session(bag)
    assert session.published.id == "live"
    assert not session.remarks
    again = recalibrate(session, "again", 2)
    assert differences(again, live) == []
    assert np.array(live.influence_sag).tobytes() == again.fit.influence_sag.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_recording_of_rosbag2_gives_the_same_calibration(
    run_and_bag: tuple[RecordedRun, Any, BagReader], tmp_path: Path, storage: str
) -> None:
    _run, live, ours = run_and_bag
    folder = tmp_path / "theirs"
    names = [name for name in ours.topics if name != PARAMETER_EVENTS]
    write_rosbag2(folder, list(ours.read(names)), storage)
    theirs = BagReader(folder)
    assert theirs.counts == {name: ours.counts[name] for name in names}
    assert theirs.messages == ours.messages - 1 and theirs.duration_s == ours.duration_s
    assert theirs.topics["/zernike"].qos == [offered(qos.STATE)]
    assert [message.data for message in theirs.read(["/zernike"])] == [m.data for m in ours.read(["/zernike"])]
    session = read_session(theirs)
    assert "does not hold all parameters" in session.remarks[0]  # which rosbag2 does not ask for
    session.parameters["poke_amplitude"] = 0.4
    assert differences(recalibrate(session, "again", 2), live) == []


@pytest.mark.slow
def test_a_recording_without_hidden_topics_says_how_to_make_one(
    run_and_bag: tuple[RecordedRun, Any, BagReader], tmp_path: Path
) -> None:
    messages = [message for message in run_and_bag[2].read() if "/_" not in message.topic.name]
    write_rosbag2(tmp_path / "theirs", messages, "mcap")
    with pytest.raises(RecordingError, match="--include-hidden-topics"):
        read_session(BagReader(tmp_path / "theirs"))


@pytest.mark.slow
def test_a_recording_of_another_version_is_refused(
    run_and_bag: tuple[RecordedRun, Any, BagReader], tmp_path: Path
) -> None:
    """Whose feedback had a field less."""
    shorter = [replace(m, data=m.data[: -4 if "/_" in m.topic.name else None]) for m in run_and_bag[2].read()]
    write_rosbag2(tmp_path / "theirs", shorter, "mcap")
    with pytest.raises(RecordingError, match="feedback: dm_msgs/action/Calibrate_FeedbackMessage had another layout"):
        read_session(BagReader(tmp_path / "theirs"))


@pytest.mark.slow
def test_a_difference_of_one_bit_is_found(run_and_bag: tuple[RecordedRun, Any, BagReader]) -> None:
    _run, live, bag = run_and_bag
    again = recalibrate(read_session(bag), "again", 2)
    before = live.influence_sag[1234]
    live.influence_sag[1234] = float(np.nextafter(before, 1.0))
    try:
        assert differences(again, live) == ["influence_sag"]
    finally:
        live.influence_sag[1234] = before
    assert "influence_sag" in COMPARED


def test_maps_after_a_run_do_not_hide_what_it_published(
    run_and_bag: tuple[RecordedRun, Any, BagReader], tmp_path: Path
) -> None:
    run, live, _bag = run_and_bag
    checked = replace(run.maps[-1], stamp_ns=run.maps[-1].stamp_ns + 10**9)
    later = session_messages(replace(run, moves=(), maps=(checked,)))[3:]  # without mirror, state and feedback
    bag = write_bag(tmp_path / "longer", [*session_messages(run), ("/calibration", live), *later])
    assert read_session(bag).published.id == "live"


def test_the_whole_law_is_compared() -> None:
    fields = {f"hysteresis.{name}" for name in ActuatorHysteresis.get_fields_and_field_types()}
    beside = {"law", "powers", "crept_at", "held_out_max_zernike", "unknown_sigma"}
    assert fields - set(COMPARED) == {f"hysteresis.{name}" for name in beside}


@pytest.mark.slow
def test_the_command_recalibrates_and_stores(run_and_bag: tuple[RecordedRun, Any, BagReader], tmp_path: Path) -> None:
    bag, figures = run_and_bag[2], tmp_path / "figures.json"
    command = [sys.executable, "-m", "dm_tools", "replay", str(bag.path), "--recalibrate"]
    done = subprocess.run(
        [*command, "--store", str(tmp_path / "store"), "--json", str(figures)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "the same as live to the last bit" in done.stdout
    report = json.loads(figures.read_text())
    assert report["identical"] is True and Path(report["file"]).is_file()


@pytest.mark.slow
def test_the_command_takes_parameters_that_a_recording_of_rosbag2_does_not_hold(
    run_and_bag: tuple[RecordedRun, Any, BagReader], tmp_path: Path
) -> None:
    held = [
        replace(message, topic=replace(message.topic, name=f"/left{message.topic.name}"))
        for message in run_and_bag[2].read()
        if message.topic.name != PARAMETER_EVENTS
    ]
    write_rosbag2(tmp_path / "theirs", held, "mcap")
    config, section = tmp_path / "bench.yaml", "/calibration: {ros__parameters: {poke_amplitude: 0."
    config.write_text(f"/left{section}4}}}}\n/right{section}3}}}}\n")
    figures = _recalibrated(BagReader(tmp_path / "theirs"), 0, "/left", None, config)
    assert figures["identical"] is True
    config.write_text("/calibration: {ros__parameters: {poke_amplitud: 0.4}}\n")
    with pytest.raises(ValueError, match=r"bench\.yaml: calibration: parameter 'poke_amplitud' is unknown"):
        _recalibrated(BagReader(tmp_path / "theirs"), 0, "/left", None, config)


def test_a_recording_without_a_run_is_told(tmp_path: Path) -> None:
    run, _outcome = recorded(PlanKind.POKES, PlanOptions())
    bag = write_bag(tmp_path / "bag", session_messages(run)[:2])
    with pytest.raises(RecordingError, match="no topic /zernike"):
        read_session(bag)


def test_definitions_hold_every_type_they_use() -> None:
    text = definition(FEEDBACK_TYPE)
    assert text.startswith("unique_identifier_msgs/UUID goal_id")
    assert "MSG: dm_msgs/action/Calibrate_Feedback\n" in text and "MSG: unique_identifier_msgs/UUID\n" in text
    assert "MSG: builtin_interfaces/Time\n" in definition("dm_msgs/msg/Calibration")
    with pytest.raises(UnknownTypeError, match="no_such_msgs/msg/Thing"):
        message_class("no_such_msgs/msg/Thing")


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", [("/actuator_state", ActuatorState())])
    (tmp_path / "link").symlink_to("nowhere")
    for name in ("bag", "link"):
        with pytest.raises(FileExistsError, match="never overwritten"):
            BagWriter(tmp_path / name)


def flipped(content: bytes, at: int) -> bytes:
    """With another last bit of one byte."""
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


@pytest.mark.parametrize("damage", ["cut", "bit", "index", "foreign", "absent"])
def test_a_damaged_recording_is_refused(tmp_path: Path, damage: str) -> None:
    noise = np.random.default_rng(1).normal(size=(50, 63))  # which compression keeps as it is
    write_bag(tmp_path / "bag", [("/actuator_state", ActuatorState(applied=doubles(row))) for row in noise])
    (file,) = (tmp_path / "bag").glob("*.mcap")
    content = file.read_bytes()
    span = struct.pack("<QQ", 10**6, 50 * 10**6)  # of time: last in the statistics, before that in the index
    middle, index = len(content) // 2, content.rindex(span, 0, content.rindex(span))
    damaged = {
        "cut": content[:middle],
        "bit": flipped(content, middle),
        "index": flipped(content, index),
        "foreign": b"no recording at all",
    }
    if damage == "absent":
        file.unlink()
    else:
        file.write_bytes(damaged[damage])
    with pytest.raises(BagError, match="bag: no recording, or damaged: "):
        list(BagReader(tmp_path / "bag").read())


def test_what_was_told_of_a_topic_elsewhere_hides_no_message(tmp_path: Path) -> None:
    """The metadata of genuine recordings may tell another quality of service than the file does."""
    write_bag(tmp_path / "bag", [("/actuator_state", ActuatorState())])
    metadata = tmp_path / "bag" / "metadata.yaml"
    text = metadata.read_text()
    assert "reliability: reliable" in text
    metadata.write_text(text.replace("reliability: reliable", "reliability: best_effort"))
    bag = BagReader(tmp_path / "bag")
    assert bag.messages == len(list(bag.read())) == 1


def test_a_file_by_itself_is_a_recording(tmp_path: Path) -> None:
    """And stands for the whole, which knows the hashes of types, where it is the only one."""
    write_bag(tmp_path / "bag", [("/old", ActuatorState())])
    (file,) = (tmp_path / "bag").glob("*.mcap")
    assert BagReader(file).topics["/old"].type_hash == OTHER_LAYOUT
    copied = tmp_path / "copied.mcap"
    copied.write_bytes(file.read_bytes())
    assert BagReader(copied).messages == len(list(BagReader(copied).read())) == 1


def test_a_recording_that_was_cut_off_replays_what_is_whole_in_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when the recorder was killed, or power failed while the file was written."""
    (tmp_path / "cut").mkdir()
    kind, cut = "dm_msgs/msg/ActuatorState", tmp_path / "cut" / "bag.mcap"
    on_disk: list[bytes] = []
    monkeypatch.setattr(os, "fsync", lambda _file: on_disk.append((tmp_path / "bag" / "bag.mcap").read_bytes()))
    with closing(BagWriter(tmp_path / "bag")) as writer:
        writer.add_topic(Topic("/actuator_state", kind, [offered(qos.STATE)], "INVALID"), definition(kind))
        for second in range(30):
            writer.write("/actuator_state", serialize_message(ActuatorState(sequence=second)), second * 10**9)
        content = on_disk[-1]
    for length in range(len(content), 8, -50):
        cut.write_bytes(content[:length])
        bag = BagReader(cut.parent)
        sequences = [deserialize_message(message.data, ActuatorState).sequence for message in bag.read()]
        assert sequences == list(range(bag.messages)) and bag.unfinished == [str(cut)]
        assert length < len(content) or bag.messages >= 24, "all but the last seconds"
        assert bag.duration_s == pytest.approx(max(0, bag.messages - 1))
    cut.write_bytes(flipped(content, content.rindex(b"zstd") + 40))  # in the last chunk
    with pytest.raises(BagError, match="cut: no recording, or damaged"):
        BagReader(cut.parent)
    cut.write_bytes(b"")
    with pytest.raises(BagError, match="empty: nothing was written yet"):
        BagReader(cut.parent)


def test_the_newer_value_of_a_parameter_stands_though_its_answer_was_written_later(tmp_path: Path) -> None:
    """In a recording that was not finished, whose messages come in the order of the file."""
    kind = "rcl_interfaces/msg/ParameterEvent"
    with closing(BagWriter(tmp_path / "bag")) as writer:
        writer.add_topic(Topic(PARAMETER_EVENTS, kind, [offered(qos.STATE)], "INVALID"), definition(kind))
        for log_time, value in (2, 0.2), (1, 0.1):
            changes = [Parameter("poke_amplitude", value=value).to_parameter_msg()]
            event = ParameterEvent(node="/calibration", new_parameters=changes)
            writer.write(PARAMETER_EVENTS, serialize_message(event), log_time)
        writer.flush()
        bag = BagReader(tmp_path / "bag")
        assert bag.unfinished and _parameters(bag, "/calibration", 3)[0]["poke_amplitude"] == 0.2


def test_commands_are_held_back() -> None:
    topics = ["/zernike", "/m1/actuator_command", "/calibrate/_action/feedback", "/rosout", "/focus_request"]
    assert replayed(topics) == ["/zernike"]
    assert replayed(topics, commands=True) == ["/zernike", "/m1/actuator_command", "/focus_request"]
    assert replayed(topics, ["zernike"]) == ["/zernike"]
    with pytest.raises(ValueError, match="/nothing: not in the recording"):
        replayed(topics, ["nothing"])
    with pytest.raises(ValueError, match="/focus_request: a command, which is published with --commands only"):
        replayed(topics, ["focus_request"])


def test_of_two_mirrors_only_the_one_that_is_named_is_published() -> None:
    topics = ["/left/zernike", "/right/zernike", "/left/actuator_command", "/diagnostics", "/rosout"]
    assert replayed(topics, namespace="left") == ["/left/zernike", "/diagnostics"]
    assert replayed(topics, ["zernike", "/right/zernike"], namespace="/left/") == ["/left/zernike", "/right/zernike"]
    with pytest.raises(ValueError, match="namespace middle: no topic of the recording is in it"):
        replayed(topics, namespace="middle")


def test_what_is_for_publishing_is_refused_where_nothing_is_published(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", [("/left/actuator_state", ActuatorState())])
    command = ["replay", str(tmp_path / "bag")]
    for option in (["--rate", "2"], ["--topics", "zernike"], ["--commands"]):
        refused = CliRunner().invoke(make_app(), [*command, "--recalibrate", *option])
        assert refused.exit_code == 2 and "are for publishing" in " ".join(refused.output.split())
    refused = CliRunner().invoke(make_app(), [*command, "--rate", "0"])
    assert refused.exit_code == 2 and "must be above 0" in " ".join(refused.output.split())
    with pytest.raises(ValueError, match="namespace middle"):
        CliRunner().invoke(make_app(), [*command, "--namespace", "middle"], catch_exceptions=False)


def test_what_is_published_is_recorded_latched_or_not(
    observer: Observer, domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    latched = observer.node.create_publisher(MirrorInfo, "mirror_info", qos.LATCHED)
    stream = observer.node.create_publisher(ActuatorState, "actuator_state", qos.STATE)
    latched.publish(MirrorInfo(serial="before the recording"))
    with Recorder(tmp_path / "bag", domain=domain) as recorder:
        wait_until(lambda: stream.get_subscription_count() and recorder.counts.get("/mirror_info"), 60)
        for number in range(25):
            stream.publish(ActuatorState(sequence=number))
        wait_until(lambda: recorder.counts.get("/actuator_state") == 25, 60)
        now = time.time_ns
        monkeypatch.setattr(time, "time_ns", lambda: now() - 5 * 10**9)  # the clock is set back
        for number in range(25, 50):
            stream.publish(ActuatorState(sequence=number))
        wait_until(lambda: recorder.counts["/actuator_state"] == 50, 60, "all states in the recording")
    monkeypatch.undo()
    bag = BagReader(tmp_path / "bag")
    states = list(bag.read(["/actuator_state"]))
    cls = message_class("dm_msgs/msg/ActuatorState")
    assert [deserialize_message(state.data, cls).sequence for state in states] == list(range(50))
    assert all(0 <= time.time_ns() - state.log_time < 60 * 10**9 for state in states)
    assert bag.topics["/mirror_info"].qos[0].durability.name == "TRANSIENT_LOCAL"
    assert bag.topics["/mirror_info"].type_hash.startswith("RIHS01_")


def test_a_recording_that_cannot_begin_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "bench")
    with pytest.raises(RuntimeError, match="failed to initialize rcl"):
        Recorder(tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_of_two_mirrors_only_the_one_that_is_named_is_recorded(observer: Observer, domain: int, tmp_path: Path) -> None:
    """And what they share; the one that is not named may be without a namespace."""
    for name in ("actuator_state", "left/actuator_state", "right/actuator_state"):
        observer.node.create_publisher(ActuatorState, name, qos.LATCHED).publish(ActuatorState())
    observer.node.create_publisher(DiagnosticArray, "diagnostics", qos.LATCHED).publish(DiagnosticArray())
    with Recorder(tmp_path / "bag", "left", domain=domain) as recorder:
        wait_until(lambda: {"/left/actuator_state", "/diagnostics"} <= recorder.counts.keys(), 60)
        assert [name for name in ("/actuator_state", "/right/actuator_state", "/clock") if recorder._records(name)] == [
            "/clock"
        ]
    assert not {"/actuator_state", "/right/actuator_state"} & recorder.counts.keys()


def test_what_was_recorded_is_in_the_file_though_nothing_follows(
    observer: Observer, domain: int, tmp_path: Path
) -> None:
    stream = observer.node.create_publisher(ActuatorState, "actuator_state", qos.STATE)
    with Recorder(tmp_path / "bag", topics=["actuator_state", "actuator_stat"], domain=domain) as recorder:
        wait_until(stream.get_subscription_count, 60)
        for number in range(2):
            stream.publish(ActuatorState(sequence=number))
        wait_until(lambda: recorder.counts.get("/actuator_state") == 2, 60)
        wait_until(lambda: BagReader(tmp_path / "bag").messages == 2, 5, "both in the file")
    assert recorder.unseen == ["/actuator_stat"]


def test_names_that_nobody_publishes_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("signal.signal", lambda *_arguments: None)
    folder = tmp_path / "bag"
    for counts in {PARAMETER_EVENTS: 3}, {PARAMETER_EVENTS: 3, "/zernike": 1}:
        folder.mkdir()
        running = SimpleNamespace(counts=counts, unseen=["/zernik"], refused={}, check=lambda: None)
        manager = nullcontext(running)
        monkeypatch.setattr("dm_tools.recording.recorder.Recorder", lambda *_arguments, found=manager: found)
        with (
            nullcontext()
            if "/zernike" in counts
            else pytest.raises(RuntimeError, match="no topic in --topics is published")
        ):
            record(folder, "zernik,zernike", duration=0.01)
        assert "not recorded /zernik: nobody published it" in capsys.readouterr().out
    running.counts, running.unseen = {"/diagnostics": 9, "/rosout": 2}, []
    with pytest.raises(NotRunningError, match="and namespace"):  # of another mirror's nodes
        record(folder, namespace="lfet", duration=0.01)


def test_a_failure_of_the_writer_is_told(
    observer: Observer, domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one of the library's own, and the recording is finished all the same."""
    failed = threading.Event()

    def fails(*_message: object) -> None:
        failed.set()
        raise AssertionError

    monkeypatch.setattr(BagWriter, "write", fails)
    observer.node.create_publisher(MirrorInfo, "mirror_info", qos.LATCHED).publish(MirrorInfo())
    with pytest.raises(OSError, match=r"bag: the recording ended early: AssertionError\(\)"):
        with Recorder(tmp_path / "bag", domain=domain):
            assert failed.wait(60)
    assert BagReader(tmp_path / "bag").unfinished == []


def test_messages_that_come_faster_than_they_can_be_written_are_counted(
    observer: Observer, domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And do not fill the memory."""
    go_on, write = threading.Event(), BagWriter.write

    def waits(bag: BagWriter, *message: Any) -> None:
        go_on.wait(60)
        write(bag, *message)

    monkeypatch.setattr(BagWriter, "write", waits)
    monkeypatch.setattr("dm_tools.recording.recorder.WAITING_MAX", 1_000_000)
    images = observer.node.create_publisher(Image, "image_raw", 10)
    with Recorder(tmp_path / "bag", topics=["image_raw"], domain=domain) as recorder:
        wait_until(images.get_subscription_count, 60)
        for _ in range(10):
            images.publish(Image(data=bytes(300_000)))
        wait_until(lambda: recorder.refused, 60)
        time.sleep(0.5)
        go_on.set()
    assert recorder.counts["/image_raw"] + int(recorder.refused["/image_raw"].split()[0]) == 10
    assert 1 <= recorder.counts["/image_raw"] <= 4


def test_another_reader_decodes_it_from_the_definitions_in_the_file(
    observer: Observer, domain: int, tmp_path: Path
) -> None:
    """And finds each definition to be that of the type by its hash."""
    message = Calibrate.Impl.FeedbackMessage(feedback=Calibrate.Feedback(label="actuator 3"))
    messages: dict[str, Any] = {
        "/mirror_info": MirrorInfo(serial="of the mirror"),
        "/calibration": Calibration(influence_zernike=[1e-7, 2e-7]),
        "/calibrate/_action/feedback": message,
    }
    for name, message in messages.items():
        observer.node.create_publisher(type(message), name, qos.LATCHED).publish(message)
    with Recorder(tmp_path / "bag", domain=domain) as recorder:
        wait_until(lambda: all(recorder.counts.get(name) for name in messages), 60, "all messages")
    with AnyReader([tmp_path / "bag"]) as reader:
        decoded: dict[str, Any] = {
            connection.topic: reader.deserialize(data, connection.msgtype)
            for connection, _time, data in reader.messages([c for c in reader.connections if c.topic in messages])
        }
    assert decoded["/mirror_info"].serial == "of the mirror"
    assert decoded["/calibration"].influence_zernike.tolist() == [1e-7, 2e-7]
    assert decoded["/calibrate/_action/feedback"].feedback.label == "actuator 3"


def test_parameters_of_the_nodes_are_recorded(
    start: Callable[..., Any], observer: Observer, domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the time at which the first was asked for: whatever changes meanwhile is newer."""
    requested: list[int] = []
    get_parameters = AsyncParameterClient.get_parameters

    def get(client: AsyncParameterClient, names: list[str]) -> Any:
        requested.append(time.time_ns())
        return get_parameters(client, names)

    monkeypatch.setattr(AsyncParameterClient, "get_parameters", get)
    start("dm_calibration", "calibration", {"calibration_folder": str(tmp_path / "store"), "poke_amplitude": 0.31})
    wait_until(lambda: "/calibration/get_parameters" in dict(observer.node.get_service_names_and_types()), 60, "node")
    with Recorder(tmp_path / "bag", topics=["nothing"], domain=domain) as recorder:
        wait_until(lambda: nodes_recorded(recorder) == 1, 60, "parameters")
    recorded_events = list(BagReader(tmp_path / "bag").read())
    assert recorded_events[0].log_time <= requested[0]
    events = [deserialize_message(each.data, ParameterEvent) for each in recorded_events]
    values = {each.name: each.value.double_value for event in events for each in event.new_parameters}
    assert values["poke_amplitude"] == 0.31 and values.keys() >= {parameter.name for parameter in PARAMETERS}


def test_parameters_of_a_node_that_was_started_again_are_recorded_too(
    start: Callable[..., Any], observer: Observer, domain: int, tmp_path: Path
) -> None:
    """A calibration that it makes is made again by these, and not by those it had before."""
    own = {"calibration_folder": str(tmp_path / "store")}
    node = start("dm_calibration", "calibration", own | {"poke_amplitude": 0.31})
    with Recorder(tmp_path / "bag", topics=["nothing"], domain=domain) as recorder:
        wait_until(lambda: nodes_recorded(recorder) == 1, 60, "parameters")
        assert node.stop() == 0
        wait_until(lambda: "calibration" not in observer.node.get_node_names(), 60, "its end")
        start("dm_calibration", "calibration", own | {"poke_amplitude": 0.35})
        wait_until(lambda: nodes_recorded(recorder) == 2, 60, "parameters anew")
    values, _remarks = _parameters(BagReader(tmp_path / "bag"), "/calibration", time.time_ns())
    assert values["poke_amplitude"] == 0.35


def test_a_recording_is_published_again(observer: Observer, domain: int, tmp_path: Path) -> None:
    messages: list[tuple[str, Any]] = [("/actuator_state", ActuatorState(sequence=k)) for k in range(10)]
    others: list[tuple[str, Any]] = [("/actuator_command", ActuatorCommand(signals=[0.5])), ("/old", ActuatorState())]
    bag, remarks = write_bag(tmp_path / "bag", [*messages, *others]), list[str]()
    seen = observer.record(ActuatorState, "actuator_state", qos.STATE)
    commands = observer.record(ActuatorCommand, "actuator_command", qos.COMMAND)
    counts = play(bag, replayed(list(bag.topics)), rate=0.1, domain=domain, remark=remarks.append)
    assert counts == {"/actuator_state": 10}, "what is left out is not counted as published"
    assert remarks == ["/old is left out: dm_msgs/msg/ActuatorState had another layout when it was recorded"]
    wait_until(lambda: len(seen) == 10, 60, "all messages")
    assert [message.sequence for message in seen] == list(range(10))
    assert not commands
    observer.node.create_publisher(ActuatorState, "actuator_state", qos.STATE)
    with pytest.raises(ValueError, match=r"/actuator_state: the node \w+ publishes it here.*ROS_DOMAIN_ID"):
        play(bag, ["/actuator_state"], domain=domain)
    assert len(seen) == 10


def test_what_another_program_said_keeps_nothing_from_being_published_again(domain: int, tmp_path: Path) -> None:
    """Such as a recording of all topics holds."""
    with closing(BagWriter(tmp_path / "bag")) as writer:
        for name, kind in (("/zernike", "dm_msgs/msg/ZernikeCoefficients"), ("/theirs", "their_msgs/msg/Thing")):
            text = definition(kind) if name == "/zernike" else "int32 number\n"
            writer.add_topic(Topic(name, kind, [offered(qos.STATE)], "INVALID"), text)
            writer.write(name, serialize_message(ZernikeCoefficients()), 1)
    bag, remarks = BagReader(tmp_path / "bag"), list[str]()
    assert play(bag, replayed(list(bag.topics)), domain=domain, remark=remarks.append) == {"/zernike": 1}
    assert remarks == ["/theirs is left out: message type their_msgs/msg/Thing: not installed here"]


def test_a_driver_that_starts_meanwhile_ends_a_replay(observer: Observer, domain: int, tmp_path: Path) -> None:
    messages: list[tuple[str, Any]] = [("/actuator_state", ActuatorState(sequence=k)) for k in range(10)]
    bag, seen = write_bag(tmp_path / "bag", messages), observer.record(ActuatorState, "actuator_state", qos.STATE)

    def start_driver(_seconds: float) -> None:
        observer.node.create_publisher(ActuatorState, "actuator_state", qos.STATE)
        names = observer.node.count_publishers
        wait_until(lambda: names("actuator_state") > 1, 60, "the driver")
        time.sleep(1.0)  # until the player has found it too

    with pytest.raises(ValueError, match="/actuator_state: the node"):
        play(bag, ["/actuator_state"], domain=domain, progress=start_driver)
    assert len(seen) < 10


def test_a_rate_is_refused_before_the_recording_is_read(tmp_path: Path) -> None:
    for rate in ("0", "-1", "nan"):
        result = CliRunner().invoke(make_app(), ["replay", str(tmp_path), f"--rate={rate}"])
        assert result.exit_code == 2 and "must be above 0" in result.output
