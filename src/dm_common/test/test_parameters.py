"""Declared parameters: defaults, ranges, live changes."""

from __future__ import annotations

import math
from typing import Any

import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from dm_common.ros.parameters import REQUIRED, Parameter, ParameterError, declare, real, reals, text, whole
from ros_fixtures import Observer

TABLE = (
    Parameter("serial", text(REQUIRED), "serial number of the mirror"),
    Parameter("gain", real(2.0, 0.0, 100.0, "V/V"), "gain of the amplifier", live=True),
    Parameter("count", whole(3, 1, 5), "how many"),
    Parameter("kind", text("a", choices=("a", "b")), "which kind"),
    Parameter("positions", reals([], -1.0, 1.0, "m"), "where"),
)


def node_with(observer: Observer, name: str, **values: Any) -> Node:
    return Node(name, parameter_overrides=[RosParameter(key, value=value) for key, value in values.items()])


def test_parameters_take_defaults_and_given_values(observer: Observer) -> None:
    node = node_with(observer, "given", serial="S1", positions=[0.5, -0.5])
    values = declare(node, TABLE)
    assert values == {"serial": "S1", "gain": 2.0, "count": 3, "kind": "a", "positions": [0.5, -0.5]}
    node.destroy_node()


def test_missing_required_parameters_are_named(observer: Observer) -> None:
    node = node_with(observer, "missing")
    with pytest.raises(ParameterError, match="serial"):
        declare(node, TABLE)
    node.destroy_node()


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("gain", 101.0, "0 to 100 V/V"),
        ("gain", math.nan, "0 to 100"),
        ("count", 9, "1 to 5"),
        ("kind", "c", "one of a, b"),
        ("positions", [2.0], "-1 to 1 m"),
    ],
)
def test_values_out_of_range_are_refused_with_the_range(observer: Observer, name: str, value: Any, words: str) -> None:
    node = node_with(observer, "wrong", serial="S1", **{name: value})
    with pytest.raises((ParameterError, Exception)) as caught:
        declare(node, TABLE)
    assert name in str(caught.value)
    node.destroy_node()
    with pytest.raises(ParameterError) as refused:
        next(parameter for parameter in TABLE if parameter.name == name).check(value)
    assert words in str(refused.value)


def test_live_parameters_are_checked_and_applied_on_set(observer: Observer) -> None:
    node = node_with(observer, "live", serial="S1")
    changes: list[Any] = []
    values = declare(node, TABLE, on_change=changes.append)
    assert not node.set_parameters([RosParameter("gain", value=-1.0)])[0].successful
    assert values["gain"] == 2.0
    assert node.set_parameters([RosParameter("gain", value=5.0)])[0].successful
    assert values["gain"] == 5.0
    assert changes == [{"gain": 5.0}]
    assert not node.set_parameters([RosParameter("serial", value="S2")])[0].successful
    node.destroy_node()
