"""Declared parameters: defaults, ranges, live changes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import pytest
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from dm_common.ros.parameters import REQUIRED, Parameter, ParameterError, declare, frame_id, parameters_of
from dm_common.values import from_values, live_parameter, parameter, real, reals, text, whole
from ros_fixtures import Observer

TABLE = (
    Parameter("serial", text(REQUIRED), "serial number of the mirror"),
    Parameter("gain", real(2.0, 0.0, 100.0, "V/V"), "gain of the amplifier", live=True),
    Parameter("count", whole(3, 1, 5), "how many"),
    Parameter("kind", text("a", choices=("a", "b")), "which kind"),
    Parameter("positions", reals([], -1.0, 1.0, "m"), "where"),
)


@dataclass(frozen=True)
class Lamp:
    """A lamp."""

    power: float = live_parameter(real(2.0, 0.0, 9.0, "W"), "how bright")
    places: tuple[float, ...] = parameter(reals([], -1.0, 1.0, "m"), "where")
    number: int = 7


def test_fields_of_a_dataclass_are_parameters_and_are_made_of_their_values() -> None:
    table = [*parameters_of("lamp.", Lamp(power=3.0))]
    assert [(each.name, each.default, each.live) for each in table] == [
        ("lamp.power", 3.0, True),
        ("lamp.places", [], False),
    ]
    assert from_values(Lamp, {"lamp.power": 4.0, "lamp.places": [0.5], "seed": 1}, "lamp.", number=8) == Lamp(
        4.0, (0.5,), 8
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


def get_all(node: Node) -> dict[str, Any]:
    """What `ros2 param dump` asks for: all parameters at once, which fails when one of them has no value."""
    return {item.name: item.value for item in node.get_parameters(node.list_parameters([], 0).names)}


def test_every_parameter_has_a_value_empty_lists_too(observer: Observer) -> None:
    node = node_with(observer, "dumped", serial="S1")
    declare(node, TABLE)
    dumped = get_all(node)
    assert dumped["positions"] == [] and dumped["serial"] == "S1" and dumped["gain"] == 2.0
    node.destroy_node()


def test_a_whole_number_counts_as_a_float_and_an_empty_list_is_one(observer: Observer) -> None:
    node = node_with(observer, "converted", serial="S1", gain=3, positions=[0, 1])
    values = declare(node, [*TABLE, Parameter("levels", reals([], -1.0, 1.0), "how far", live=True)])
    assert (values["gain"], values["positions"]) == (3.0, [0.0, 1.0])
    assert get_all(node)["gain"] == 3.0
    assert node.set_parameters([RosParameter("gain", value=7)])[0].successful
    with pytest.raises(ParameterNotDeclaredException, match="gain = 'much': must be"):  # so the service says it
        node.set_parameters([RosParameter("gain", value="much")])
    assert isinstance(values["gain"], float) and values["gain"] == 7.0
    # What `ros2 param load` makes of 3e-01, [0.5, 3e-01] and [3e-01, 4e-01].
    texts: dict[str, Any] = {"3e-01": ("gain", 0.3), "[0.5, 3e-01]": ("levels", [0.5, 0.3])}
    for given, (name, number) in texts.items():
        assert node.set_parameters([RosParameter(name, value=given)])[0].successful
        assert values[name] == number
    assert node.set_parameters([RosParameter("levels", value=["3e-01", "4e-01"])])[0].successful
    assert values["levels"] == [0.3, 0.4]
    with pytest.raises(ParameterNotDeclaredException, match=r"levels = 0\.5: must be"):
        node.set_parameters([RosParameter("levels", value=0.5)])
    node.destroy_node()
    empty = Node(
        "empty", parameter_overrides=[RosParameter("serial", value="S1"), RosParameter("positions", value=None)]
    )
    assert declare(empty, TABLE)["positions"] == []
    empty.destroy_node()


@pytest.mark.parametrize("name", ["limits.stepp", "gian"])
def test_a_misspelt_parameter_is_refused_with_the_right_spelling(observer: Observer, name: str) -> None:
    table = (*TABLE, Parameter("limits.step", real(0.1, 0.0, 2.0), "step"))
    node = node_with(observer, "misspelt", serial="S1", **{name: 0.1})
    with pytest.raises(ParameterError, match=r"did you mean (limits\.step|gain)"):
        declare(node, table)
    node.destroy_node()


def test_parameters_of_other_nodes_are_no_misspelling(observer: Observer) -> None:
    node = node_with(observer, "shared", serial="S1", **{"camera.rate": 5.0, "use_sim_time": False})
    declare(node, TABLE)
    node.destroy_node()


def test_setting_an_unknown_parameter_names_the_near_one(observer: Observer) -> None:
    node = node_with(observer, "set_unknown", serial="S1")
    declare(node, TABLE)
    with pytest.raises(ParameterNotDeclaredException, match="did you mean gain"):
        node.set_parameters([RosParameter("gian", value=1.0)])
    node.destroy_node()


def test_a_lifecycle_node_is_put_right_before_it_is_configured(observer: Observer) -> None:
    configured = False
    node = node_with(observer, "lifecycle", count=9)
    values = declare(node, TABLE, locked=lambda: "deactivate`, then `cleanup" if configured else "")
    with pytest.raises(ParameterError, match=r"serial is required.*count = 9"):
        values.check()
    assert get_all(node)["count"] == 3
    assert node.set_parameters([RosParameter("serial", value="S1")])[0].successful
    assert node.set_parameters([RosParameter("count", value=4)])[0].successful
    values.check()
    assert (values["serial"], values["count"]) == ("S1", 4)
    configured = True
    refused = node.set_parameters([RosParameter("serial", value="S2")])[0]
    assert "not configured: `ros2 lifecycle set /lifecycle deactivate`, then `cleanup` first" in refused.reason
    assert values["serial"] == "S1"
    assert node.set_parameters([RosParameter("gain", value=5.0)])[0].successful
    # `ros2 param load` of a dump: what stays as it is may be set.
    dumped = {name: given for name, given in get_all(node).items() if name in values} | {"gain": 6.0}
    loaded = [RosParameter(name, value=given) for name, given in dumped.items()]
    assert node.set_parameters_atomically(loaded).successful and values["gain"] == 6.0
    node.destroy_node()


@pytest.mark.parametrize(
    ("namespace", "frame"), [("", "mirror"), ("left", "left/mirror"), ("lab/left", "lab/left/mirror")]
)
def test_every_mirror_has_a_frame_of_its_own(observer: Observer, namespace: str, frame: str) -> None:
    node = Node("framed", namespace=namespace)
    assert frame_id(node, "") == frame
    assert frame_id(node, "bench_2") == "bench_2"
    node.destroy_node()
