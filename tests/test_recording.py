"""Recordings: as rosbag2 writes them, read by others, published again, and a calibration made again from one."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from dm_msgs.action import Calibrate
from dm_msgs.msg import ActuatorCommand, ActuatorState, MirrorInfo, SurfaceMapInfo, SurfaceSamples, ZernikeCoefficients
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rclpy.serialization import deserialize_message, serialize_message

from described_mirror import mirror_info_of
from dm_calibration.calibration_messages import calibration_message
from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.influence.fit import FitOptions
from dm_calibration.procedure.plan import PlanKind, PlanOptions
from dm_calibration.procedure.recorded_run import RecordedRun, RecordingError
from dm_common.messages import doubles, time_message
from dm_common.ros import qos
from dm_tools.recording.bag import METADATA_FILE, BagWriter, Topic
from dm_tools.recording.bag_reader import BagError, BagReader
from dm_tools.recording.interfaces import UnknownTypeError, definition, message_class
from dm_tools.recording.player import play, replayed
from dm_tools.recording.recorder import Recorder
from dm_tools.recording.session import COMPARED, differences, read_session, recalibrate
from dm_tools.verbs.replay import _again
from recorded_bench import recorded
from rosbag2_files import write_rosbag2
from rosbag2_metadata import read_metadata
from support import Observer, wait_until

FEEDBACK_TYPE = "dm_msgs/action/Calibrate_FeedbackMessage"
RELIABLE = {"history": "keep_last", "depth": 10, "reliability": "reliable", "durability": "volatile"}


#: Of a type that another version recorded.
OTHER_LAYOUT = "RIHS01_" + 64 * "0"


def write_bag(folder: Path, messages: list[tuple[str, Any]], parameters: dict[str, Any] | None = None) -> BagReader:
    """A recording of (topic, message) pairs, a millisecond apart; what is on `/old` had another layout."""
    with BagWriter(folder) as bag:
        for number, (name, message) in enumerate(messages):
            kind = type(message)
            action = kind.__name__ == "Calibrate_FeedbackMessage"
            type_name = FEEDBACK_TYPE if action else f"dm_msgs/msg/{kind.__name__}"
            type_hash = OTHER_LAYOUT if name == "/old" else ""
            bag.add_topic(Topic(name, type_name, [RELIABLE], type_hash), definition(type_name))
            time = (number + 1) * 10**6
            bag.write(name, serialize_message(message), time, time)
        bag.add_parameters({"/calibration": parameters} if parameters else {})
    return BagReader(folder)


def session_messages(run: RecordedRun) -> list[tuple[str, Any]]:
    """The topics of a run as the nodes publish them: feedback, then moves and maps in the order of their stamps."""
    rest = doubles(run.mirror.rest)
    messages: list[tuple[str, Any]] = [
        ("/mirror_info", mirror_info_of(run.mirror)),
        ("/actuator_state", ActuatorState(requested=rest, applied=rest, turns=7, degausses=2)),
    ]
    told = Calibrate.Impl.FeedbackMessage(feedback=Calibrate.Feedback(plan=run.plan))
    messages.append(("/calibrate/_action/feedback", told))
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
            valid_fraction=measured.valid_fraction,
        )
        points = measured.points
        samples = SurfaceSamples(
            x=doubles(points.x), y=doubles(points.y), weight=doubles(points.weight), sag=doubles(measured.sag)
        )
        info = SurfaceMapInfo(system_error_subtracted=-1, file=measured.file, sha256=measured.sha256)
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
    bag = write_bag(folder, [*session_messages(run), ("/calibration", message)], {"poke_amplitude": 0.4})
    return run, message, bag


def test_a_calibration_made_again_is_the_same_to_the_last_bit(run_and_bag: tuple[RecordedRun, Any, BagReader]) -> None:
    _run, live, bag = run_and_bag
    session = read_session(bag)
    assert session.published.id == "live"
    assert not session.remarks
    again = recalibrate(session, "again", 2)
    assert differences(again, live) == []
    assert np.array(live.influence_sag).tobytes() == again.fit.influence_sag.tobytes()


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_recording_of_rosbag2_gives_the_same_calibration(
    run_and_bag: tuple[RecordedRun, Any, BagReader], tmp_path: Path, storage: str
) -> None:
    _run, live, ours = run_and_bag
    folder = tmp_path / "theirs"
    write_rosbag2(folder, list(ours.read()), storage)
    theirs = BagReader(folder)
    assert theirs.counts == ours.counts and theirs.messages == ours.messages
    assert theirs.duration_s == ours.duration_s and theirs.topics.keys() == ours.topics.keys()
    assert theirs.topics["/zernike"].qos == [RELIABLE]
    assert theirs.file.stem == "theirs_0"
    assert [message.data for message in theirs.read(["/zernike"])] == [m.data for m in ours.read(["/zernike"])]
    session = read_session(theirs)
    assert "does not hold the parameters" in session.remarks[0]  # which rosbag2 does not ask for
    session.parameters["poke_amplitude"] = 0.4
    assert differences(recalibrate(session, "again", 2), live) == []
    (folder / "theirs_1.mcap").unlink(missing_ok=True)
    (folder / "theirs_1.db3").unlink(missing_ok=True)
    with pytest.raises(BagError, match="theirs_1"):
        BagReader(folder)


def test_a_recording_without_hidden_topics_says_how_to_make_one(
    run_and_bag: tuple[RecordedRun, Any, BagReader], tmp_path: Path
) -> None:
    messages = [message for message in run_and_bag[2].read() if "/_" not in message.topic.name]
    write_rosbag2(tmp_path / "theirs", messages, "mcap")
    with pytest.raises(RecordingError, match="--include-hidden-topics"):
        read_session(BagReader(tmp_path / "theirs"))


def test_a_recording_of_another_version_is_refused(
    run_and_bag: tuple[RecordedRun, Any, BagReader], tmp_path: Path
) -> None:
    """Whose feedback had a field less."""
    shorter = [replace(m, data=m.data[: -4 if "/_" in m.topic.name else None]) for m in run_and_bag[2].read()]
    write_rosbag2(tmp_path / "theirs", shorter, "mcap")
    with pytest.raises(RecordingError, match="feedback: dm_msgs/action/Calibrate_FeedbackMessage had another layout"):
        read_session(BagReader(tmp_path / "theirs"))


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


def test_the_command_recalibrates_and_stores(run_and_bag: tuple[RecordedRun, Any, BagReader], tmp_path: Path) -> None:
    bag, figures = run_and_bag[2], tmp_path / "figures.json"
    command = [sys.executable, "-m", "dm_tools", "replay", str(bag.file.parent), "--recalibrate"]
    done = subprocess.run(
        [*command, "--store", str(tmp_path / "store"), "--json", str(figures)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "the same as live to the last bit" in done.stdout
    told = json.loads(figures.read_text())
    assert told["identical"] is True and Path(told["file"]).is_file()


def test_the_command_takes_parameters_that_a_recording_of_rosbag2_does_not_hold(
    run_and_bag: tuple[RecordedRun, Any, BagReader], tmp_path: Path
) -> None:
    write_rosbag2(tmp_path / "theirs", list(run_and_bag[2].read()), "mcap")
    config = tmp_path / "bench.yaml"
    config.write_text("/**/calibration: {ros__parameters: {poke_amplitude: 0.4}}\n")
    figures = _again(BagReader(tmp_path / "theirs"), 0, "", None, config)
    assert figures["identical"] is True


def test_a_recording_without_a_run_is_told(tmp_path: Path) -> None:
    run, _outcome = recorded(PlanKind.POKES, PlanOptions())
    bag = write_bag(tmp_path / "bag", session_messages(run)[:2])
    with pytest.raises(RecordingError, match="no topic /zernike"):
        read_session(bag)


def test_the_file_is_what_rosbag2_expects(run_and_bag: tuple[RecordedRun, Any, BagReader]) -> None:
    bag = run_and_bag[2]
    with bag.file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        records = {record.name: record.metadata for record in reader.iter_metadata()}
    assert summary is not None and summary.statistics is not None
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    for channel in summary.channels.values():
        assert yaml.safe_load(channel.metadata["offered_qos_profiles"]) == [RELIABLE]
    text = (bag.file.parent / METADATA_FILE).read_text()
    assert "&" not in text and "*" not in text  # YAML references, which rosbag2 does not write
    info = yaml.safe_load(text)["rosbag2_bagfile_information"]
    assert info["version"] == 9 and info["storage_identifier"] == "mcap"
    assert info["relative_file_paths"] == [bag.file.name]
    assert info["message_count"] == summary.statistics.message_count == bag.messages
    counts = {topic["topic_metadata"]["name"]: topic["message_count"] for topic in info["topics_with_message_count"]}
    assert counts == bag.counts
    assert yaml.safe_load(records["rosbag2"]["serialized_metadata"]) == info


def test_another_reader_decodes_it_from_the_definitions_in_the_file(
    run_and_bag: tuple[RecordedRun, Any, BagReader],
) -> None:
    run, live, bag = run_and_bag
    # This reader refuses the underscore in the name of an action's feedback; Foxglove does not.
    names = [name for name in bag.topics if "/_action/" not in name]
    with bag.file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = {channel.topic: message for _, channel, _, message in reader.iter_decoded_messages(names)}
    assert set(decoded) == set(names)
    assert decoded["/mirror_info"].serial == run.mirror.serial
    assert list(decoded["/calibration"].influence_zernike) == list(live.influence_zernike)
    assert list(decoded["/zernike"].coefficients) == run.maps[-1].coefficients.tolist()


def test_definitions_hold_every_type_they_use() -> None:
    text = definition(FEEDBACK_TYPE)
    assert text.startswith("unique_identifier_msgs/UUID goal_id")
    assert "MSG: dm_msgs/action/Calibrate_Feedback\n" in text and "MSG: unique_identifier_msgs/UUID\n" in text
    assert "MSG: builtin_interfaces/Time\n" in definition("dm_msgs/msg/Calibration")
    with pytest.raises(UnknownTypeError, match="no_such_msgs/msg/Thing"):
        message_class("no_such_msgs/msg/Thing")


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", [("/actuator_state", ActuatorState())])
    with pytest.raises(FileExistsError, match="never overwritten"):
        BagWriter(tmp_path / "bag")


@pytest.mark.parametrize("damage", ["cut", "foreign", "absent"])
def test_a_damaged_recording_is_refused(tmp_path: Path, damage: str) -> None:
    bag = write_bag(tmp_path / "bag", [("/actuator_state", ActuatorState(message="x" * 100))] * 50)
    content = bag.file.read_bytes()
    if damage == "absent":
        bag.file.unlink()
    else:
        bag.file.write_bytes(content[: len(content) // 2] if damage == "cut" else b"no recording at all")
    with pytest.raises(BagError):
        BagReader(tmp_path / "bag")


def test_commands_are_held_back() -> None:
    topics = ["/zernike", "/m1/actuator_command", "/calibrate/_action/feedback", "/rosout", "/focus_request"]
    assert replayed(topics) == ["/zernike"]
    assert replayed(topics, commands=True) == ["/zernike", "/m1/actuator_command", "/focus_request"]
    assert replayed(topics, ["zernike"]) == ["/zernike"]
    with pytest.raises(ValueError, match="/nothing: not in the recording"):
        replayed(topics, ["nothing"])


def test_what_is_published_is_recorded_latched_or_not(observer: Observer, domain: int, tmp_path: Path) -> None:
    latched = observer.node.create_publisher(MirrorInfo, "mirror_info", qos.LATCHED)
    stream = observer.node.create_publisher(ActuatorState, "actuator_state", qos.STATE)
    latched.publish(MirrorInfo(serial="before the recording"))
    with Recorder(tmp_path / "bag", domain=domain) as recorder:
        wait_until(lambda: stream.get_subscription_count() and recorder.counts.get("/mirror_info"), 60)
        for number in range(50):
            stream.publish(ActuatorState(sequence=number))
        wait_until(lambda: recorder.counts["/actuator_state"] == 50, 60, "all states in the recording")
    bag = BagReader(tmp_path / "bag")
    states = list(bag.read(["/actuator_state"]))
    cls = message_class("dm_msgs/msg/ActuatorState")
    assert [deserialize_message(state.data, cls).sequence for state in states] == list(range(50))
    assert all(0 <= state.log_time - state.publish_time < 10**10 for state in states)
    assert bag.topics["/mirror_info"].qos[0]["durability"] == "transient_local"
    assert bag.topics["/mirror_info"].type_hash.startswith("RIHS01_")
    assert read_metadata(tmp_path / "bag" / METADATA_FILE)["message_count"] == sum(bag.counts.values())


def test_parameters_of_the_nodes_are_recorded(
    start: Callable[..., Any], observer: Observer, domain: int, tmp_path: Path
) -> None:
    start("dm_calibration", "calibration", {"calibration_folder": str(tmp_path / "store"), "poke_amplitude": 0.31})
    with Recorder(tmp_path / "bag", domain=domain) as recorder:
        wait_until(lambda: "weak_share" in recorder.parameters.get("/calibration", {}), 60, "parameters")
    assert BagReader(tmp_path / "bag").parameters["/calibration"]["poke_amplitude"] == 0.31


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
    with pytest.raises(ValueError, match="rate = 0"):
        play(bag, [], rate=0.0)
