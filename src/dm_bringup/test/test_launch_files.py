"""`ros2 launch` and `./dm up` start the same nodes, without the packages launch and launch_ros."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from dm_bringup.nodes import NAMES, nodes_of
from dm_bringup.suite import ConfigError, load_config

SHARE = Path(__file__).resolve().parents[1]


class _Recorded:
    """Stands in for any class of the packages launch and launch_ros, which the environment of wheels lacks."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        self.arguments, self.keywords = arguments, keywords

    def perform(self, context: dict[str, str]) -> str:
        return context[self.arguments[0]]


@pytest.mark.parametrize(
    ("config", "nodes"),
    [("bench.yaml", NAMES[:5]), ("hardware.yaml", NAMES[1:5]), ("camera.yaml", NAMES[1:])],
)
def test_launch_files_start_what_up_starts(
    config: str, nodes: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("launch", "launch.actions", "launch.substitutions", "launch.launch_description_sources"):
        monkeypatch.setitem(sys.modules, name, MagicMock(LaunchConfiguration=_Recorded, OpaqueFunction=_Recorded))
    for name in ("launch_ros", "launch_ros.actions"):
        monkeypatch.setitem(sys.modules, name, MagicMock(Node=_Recorded))
    monkeypatch.setattr(sys.modules["launch"], "LaunchDescription", _Recorded)
    folder = SHARE / "config"
    path = folder / config
    if not path.is_file():
        path = tmp_path / config
        path.write_text((folder / "hardware.yaml").read_text() + "/**/autofocus: {ros__parameters: {}}\n")
    for file in ("bench.launch.py", "suite.launch.py"):
        launch = runpy.run_path(str(SHARE / "launch" / file))
        description = launch["generate_launch_description"]()
    start_nodes = description.arguments[0][-1].keywords["function"]
    actions = start_nodes({"config": str(path), "namespace": ""})
    assert tuple(action.keywords["executable"] for action in actions) == nodes
    assert tuple(node.name for node in nodes_of(load_config(path))) == nodes
    assert {action.keywords["parameters"][0] for action in actions} == {str(path)}
    with pytest.raises(ConfigError, match=r"none\.yaml: No such file"):
        start_nodes({"config": str(tmp_path / "none.yaml"), "namespace": ""})
