"""`ros2 launch` and `./dm up` start the same nodes, without the packages launch and launch_ros."""

from __future__ import annotations

import runpy
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
import yaml

from dm_bringup.nodes import HELD_SIGNALS, LAUNCH_ARGUMENTS, NAMES, NODES, arguments_of, companions_of, nodes_of
from dm_bringup.sections import ConfigError
from dm_bringup.suite import load_config

SHARE = Path(__file__).resolve().parents[1]


DEFAULTS = {name: default or "" for name, default, _text in LAUNCH_ARGUMENTS}


class _Recorded:
    """Stands in for any class of the packages launch and launch_ros, which the environment of wheels lacks."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        self.arguments, self.keywords = arguments, keywords

    def perform(self, context: dict[str, str]) -> str:
        return context.get(self.arguments[0], self.keywords.get("default", ""))


def _brought_up(start: _Recorded, transition: _Recorded) -> tuple[Any, Any]:
    """What the handlers of a node's start and of its configuration call."""
    (timer,) = start.arguments[0].keywords["on_start"]
    asked, configured = timer.keywords["actions"][0], transition.arguments[0].keywords["entities"][0]
    return asked.keywords["function"], configured.keywords["function"]


class _Managed(_Recorded):
    """A lifecycle node."""


@pytest.mark.parametrize(
    ("config", "nodes"),
    [("bench.yaml", NAMES[:5]), ("hardware.yaml", NAMES[1:5]), ("camera.yaml", NAMES[1:])],
)
def test_launch_files_start_what_up_starts(
    config: str, nodes: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("LaunchConfiguration", "OpaqueFunction", "GroupAction", "TimerAction", "RegisterEventHandler")
    stand_ins = dict.fromkeys((*names, "OnProcessStart"), _Recorded)
    of_nodes = {"Node": _Recorded, "LifecycleNode": _Managed, "OnStateTransition": _Recorded}
    parts = ("actions", "event_handlers", "events", "substitutions", "launch_description_sources")
    for name in ("launch", *(f"launch.{part}" for part in parts)):
        monkeypatch.setitem(sys.modules, name, MagicMock(**stand_ins))
    for name in ("", ".actions", ".event_handlers", ".events", ".events.lifecycle"):
        monkeypatch.setitem(sys.modules, f"launch_ros{name}", MagicMock(**of_nodes))
    monkeypatch.setattr(sys.modules["launch"], "LaunchDescription", _Recorded)
    folder = SHARE / "config"
    path = folder / config
    if not path.is_file():
        path = tmp_path / config
        path.write_text((folder / "hardware.yaml").read_text() + "/**/autofocus: {ros__parameters: {}}\n")
    for file in ("bench.launch.py", "suite.launch.py"):
        launch = runpy.run_path(str(SHARE / "launch" / file))
        description = launch["generate_launch_description"]()
    group = description.arguments[0][-1]
    assert group.keywords["scoped"]
    start_nodes = group.arguments[0][-1].keywords["function"]
    actions = start_nodes(DEFAULTS | {"config": str(path)})
    assert tuple(action.keywords["executable"] for action in actions) == nodes
    assert tuple(node.name for node in nodes_of(load_config(path))) == nodes
    assert {action.keywords["parameters"][0] for action in actions} == {str(path)}
    assert {action.keywords["prefix"] for action in actions} == {HELD_SIGNALS}
    debugged = start_nodes(DEFAULTS | {"config": str(path), "launch-prefix": "gdb --args"})
    assert {action.keywords["prefix"] for action in debugged} == {None}  # launch puts it there by itself
    managed = [action.keywords["executable"] for action in actions if isinstance(action, _Managed)]
    assert managed == [name for name in nodes if name != "virtual_bench"]
    # By events: a handler of its start and one of its configuration before each of them.
    driven = start_nodes(DEFAULTS | {"config": str(path), "autostart": "events"})
    assert [isinstance(action, _Managed) for action in driven[-3:]] == [False, False, True]
    assert driven[-1].keywords["parameters"][1] == {"autostart": False} and len(driven) == len(nodes) + 2 * len(managed)
    asks, goes_on = _brought_up(*driven[-3:-1])
    events = (SimpleNamespace(event=SimpleNamespace(goal_state=state)) for state in ("unconfigured", "inactive"))
    refused, done = (SimpleNamespace(locals=event) for event in events)
    assert goes_on(done) == []  # somebody else configured it: activating it is theirs
    assert asks(None) and goes_on(done) and goes_on(done) == []
    assert asks(None) and goes_on(refused) == [] and goes_on(done) == []
    with pytest.raises(ConfigError, match=r"none\.yaml: No such file"):
        start_nodes(DEFAULTS | {"config": str(tmp_path / "none.yaml")})
    for rate in ('"fast"', "[30.0]"):
        wrong = tmp_path / "wrong.yaml"
        wrong.write_text(f"/**/virtual_bench: {{ros__parameters: {{camera.rate: {rate}}}}}\n")
        with pytest.raises(ValueError, match=r"virtual_bench: camera\.rate: .*: must be a number"):
            start_nodes(DEFAULTS | {"config": str(wrong)})


@pytest.mark.parametrize("signals", [(signal.SIGINT,), (signal.SIGINT, signal.SIGTERM)])
def test_signals_wait_until_a_node_has_imported_what_it_needs(domain: int, signals: tuple[int, ...]) -> None:
    script = "print('begun', flush=True); input(); from dm_common.ros.executor import run_node; run_node(lambda: 1 / 0)"
    command = [*HELD_SIGNALS.split(), sys.executable, "-c", script]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "begun\n"
        for number in signals:  # `ros2 launch` sends the second one after 5 s
            process.send_signal(number)
        assert process.communicate("\n", timeout=60.0)[1] == "" and process.returncode == 0


def test_the_health_of_every_node_has_its_place_in_the_aggregator() -> None:
    (section,) = yaml.safe_load((SHARE / "launch" / "diagnostics.yaml").read_text()).values()
    analyzers = [value for value in section["ros__parameters"].values() if isinstance(value, dict)]
    assert sorted(name for analyzer in analyzers for name in analyzer["contains"]) == sorted(NAMES)
    assert all(analyzer["timeout"] > 2.0 and analyzer["path"] for analyzer in analyzers)


def test_the_place_of_the_mirror_and_what_others_offer() -> None:
    given = DEFAULTS | {"place": "0.1 0 0.3 0 0 1.57 base_link", "namespace": "left", "foxglove": "true"}
    place, bridge, aggregator = companions_of(given | {"aggregator": "true"}, SHARE / "launch" / "diagnostics.yaml")
    assert place["package"] == "tf2_ros" and place["arguments"][-4:] == [
        *("--frame-id", "base_link"),
        *("--child-frame-id", "left/mirror"),
    ]
    assert bridge["package"] == "foxglove_bridge" and Path(aggregator["parameters"][0]).is_file()
    assert companions_of(DEFAULTS, SHARE) == []
    (pushed, _bridge) = companions_of(given, SHARE, pushed="/robot1")
    child = pushed["arguments"].index("--child-frame-id") + 1
    assert pushed["arguments"][child] == "robot1/left/mirror" and pushed["namespace"] == given["namespace"]
    (absolute, _bridge) = companions_of(given | {"namespace": "/left"}, SHARE, pushed="/robot1")
    assert absolute["arguments"][child] == "left/mirror"
    (optical,) = companions_of(DEFAULTS, SHARE, camera=True)
    assert optical["arguments"][-4:] == ["--frame-id", "camera_link", "--child-frame-id", "camera_optical"]
    assert optical["arguments"][6:12] == ["--yaw", "-1.5707963", "--pitch", "0", "--roll", "-1.5707963"]
    with pytest.raises(ValueError, match="place = '1 2 map': must be x y z yaw pitch roll frame"):
        companions_of(DEFAULTS | {"place": "1 2 map"}, SHARE)
    with pytest.raises(ValueError, match="place: 'x': must be a number"):
        companions_of(DEFAULTS | {"place": "1 2 x 4 5 6 map"}, SHARE)


def test_what_a_fleet_sets_reaches_every_node() -> None:
    given = {"config": "c.yaml", "namespace": "left", "remap": "image_raw:=/camera/image_raw", "log_level": "debug"}
    for node in NODES:
        action = arguments_of(node, DEFAULTS | given | {"autostart": "false", "use_sim_time": "true"})
        own = {"autostart": False} if node.lifecycle else {}
        assert action["parameters"] == ["c.yaml", {"use_sim_time": True} | own]
        assert action["remappings"] == [("image_raw", "/camera/image_raw")] and action["namespace"] == "left"
        assert action["arguments"][-1] == "debug"
        assert (action["respawn"], action["respawn_delay"]) == (True, 2.0)
    assert arguments_of(NODES[0], DEFAULTS | {"config": "c.yaml"})["parameters"] == ["c.yaml"]
    wrong = {
        "respawn": "must be true or false",
        "respawn_delay": "must be a number",
        "autostart": "must be true, events or false",
        "remap": "must be of",
        "log_level": "must be one of debug, info",
    }
    for name, text in wrong.items():
        with pytest.raises(ValueError, match=f"{name}.*{text}"):
            arguments_of(NODES[1], DEFAULTS | {name: "perhaps"})
