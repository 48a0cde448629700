"""`dm doctor` names what is wrong on a machine or a bench, and the cure."""

from __future__ import annotations

import ast
import json
import os
import socket
import subprocess
import sys
import time
import traceback
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
import typer
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from dm_msgs.msg import ActuatorState
from rclpy.node import Node

from dm_bringup.nodes import NODES
from dm_bringup.suite import load_config, save_config
from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.influence.fit import FitOptions
from dm_calibration.procedure.plan import PlanKind, PlanOptions
from dm_calibration.recalibration.check_log import Check, append_check
from dm_calibration.store.calibration_store import CalibrationStore
from dm_simulation.interferometer.zygo_files import encode_dat
from dm_tools import output
from dm_tools.doctor import bench as doctor_bench
from dm_tools.doctor import doctor as doctor_verb
from dm_tools.doctor import electronics
from dm_tools.doctor import machine as doctor_machine
from dm_tools.doctor.doctor import held_by_the_nodes
from dm_tools.doctor.machine import Finding
from dm_tools.verbs.up import shared_config
from hysteretic_mirror import MIRROR
from recorded_bench import recorded
from support import wait_until

GOOD: dict[str, Any] = load_config(shared_config("bench.yaml"))


def bench(changes: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {node: values | changes.get(node, {}) for node, values in GOOD.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bench.yaml", "mirror_19.yaml", "membrane_37.yaml"])
def test_the_shipped_benches_are_well(name: str) -> None:
    config = load_config(shared_config(name))
    for check in (
        doctor_bench.required_parameters,
        doctor_bench.own_values,
        doctor_bench.parameters,
        doctor_bench.aperture_fits,
        doctor_bench.one_record,
    ):
        assert check(config) is None
    for node in NODES:
        assert doctor_bench.node_configuration(config, node) is None


NOBODY = "~nobody-of-that-name/x"
PATHS = [
    ("virtual_bench", "electronics.pty_link"),
    ("virtual_bench", "output_folder"),
    ("pdm_driver", "electronics.serial_port"),
    ("pdm_driver", "state_folder"),
    ("interferometer", "watch_folder"),
    ("interferometer", "reference_surface"),
    ("calibration", "calibration_folder"),
    ("calibration", "state_folder"),
    ("focus_controller", "state_folder"),
]


@pytest.mark.parametrize(
    ("node", "name", "value", "words"),
    [
        ("pdm_driver", "volts.mx", 300.0, "parameter 'volts.mx' is unknown; did you mean volts.max"),
        ("pdm_driver", "volts.max", "high", "volts.max = 'high': must be a finite float"),
        ("pdm_driver", "limits.step", 7.0, "limits.step = 7.0: must be float, 0.0001 to 2"),
        ("pdm_driver", "electronics.kind", "edac41", "electronics.kind = 'edac41': must be one of edac40_tcp"),
        ("interferometer", "trigger_command", "run", "trigger_command = 'run': must be a str"),
        ("calibration", "settle_time", True, "settle_time = True: must be float"),
        ("calibration", "use_sim_time", "yes", "use_sim_time = 'yes': must be a bool"),
        *(
            (node, name, NOBODY, f"{name} = '{NOBODY}': must be a path; there is no home folder")
            for node, name in PATHS
        ),
    ],
)
def test_wrong_parameters_are_named(node: str, name: str, value: Any, words: str) -> None:
    finding = doctor_bench.parameters(bench({node: {name: value}}))
    assert finding is not None and words in finding.problem and not finding.note


FRAMED = {"electronics.kind": "framed_serial", "electronics.serial_port": "/dev/ttyUSB0"}
WIRING = list(range(1, 38))
MONTH_S = 30 * 86400.0
TWO_RINGS = {"mirror.actuators": 19, "mirror.wiring": "custom", "mirror.channels": WIRING[:19]}
LINK = {"electronics.pty_link": "tty", "framed.channels": 40}

NO_FILES: dict[str, Any] = {"watch_folder": "", "trigger_command": []}
_FOLDER = TemporaryDirectory()
#: A map of 632.8 nm.
FLAT = Path(_FOLDER.name) / "flat.dat"
FLAT.write_bytes(encode_dat(np.zeros((8, 8)), 1e-4, 632.8e-9, 0))

LINE = {"plate.actuator_x": [-0.004, 0.0, 0.004], "plate.actuator_y": [0.0, 0.0, 0.0]}
SAME_PLACE = {"plate.actuator_x": [-0.004, 0.004, 0.0, 0.0], "plate.actuator_y": [0.0, 0.0, 0.004, 0.004]}
#: Values that contradict each other: node, what differs from the shipped bench, words of the reason.
CONTRADICTIONS: list[tuple[str, dict[str, Any], str]] = [
    ("interferometer", {"watch_folder": ""}, "trigger_command needs watch_folder"),
    ("interferometer", {"trigger_command": ["", "x"]}, "must name a program"),
    (
        "interferometer",
        {"reference_surface": "/nowhere/flat.dat"},
        "reference_surface: /nowhere/flat.dat: No such file",
    ),
    ("interferometer", {"reference_surface": str(FLAT), "wavelength.expected": 532e-9}, "must be 532.000 nm"),
    ("interferometer", {"zernike_topic": "/wavefront/zernike"}, "must be empty beside it"),
    ("interferometer", {"retrace": [0.0]}, "retrace: 1 numbers, must be 36 or none"),
    ("interferometer", {"aperture.radius": 0.0, "aperture.follow": True}, "has an effect only with aperture.radius"),
    (
        "interferometer",
        {"zernike_topic": "/zernike", **NO_FILES},
        "must not be a topic that this node itself publishes",
    ),
    ("interferometer", {"zernike_topic": "wave front", **NO_FILES}, "zernike_topic = 'wave front'"),
    ("interferometer", {"trigger_output_suffix": "../x"}, "must be an ending such as .datx"),
    ("pdm_driver", {"mirror.serial": " "}, "mirror.serial is empty"),
    ("pdm_driver", {"mirror.actuators": 19}, "lists 37 channels: must be 19"),
    ("pdm_driver", {"mirror.wiring": "other"}, "mirror.wiring = 'other': unknown"),
    ("pdm_driver", {"mirror.channels": WIRING}, "mirror.channels is given but mirror.wiring = 'trihex'"),
    ("pdm_driver", {"mirror.wiring": "custom", "mirror.channels": [40, *WIRING[1:]]}, "on channel 40; must be -1 to"),
    ("pdm_driver", {"mirror.wiring": "custom", "mirror.channels": [2, *WIRING[1:]]}, "used more than once"),
    ("pdm_driver", {"mirror.wiring": "custom", "mirror.channels": [-1] * 37}, "no actuator has a channel"),
    ("pdm_driver", {"electronics.address": ""}, "electronics.address is empty"),
    ("pdm_driver", {"electronics.kind": "usb_dac40"}, "electronics.serial_port is empty"),
    ("pdm_driver", {"volts.dac_at_full": 0.0}, "volts.dac_at_full"),
    ("pdm_driver", {"volts.amplifier_gain": 0.0}, "volts.amplifier_gain = 0"),
    ("pdm_driver", {"electronics.kind": "microscope"}, "must be 0, 1, 1 with electronics.kind = 'microscope'"),
    ("pdm_driver", {"volts.max": 0.0}, "must be above volts.min"),
    ("pdm_driver", {"volts.max": 900.0}, "volts.max"),
    ("pdm_driver", {"volts.min": -10.0, "drive.law": "square"}, "must be at least 0 with drive.law"),
    ("pdm_driver", {"volts.min": 0.0, "volts.max": 0.001}, "volts"),
    (
        "pdm_driver",
        {"mirror.actuators": 20, "mirror.wiring": "custom", "mirror.channels": WIRING[:20]},
        "no full hexagonal",
    ),
    ("pdm_driver", TWO_RINGS | {"mirror.actuator_x": [0.0] * 18, "mirror.actuator_y": [0.0] * 19}, "has 18 values"),
    ("pdm_driver", TWO_RINGS | {"mirror.actuator_x": [0.0] * 19, "mirror.actuator_y": [0.0] * 19}, "at the same place"),
    ("pdm_driver", {"mirror.working_aperture_diameter": 0.04}, "must be at most mirror.full_aperture_diameter"),
    ("pdm_driver", {"limits.signal_min": 0.5, "limits.signal_max": 0.2}, "limits.signal_min"),
    ("pdm_driver", {"limits.step": 1e-4, "volts.dac_at_full": 500.0}, "signal of one DAC code"),
    ("pdm_driver", {"safe_signals": [0.0]}, "safe_signals"),
    ("pdm_driver", FRAMED | {"framed_serial.channels": 8}, "actuator 1 on channel 14; must be 0 to 7"),
    ("pdm_driver", FRAMED | {"framed_serial.header": "A"}, "framed_serial.header"),
    ("pdm_driver", FRAMED | {"framed_serial.channel_order": [1, 1]}, "framed_serial.channel_order"),
    ("pdm_driver", FRAMED | {"framed_serial.word_bits": 8}, "framed_serial.word_bits"),
    ("pdm_driver", FRAMED | {"framed_serial.scale": 0}, "framed_serial.scale = 0"),
    ("pdm_driver", FRAMED | {"framed_serial.scale": 70000}, "framed_serial"),
    ("pdm_driver", FRAMED | {"framed_serial.frame_rate": 1e6}, "framed_serial.frame_rate"),
    ("autofocus", {"region": [0.0, 0.0, 1.0]}, "must be four numbers"),
    ("autofocus", {"region": [0.5, 0.0, 1.0, 1.0]}, "shares of the image"),
    ("autofocus", {"optics.rest_distance": 0.5, "optics.pupil_offset": -1.0}, "inside the camera"),
    ("virtual_bench", {"wiring": WIRING[:19]}, "37 are needed"),
    ("virtual_bench", {"wiring": [2, *WIRING[1:]]}, "must be different channels"),
    ("virtual_bench", {"volts.max": 0.0}, "volts"),
    ("virtual_bench", {"plate.actuators": 20}, "full rings hold 1, 7, 19"),
    ("virtual_bench", {"plate.actuator_x": [0.0]}, "must be as many"),
    ("virtual_bench", {"plate.pitch": 0.01}, "beyond the edge of the plate"),
    ("virtual_bench", SAME_PLACE | {"wiring": WIRING[:4]}, "actuators 3 and 4 are at the same place"),
    ("virtual_bench", LINE | {"wiring": WIRING[:3]}, "3 actuators on one line cannot hold the plate"),
    ("virtual_bench", {"piezo.law": "preisach", "piezo.hysteresis": 0.3}, "piezo.hysteresis = 0.3"),
    ("virtual_bench", {"interferometer.field_diameter": 0.04}, "must not exceed the mirror"),
    ("virtual_bench", {"interferometer.rotate_deg": 45}, "must be 0, 90, 180 or 270"),
    ("virtual_bench", {"camera.rate": 1.0, "camera.distances": [-1.0]}, "camera.distances"),
    ("virtual_bench", {"camera.rate": 1.0, "camera.pixel_pitch": 1e-4}, "camera.pixel_pitch"),
    ("virtual_bench", {"piezo.law": "bouc_wen", "piezo.hysteresis": 0.3}, "too wide"),
    ("virtual_bench", LINK | {"framed.header": "A"}, "must be hexadecimal bytes"),
    ("virtual_bench", LINK | {"framed.channel_order": [1, 1]}, "framed.channel_order"),
    ("virtual_bench", LINK | {"framed.word_bits": 8}, "framed.word_bits"),
    ("virtual_bench", LINK | {"framed.scale": 0}, "framed.scale = 0"),
    ("virtual_bench", {"mirror.principle": "membrane", "membrane.pitch": 0.01}, "membrane"),
    ("virtual_bench", {"mirror.principle": "membrane", "membrane.tension": 1.0}, "membrane.tension = 1 N/m"),
    ("virtual_bench", {"volts.min": -200.0}, "volts.min = -200 V: must be 0 to 400 V"),
    ("virtual_bench", {"electronics.amplifier_min": 500.0}, "electronics.amplifier_min = 500 V"),
    ("virtual_bench", {"piezo.creep_fastest": 10.0, "piezo.creep_slowest": 5.0}, "piezo.creep_slowest, 5 s"),
    ("virtual_bench", LINK | {"framed.channels": 41}, "framed.channels = 41"),
]


@pytest.mark.parametrize(("name", "values", "words"), CONTRADICTIONS)
def test_values_that_contradict_each_other_are_named(name: str, values: dict[str, Any], words: str) -> None:
    config = {**GOOD, "autofocus": {}}
    config[name] = config[name] | values
    node = next(node for node in NODES if node.name == name)
    finding = doctor_bench.node_configuration(config, node) or doctor_bench.parameters(config)
    assert finding is not None and words in finding.problem, finding


def _raising(error: BaseException) -> list[tuple[str, int]]:
    """Where each of an error and its causes was raised."""
    places = []
    cause: BaseException | None = error
    while cause is not None:
        *_, (frame, line) = traceback.walk_tb(cause.__traceback__)
        places.append((str(Path(frame.f_code.co_filename).resolve()), line))
        cause = cause.__cause__
    return places


@pytest.mark.slow
def test_every_reason_to_refuse_a_configuration_is_gone_through() -> None:
    """Each `raise ValueError` of the modules that configure is reached by a case above, or by no values at all."""
    reached = set()
    for name, values, _words in CONTRADICTIONS:
        node = next(node for node in NODES if node.name == name)
        configuring = node.load_configuring()
        assert configuring is not None
        try:
            configuring({item.name: item.default for item in node.load_parameters()} | GOOD.get(name, {}) | values)
        except ValueError as error:
            reached |= set(_raising(error))
    # What no values come to that the parameters' table allows, and what is not of a configuration.
    elsewhere = (
        *("must be one of", "must be {low} to {high}", "max_code", "must be finite", "leaves unconnected", "no camera"),
        *("path {", "px of an image", "must stay", "roi.x_offset"),
        *("search.tolerance", "negative grey levels"),  # of a mirror's range, and of images
    )
    missed = []
    for file in sorted({file for file, _ in reached if "/src/" in file}):
        for node_ in ast.walk(ast.parse(Path(file).read_text())):
            if isinstance(node_, ast.Raise) and "ValueError" in ast.unparse(node_):
                lines = range(node_.lineno, (node_.end_lineno or node_.lineno) + 1)
                known = any(words in ast.unparse(node_) for words in elsewhere)
                if not known and not any((file, line) in reached for line in lines):
                    missed.append(f"{Path(file).name}: {ast.unparse(node_.exc)[:90]}")  # type: ignore[arg-type]
    assert not missed, "\n".join(missed)


def test_what_is_left_of_the_template_is_named() -> None:
    config = load_config(shared_config("hardware.yaml"))
    finding = doctor_bench.own_values(config)
    assert finding is not None and "pdm_driver.mirror.serial" in finding.problem
    del config["pdm_driver"]["volts.max"]
    missing = doctor_bench.required_parameters(config)
    assert missing is not None and missing.problem == "pdm_driver lacks volts.max"


@pytest.mark.parametrize("wrong", ["to be set", doctor_bench.UNSET])
def test_wrong_values_are_named_and_nothing_is_tried_with_them(wrong: str, tmp_path: Path) -> None:
    """The rest of the file is gone through all the same."""
    changes: dict[str, dict[str, Any]] = {
        "pdm_driver": {"electronics.kind": "edac40_udp", "electronics.discovery_port": wrong},
        "interferometer": {"watch_folder": str(tmp_path), "trigger_command": wrong, "aperture.radius": 0.11},
        "calibration": {"calibration_folder": str(tmp_path), "updates.stale_after": wrong},
    }
    config = {node: values for node, values in bench(changes).items() if node != "virtual_bench"}
    save_config(config, tmp_path / "bench.yaml")
    found = {name: run() for name, run in doctor_bench.bench_checks(tmp_path / "bench.yaml")}
    named = found["parameters"] or found["values of your own"]
    assert named is not None
    for name in ("electronics.discovery_port", "trigger_command", "updates.stale_after"):
        assert name in named.problem
    assert "electronics at 127.0.0.1" not in found
    aperture = found["aperture of the maps"]
    assert aperture is not None and "the mirror has a radius of 0.015 m" in aperture.problem
    calibration = found["calibration"]
    assert calibration is not None and "no calibration of the mirror" in calibration.problem


def test_a_port_in_use_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = holder.getsockname()[1]
        driver = {"electronics.address": "127.0.0.1", "electronics.port": port, "mirror.actuators": 37}
        assert electronics.opens("edac40_tcp", driver) is None
        finding = doctor_bench.taken_ports({"virtual_bench": GOOD["virtual_bench"] | {"trigger.port": port}})
        wrong = doctor_bench.taken_ports({"virtual_bench": {"trigger.port": port, "electronics.tcp_port": str(port)}})
    assert finding is not None and f"trigger.port = {port}: Address already in use" in finding.problem
    assert wrong is not None and "electronics.tcp_port" not in wrong.problem  # which the node refuses
    finding = electronics.opens("edac40_tcp", driver)
    assert finding is not None and "Connection refused" in finding.problem


def test_a_device_server_that_is_not_there_is_named(tmp_path: Path) -> None:
    """Or what it takes to ask it."""
    changes = {"electronics.kind": "microscope", "electronics.address": "PYRO:Mirror@127.0.0.1:9"}
    config = {node: values for node, values in bench({"pdm_driver": changes}).items() if node != "virtual_bench"}
    save_config(config, tmp_path / "bench.yaml")
    found = {name: run() for name, run in doctor_bench.bench_checks(tmp_path / "bench.yaml")}
    finding = found["electronics at PYRO:Mirror@127.0.0.1:9"]
    assert finding is not None and "cannot open deformable mirror at PYRO:Mirror@127.0.0.1:9" in finding.problem


def test_a_place_that_may_not_be_searched_is_a_finding_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def closed() -> None:
        raise PermissionError(13, "Permission denied", "/home/other/security/maps")

    def insecure() -> None:
        raise RuntimeError("error creating node: This Fast DDS version doesn't have the security libraries")

    checks: list[tuple[str, Any]] = [("watch_folder", closed), ("messages between nodes", insecure)]
    checks += [("nodes that are running", lambda: Finding("none", "", note=True))]
    monkeypatch.setattr(doctor_verb, "machine_checks", lambda _namespace: checks)
    with output.console.capture() as said, pytest.raises(typer.Exit):
        doctor_verb.doctor()
    assert "cure: start the nodes with ROS 2 from apt, or unset ROS_SECURITY_ENABLE" in said.get()
    assert "WRONG watch_folder: cannot be checked:" in said.get() and "/home/other/security/maps" in said.get()
    assert "cure: give this user the right to it" in said.get() and "none" in said.get()
    monkeypatch.setattr(doctor_bench, "bench_checks", lambda _config, _namespace: [])
    with output.console.capture() as said, pytest.raises(typer.Exit):
        doctor_verb.doctor(Path("my bench.yaml"))
    assert "then ./dm doctor --config 'my bench.yaml' again" in said.get()


def test_what_the_running_nodes_hold_is_worth_a_note_only() -> None:
    refused, alone = Finding("no EDAC40 answers", "check power"), Finding("none in the ROS domain 0", "", note=True)
    running = Finding("virtual_bench, pdm_driver, in the ROS domain 0", "")
    held = held_by_the_nodes("electronics at 127.0.0.1:1", refused, running)
    assert held is not None and held.note and held.problem == refused.problem and "./dm status" in held.cure
    without = Finding("running: calibration; not running: pdm_driver (nothing can move the mirror)", "start it", True)
    checks = (("electronics at 127.0.0.1:1", alone), ("electronics at 1", without), ("watched folder /maps", running))
    for check, others in checks:
        assert held_by_the_nodes(check, refused, others) == refused


def test_a_driver_that_does_not_reach_its_unit_hides_nothing_of_what_is_wrong_with_it() -> None:
    lost, well = ActuatorState.STATE_LINK_LOST, ActuatorState.STATE_ACTIVE
    for state, reason in ((lost, "cannot open EDAC40: Connection refused"), (well, ""), (None, "")):
        messages = {} if state is None else {"actuator_state": ActuatorState(driver_state=state, message=reason)}
        client = SimpleNamespace(wait=lambda condition, _timeout_s: condition(), messages=messages)
        assert doctor_machine.link_lost(client) == reason
    refused = Finding("cannot open EDAC40: Connection refused", "check power")
    running = Finding(f"pdm_driver, in the ROS domain 0{doctor_machine.LINK_LOST}no route", "switch it on")
    for check in ("electronics at 127.0.0.1:1", "serial port /dev/ttyUSB0"):
        assert held_by_the_nodes(check, refused, running) == refused
    ports = held_by_the_nodes("ports of the virtual bench", refused, running)
    assert ports is not None and ports.note


def test_serial_ports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leader, follower = os.openpty()
    device = Path(os.ttyname(follower))
    absent = electronics.serial_port(tmp_path / "ttyUSB0")
    assert absent is not None and "does not exist" in absent.problem
    busy = electronics.serial_port(device)
    assert busy is not None and busy.note and f"(process {os.getpid()}, " in busy.problem
    os.close(follower)
    assert electronics.serial_port(device) is None
    monkeypatch.setattr(os, "access", lambda *_arguments: False)  # tests may run as root, who may all
    forbidden = electronics.serial_port(device)
    assert forbidden is not None and f"sudo usermod -aG {device.group()} $USER" in forbidden.cure
    os.close(leader)


def test_the_usual_folder_of_calibrations_is_looked_at_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a file without a section for the node `calibration`, which runs all the same."""
    monkeypatch.setenv("HOME", str(tmp_path))
    damaged = tmp_path / ".ros" / "dm_calibrations" / "damaged.h5"
    damaged.parent.mkdir(parents=True)
    damaged.touch()
    config = {node: values for node, values in bench({}).items() if node != "calibration"}
    save_config(config, tmp_path / "bench.yaml")
    found = dict(doctor_bench.bench_checks(tmp_path / "bench.yaml"))
    assert f"calibration folder {damaged.parent}" in found
    finding = found["calibration"]()
    assert finding is not None and finding.problem.startswith(damaged.name)


def test_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "file"
    file.touch()
    for folder, words in ((tmp_path / "maps", "does not exist"), (file, "is not a folder")):
        finding = doctor_bench.watched_folder(folder, written=True, made=False)
        assert finding is not None and words in finding.problem
    assert doctor_bench.watched_folder(tmp_path / "maps", written=True, made=True) is None
    assert doctor_bench.watched_folder(tmp_path, written=True, made=False) is None
    inside_a_file = doctor_bench.writable_folder(file / "calibrations")
    assert inside_a_file is not None and f"{file} is not a folder" in inside_a_file.problem
    monkeypatch.setattr(os, "access", lambda _path, mode: mode != os.W_OK)
    finding = doctor_bench.watched_folder(tmp_path, written=True, made=False)
    assert finding is not None and "cannot be written to" in finding.problem
    assert doctor_bench.watched_folder(tmp_path, written=False, made=False) is None


def test_what_would_end_the_first_run_is_told() -> None:
    config = {"pdm_driver": {"mirror.working_aperture_diameter": 0.022}, "interferometer": {"aperture.radius": 0.010}}
    finding = doctor_bench.aperture_fits(config)
    assert finding is not None and "the working aperture of the mirror has a radius of 0.011 m" in finding.problem
    assert doctor_bench.aperture_fits(config | {"interferometer": {"aperture.radius": 0.0}}) is None
    assert doctor_bench.aperture_fits(config | {"calibration": {"aperture_tolerance": 0.1}}) is None
    finding = doctor_bench.trigger_program(["pyhton3", "{path}"])
    assert finding is not None and "trigger_command = 'pyhton3', ...: no such program" in finding.problem
    assert doctor_bench.trigger_program([sys.executable]) is None and doctor_bench.trigger_program([]) is None


def test_nodes_that_begin_with_other_creep_are_told() -> None:
    folders = {"focus_controller": {"state_folder": "/srv/creep"}, "calibration": {}}
    finding = doctor_bench.one_record(folders)
    assert finding and "'/srv/creep', calibration: '~/.ros/focus_controller'" in finding.problem
    assert doctor_bench.one_record(folders | {"calibration": {"state_folder": "/srv/creep"}}) is None
    finding = doctor_bench.one_record({"focus_controller": {"state_folder": ""}})  # calibration runs all the same
    assert finding and finding.problem.startswith("state_folder differs (focus_controller: ''")
    assert doctor_bench.one_record({}) is None


def test_a_full_disk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_machine, "DISK_MIN", 0.0)
    assert doctor_machine.disk(tmp_path) is None
    monkeypatch.setattr(doctor_machine, "DISK_MIN", 1e30)
    finding = doctor_machine.disk(tmp_path)
    assert finding is not None and str(tmp_path) in finding.problem


def test_disk_use_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    maps = tmp_path / ".ros" / "dm_bench" / "maps"
    maps.mkdir(parents=True)
    (maps / "a.dat").write_bytes(bytes(3_000_000))
    finding = doctor_machine.disk_use()
    assert not finding.cure and finding.problem.endswith("3 MB in ~/.ros/dm_bench")


def test_calibrations_old_foreign_damaged_or_missing(tmp_path: Path) -> None:
    none = doctor_bench.stored_calibration(tmp_path, "T-1", MONTH_S)
    assert none is not None and none.note and "no calibration of the mirror T-1" in none.problem
    outcome = recorded(PlanKind.POKES, PlanOptions())[1]
    calibration = calibrate(
        outcome, mirror=MIRROR, options=FitOptions(), provenance=Provenance("PDM_1", time.time_ns())
    )
    CalibrationStore(tmp_path).save(calibration)  # made now, of maps of 1970
    serial = calibration.mirror_serial
    foreign = doctor_bench.stored_calibration(tmp_path, "other", MONTH_S)
    assert foreign is not None and f"it holds those of {serial}" in foreign.problem
    file, log = tmp_path / f"{calibration.id}.h5", tmp_path / f"{calibration.id}.checks.csv"
    check = Check(time.time(), 1, 1e-9, 1e-9, 1.0, 0.0, 1, 0.0)
    append_check(log, replace(check, accepted=0))
    assert doctor_bench.stored_calibration(tmp_path, serial, 1e10) is None
    old = doctor_bench.stored_calibration(tmp_path, serial, MONTH_S)
    assert old is not None and old.note and f"{calibration.id} for" in old.problem and "./dm check" in old.cure
    append_check(log, check)
    assert doctor_bench.stored_calibration(tmp_path, serial, MONTH_S) is None
    file.write_bytes(b"nothing of that kind")
    damaged = doctor_bench.stored_calibration(tmp_path, serial, MONTH_S)
    assert damaged is not None and not damaged.note and calibration.id in damaged.problem


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot be read"),
        ("<dds", "is no XML"),
        ("<dds/>", "does not set maxInitialPeersRange"),
        ("<dds><type>SHM</type></dds>", "does not set maxInitialPeersRange, segment_size"),
    ],
)
def test_dds_profiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str | None, words: str) -> None:
    path = tmp_path / "profile.xml"
    if content is not None:
        path.write_text(content)
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(path))
    finding = doctor_machine.profile()
    assert finding is not None and words in finding.problem
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(shared_config("fastdds.xml")))
    assert doctor_machine.profile() is None
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE")
    finding = doctor_machine.profile()
    assert finding is not None and "no Fast DDS profile" in finding.problem


@pytest.mark.parametrize(("value", "well"), [("7", True), ("", True), ("102", False), ("-1", False), ("bench", False)])
def test_domains(monkeypatch: pytest.MonkeyPatch, value: str, well: bool) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", value)
    monkeypatch.delenv("ROS_LOCALHOST_ONLY", raising=False)
    assert (doctor_machine.domain() is None) == well


def test_a_clock_before_the_program_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "time", lambda: 1e9)
    finding = doctor_machine.clock()
    assert finding is not None and not finding.note and "the system clock says" in finding.problem


def test_nodes_of_the_same_name(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    nodes = [Node("pdm_driver", context=context)]
    try:
        none = doctor_machine.running_nodes("elsewhere")
        assert none.note and "./dm up" in none.cure
        once = doctor_machine.running_nodes()
        assert once.note and f"pdm_driver, in the ROS domain {domain}" in once.problem
        assert "not running: interferometer (no maps" in once.problem and "pdm_driver (" not in once.problem
        nodes.append(Node("pdm_driver", context=context))
        twice = doctor_machine.running_nodes()
        assert not twice.note and "pdm_driver: running more than once" in twice.problem
    finally:
        for node in nodes:
            node.destroy_node()
        context.try_shutdown()


def test_a_node_on_a_machine_with_another_clock(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("pdm_driver", context=context)
    publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def wait_and_publish(condition: Any, _timeout_s: float) -> bool:
        # In place of the once a second of a real node.
        report = DiagnosticArray(status=[DiagnosticStatus(name="pdm_driver")])
        report.header.stamp.sec = int(time.time()) - 60

        def again() -> Any:
            publisher.publish(report)
            return condition()

        return bool(wait_until(again, 60))

    monkeypatch.setattr("dm_client.client.DeformableMirrorClient.wait", lambda _self, *a: wait_and_publish(*a))
    try:
        from dm_client import DeformableMirrorClient

        with DeformableMirrorClient() as client:
            finding = doctor_machine._skew(client)
    finally:
        node.destroy_node()
        context.try_shutdown()
    assert finding is not None and "the clock of pdm_driver and this one differ by 6" in finding.problem


def test_the_command_tells_everything_and_fails_for_what_is_wrong(tmp_path: Path, domain: int) -> None:
    config = bench({"interferometer": {"watch_folder": str(tmp_path / "missing")}, "pdm_driver": {"volts.max": "high"}})
    del config["virtual_bench"]
    file, figures = tmp_path / "my_bench.yaml", tmp_path / "doctor.json"
    file.write_text(yaml.safe_dump({f"/**/{node}": {"ros__parameters": values} for node, values in config.items()}))
    done = subprocess.run(
        [sys.executable, "-m", "dm_tools", "doctor", "--config", str(file), "--json", str(figures)],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert "volts.max = 'high': must be a finite float" in done.stdout
    assert "cure:" in done.stdout
    findings = json.loads(figures.read_text())["doctor"]
    assert findings["packages"] is None
    assert Finding(**findings[f"watched folder {tmp_path / 'missing'}"]).problem.endswith("does not exist")


@pytest.mark.parametrize(
    ("name", "value"), [("ROS_DOMAIN_ID", "233"), ("ROS_DOMAIN_ID", "x"), ("ROS_LOG_DIR", "/dev/null/x")]
)
def test_where_no_node_can_be_made_the_rest_is_checked_all_the_same(name: str, value: str, domain: int) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "dm_tools", "doctor"],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain), name: value},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1 and "WRONG" in done.stdout and "clock" in done.stdout, done.stdout + done.stderr


def test_a_file_that_is_none_is_told(tmp_path: Path) -> None:
    file = tmp_path / "bench.yaml"
    file.write_text("pdm_drivr:\n  ros__parameters: {}\n")
    [(_name, run)] = doctor_bench.bench_checks(file)
    finding = run()
    assert finding is not None and "no node of that name; known: virtual_bench, pdm_driver" in finding.problem


def test_of_a_file_for_two_mirrors_the_one_that_is_named_is_checked(tmp_path: Path) -> None:
    file = tmp_path / "both.yaml"
    file.write_text("".join(f"/{name}/pdm_driver: {{ros__parameters: {{{name}: 1}}}}\n" for name in ("left", "right")))
    checks = dict(doctor_bench.bench_checks(file, "/right"))
    found = checks["parameters"]()
    assert found is not None and "right" in found.problem and "left" not in found.problem
