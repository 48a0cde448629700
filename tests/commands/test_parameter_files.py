"""Parameter files of all nodes: what `ros2 param dump` writes starts the node again as it was."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from dm_bringup.nodes import NODES, SuiteNode
from dm_common.ros.parameters import REQUIRED, declare
from ros_fixtures import Observer


def dump(node: Node) -> dict[str, Any]:
    """As `ros2 param dump` asks for them, all at once."""
    found = {item.name: item.value for item in node.get_parameters(node.list_parameters([], 0).names)}
    return {
        name: value if isinstance(value, bool | int | float | str) else list(value) for name, value in found.items()
    }


@pytest.mark.parametrize("entry", NODES, ids=lambda entry: str(entry.name))
def test_dump_load_dump_is_the_same(observer: Observer, entry: SuiteNode, tmp_path: Path) -> None:
    table = entry.load_parameters()
    required = {item.name: "x" if item.value.kind is str else 1.0 for item in table if item.default is REQUIRED}
    if "electronics.kind" in required:
        required["electronics.kind"] = "edac40_tcp"
    first = Node(entry.name, parameter_overrides=[RosParameter(name, value=value) for name, value in required.items()])
    declare(first, table)
    dumped = dump(first)
    first.destroy_node()
    assert dumped.keys() >= {item.name for item in table}
    file = tmp_path / "dumped.yaml"
    file.write_text(yaml.safe_dump({f"/{entry.name}": {"ros__parameters": dumped}}))
    again = Node(entry.name, cli_args=["--ros-args", "--params-file", str(file)], use_global_arguments=False)
    declare(again, table)
    assert dump(again) == dumped
    again.destroy_node()
