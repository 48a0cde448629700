"""Nodes that die are started again, later each time, and it is said."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.node import Node

from dm_bringup import suite as suite_module
from dm_bringup.sections import ConfigError
from dm_bringup.suite import RESTART_S, Suite, load_config, save_config
from dm_common.ros.domains import own_domain


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Suite]:
    """A suite of one node that runs this code."""

    def run(code: str, **arguments: Any) -> Suite:
        (tmp_path / "node_of_a_test.py").write_text(code)
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
        monkeypatch.setitem(suite_module.MODULES, "calibration", "node_of_a_test")
        return Suite({"calibration": {}}, tmp_path / "run", nodes=("calibration",), **arguments)

    return run


@pytest.mark.parametrize("text", ["0815", "1e5", "1234", "true", "10:30", "", 'a "b" \\ c', "λ"])
def test_texts_stay_texts_on_their_way_to_the_nodes(tmp_path: Path, text: str) -> None:
    """A serial such as 0815 is a number to the parser of ROS, and none to that of YAML, unless it is quoted."""
    file = tmp_path / "config.yaml"
    save_config({"pdm_driver": {"mirror.serial": text}}, file)
    assert load_config(file) == {"pdm_driver": {"mirror.serial": text}}
    context = Context()
    context.init(["--ros-args", "--params-file", str(file)])
    try:
        node = Node("pdm_driver", context=context, automatically_declare_parameters_from_overrides=True)
        assert node.get_parameter("mirror.serial").value == text
        node.destroy_node()
    finally:
        context.shutdown()


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("", "must have a value"),
        ("~", "must have a value"),
        ("[0, 0.5]", "of one type"),
        ('["--port", 12]', "of one type"),
        ('["--port", 0.5]', "of one type"),
    ],
)
def test_values_that_ros_does_not_read_are_named(tmp_path: Path, value: str, said: str) -> None:
    """`null` would be a text to ROS: a mirror of that serial."""
    file = tmp_path / "config.yaml"
    file.write_text(f"/**/pdm_driver:\n  ros__parameters:\n    mirror.serial: {value}\n")
    with pytest.raises(ConfigError, match=rf"config\.yaml: /\*\*/pdm_driver: mirror\.serial.*{said}"):
        load_config(file)


NUMBERS = ["7e-3", "-.5E+2", "1e5", "2.e0", "[1e5, 0.5]", "0815", "017", "0x1f", "-.inf", "-inf", "Infinity", "y", "N"]
TEXTS = ["'7e-3'", "e5", "7e", "2024-01-05", "10:30", "2024_05", "0b11", "0x_", "yEs", ".iNF", "infinit"]


@pytest.mark.parametrize("text", NUMBERS + TEXTS)
def test_numbers_are_what_ros_takes_for_one(tmp_path: Path, text: str) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(f"/**/pdm_driver:\n  ros__parameters:\n    mirror.pitch: {text}\n")
    context = Context()
    context.init(["--ros-args", "--params-file", str(file)])
    try:
        node = Node("pdm_driver", context=context, automatically_declare_parameters_from_overrides=True)
        assert load_config(file)["pdm_driver"]["mirror.pitch"] == node.get_parameter("mirror.pitch").value
        node.destroy_node()
    finally:
        context.shutdown()


@pytest.mark.parametrize(
    ("value", "said"), [("&here [*here]", r"ROS reads no alias \(\*here\)"), ("!!bool x", "'x'"), ("!!int x", "'x'")]
)
def test_what_yaml_allows_and_ros_does_not_is_refused(tmp_path: Path, value: str, said: str) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(f"/**/pdm_driver: {{ros__parameters: {{safe_signals: {value}}}}}\n")
    with pytest.raises(ConfigError, match=rf"config\.yaml: not a YAML file in UTF-8: .*{said}"):
        load_config(file)


def test_a_section_of_all_nodes_counts_for_each_that_runs(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    of_all = "/**: {ros__parameters: {use_sim_time: true, rate: 1.0}}\n"
    of_each = "/**/calibration: {ros__parameters: {rate: 2.0}}\npdm_driver: {ros__parameters: {}}\n"
    file.write_text(of_all + of_each)
    named = {"use_sim_time": True, "rate": 1.0}
    nodes = load_config(file)
    assert nodes["calibration"] == named | {"rate": 2.0} and nodes["pdm_driver"] == nodes["focus_controller"] == named
    assert "virtual_bench" not in nodes


def test_groups_of_parameters_are_names_and_two_mirrors_are_two_files(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("/left/pdm_driver: {ros__parameters: {volts: {min: 0.0, max: 100.0}, simple: 1}}\n")
    assert load_config(file) == {"pdm_driver": {"volts.min": 0.0, "volts.max": 100.0, "simple": 1}}
    with file.open("a") as lines:
        lines.write("/right/pdm_driver: {ros__parameters: {volts.max: 300.0}}\n")
    with pytest.raises(ConfigError, match="/right/pdm_driver: a second section of pdm_driver"):
        load_config(file)
    assert load_config(file, "right") == {"pdm_driver": {"volts.max": 300.0}}
    of_all = "/**/pdm_driver: {ros__parameters: {volts.max: 200.0, simple: 2}}\n"
    file.write_text(of_all + file.read_text())
    assert load_config(file, "right") == {"pdm_driver": {"volts.max": 300.0, "simple": 2}}
    file.write_text("/left/**/pdm_driver: {ros__parameters: {simple: 1}}\n")  # of nodes below /left only
    assert load_config(file, "left") and load_config(file, "left/upper") and not load_config(file, "right")
    section = "/**/pdm_driver: {ros__parameters: {volts.max: 300.0}}\n"
    file.write_text(f"{section}{section}")  # ROS takes both, YAML the last
    with pytest.raises(ConfigError, match=r"/\*\*/pdm_driver comes twice"):
        load_config(file)
    file.write_text("# 3 µm\n", encoding="latin-1")  # as some editors of Windows do
    with pytest.raises(ConfigError, match=r"config\.yaml: not a YAML file in UTF-8"):
        load_config(file)


@pytest.mark.parametrize("namespace", ["left", "right", "left/upper", "lab/left"])
def test_sections_count_as_they_do_to_ros(tmp_path: Path, namespace: str) -> None:
    file = tmp_path / "config.yaml"
    places = ("/**", "/**/pdm_driver", "/*/pdm_driver", "/**/left/pdm_driver", "/*/left/pdm_driver", "/left/**")
    keys = (*places, "/left/**/pdm_driver", "/left/pdm_driver", "/right/pdm_driver", "/lab/left/pdm_driver")
    # The same name in each, the last of a kind counts; and one that tells whether the section is taken.
    save = {key: {"ros__parameters": {"mirror.serial": key, f"of{place}": 1}} for place, key in enumerate(keys)}
    file.write_text(yaml.safe_dump(save, sort_keys=False))
    context = Context()
    rclpy.init(args=["--ros-args", "--params-file", str(file), "-r", f"__ns:=/{namespace}"], context=context)
    try:
        node = rclpy.create_node("pdm_driver", context=context)
        to_ros = {name: given.value for name, given in node._parameter_overrides.items()}
        node.destroy_node()
    finally:
        context.shutdown()
    assert load_config(file, namespace)["pdm_driver"] == to_ros


@pytest.mark.parametrize("general", ["/**", "/**/pdm_driver"])
def test_a_general_section_that_would_overrule_a_particular_one_is_refused(tmp_path: Path, general: str) -> None:
    file = tmp_path / "config.yaml"
    own, of_all = (
        f"{key}: {{ros__parameters: {{volts.max: {volts}}}}}\n"
        for key, volts in (("/left/pdm_driver", 100.0), (general, 300.0))
    )
    file.write_text(of_all + own)
    assert load_config(file, "left")["pdm_driver"] == {"volts.max": 100.0}
    file.write_text(own + of_all)
    overruled = "volts.max: 300.0 overrules 100.0 of /left/pdm_driver, since the last one counts"
    text = f"{general}: {overruled}: put {general} before it"
    with pytest.raises(ConfigError, match=re.escape(text)):
        load_config(file, "left")
    assert load_config(file, "right")["pdm_driver"] == {"volts.max": 300.0}


def revived(suite: Suite, count: int) -> tuple[list[str], list[float]]:
    """What is said until so many restarts, and the pauses before them, s."""
    said: list[str] = []
    times: list[float] = []

    def say(text: str) -> None:
        said.append(text)
        times.append(time.monotonic())

    deadline = time.monotonic() + 30.0
    while len(said) < 2 * count and time.monotonic() < deadline:
        suite.revive(say)
        time.sleep(0.01)
    return said, [times[2 * k + 1] - times[2 * k] for k in range(count)]


def test_a_node_is_told_its_namespace_and_other_names_of_topics(run: Callable[..., Suite], tmp_path: Path) -> None:
    code = "import sys; print(sys.argv[1:], flush=True); sys.stdin.read()"
    mine = tmp_path / "run" / "config.yaml"
    mine.parent.mkdir()
    mine.write_text("# logs are to lie beside it\n")
    with run(code, namespace="/left", remap=["image_raw:=/camera/image_raw"]) as suite:
        deadline = time.monotonic() + 30.0
        while not suite.log("calibration").read_text() and time.monotonic() < deadline:
            time.sleep(0.01)
        said = suite.log("calibration").read_text()
    assert "'-r', 'image_raw:=/camera/image_raw', '-r', '__ns:=/left'" in said
    assert mine.read_text() == "# logs are to lie beside it\n"
    with pytest.raises(ValueError, match="remap: 'image_raw': must be of the form from:=to"):
        run(code, remap=["image_raw"])


@pytest.mark.slow
def test_a_node_that_dies_is_started_again_later_each_time(run: Callable[..., Suite]) -> None:
    with run("import os; os.kill(os.getpid(), 9)") as suite:
        said, pauses = revived(suite, 2)
    assert said[0] == f"the node calibration was killed by signal 9; it is started again in {RESTART_S:g} s"
    assert said[1] == "the node calibration is started again" and said[2].endswith(f"in {2 * RESTART_S:g} s")
    assert pauses[0] >= RESTART_S and pauses[1] >= 2 * RESTART_S


def test_a_node_that_cannot_be_made_is_not_tried_again(run: Callable[..., Suite]) -> None:
    with run("import sys; sys.exit('ParameterError: mirror.serial is missing')") as suite:
        with pytest.raises(RuntimeError, match=r"calibration ended with status 1\nParameterError: mirror.serial"):
            revived(suite, 1)


def test_the_node_that_could_not_be_made_is_named_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    codes = {"calibration": "import os; os.kill(os.getpid(), 9)", "focus_controller": "import sys; sys.exit('wrong')"}
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    for name, code in codes.items():
        (tmp_path / f"{name}_of_a_test.py").write_text(code)
        monkeypatch.setitem(suite_module.MODULES, name, f"{name}_of_a_test")
    with Suite({name: {} for name in codes}, tmp_path / "run", nodes=tuple(codes)) as suite:
        deadline = time.monotonic() + 30.0
        while len(suite.ended()) < len(codes) and time.monotonic() < deadline:
            time.sleep(0.01)
        with pytest.raises(RuntimeError, match="focus_controller ended with status 1\nwrong"):
            suite.revive(lambda _text: None)


NODE = """
import rclpy.node
from dm_common.ros.executor import run_node

class Mine(rclpy.node.Node):
    def __init__(self):
        super().__init__("mine")
        print("made", flush=True)

    def make_safe(self):
        print("safe", flush=True)

run_node(Mine)
"""
KILLED_SUITE = """
import os, pathlib, sys
from dm_bringup import suite

suite.MODULES["calibration"] = "node_of_a_test"
with suite.Suite({"calibration": {}}, pathlib.Path(sys.argv[1]), nodes=("calibration",)) as running:
    while "made" not in running.log("calibration").read_text():
        pass
    os.kill(os.getpid(), 9)
"""


@pytest.mark.processes
def test_nodes_go_with_a_suite_that_is_killed(run: Callable[..., Suite], tmp_path: Path) -> None:
    log = run(NODE).log("calibration")
    with own_domain() as domain:
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
        subprocess.run([sys.executable, "-c", KILLED_SUITE, str(log.parent)], env=environment, timeout=60.0)
        deadline = time.monotonic() + 30.0
        while log.read_text() != "made\nsafe\n" and time.monotonic() < deadline:
            time.sleep(0.01)
    assert log.read_text() == "made\nsafe\n"
