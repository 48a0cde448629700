"""Answers of nodes to new values of their parameters, and of nodes at rest: part of the section Answers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from dm_msgs.srv import GetFocusRange, ListCalibrations, SetFocus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter as Message
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter

from dm_bringup.nodes import NODES
from dm_client.connection import Connection
from dm_common.ros.clients import call
from dm_common.values import Value

PATIENCE_S = 60.0
#: Node, parameter and value: valid ones, wrong ones, an unknown one, and those that can be set only in another state.
SHOWN: tuple[tuple[str, str, Any], ...] = (
    ("focus_controller", "reachable_tolerance", 3e-8),
    ("focus_controller", "reachable_tolerance", 1),
    ("focus_controller", "reachable_tolerance", "much"),
    ("focus_controller", "reachable_tolernce", 3e-8),
    ("focus_controller", "settle_time", 0.2),
    ("calibration", "calibration_folder", "/data"),
    ("pdm_driver", "mirror.serial", "another"),
    ("pdm_driver", "limits.watchdog", float("nan")),
    ("interferometer", "aperture.radius", 0.05),
    ("autofocus", "optics.rest_distance", 5.0),
    ("virtual_bench", "seed", 2),
)
#: Requests to nodes at rest: node, service and type.
AT_REST = (
    ("calibration", "list_calibrations", ListCalibrations),
    ("focus_controller", "set_focus", SetFocus),
    ("autofocus", "get_focus_range", GetFocusRange),
)


def _wrong(value: Value) -> Iterator[Any]:
    """Wrong values: of another type; for numbers, also beyond the largest, and NaN."""
    kind = None if value.many else value.kind
    yield 1.5 if kind is str else "nonsense"
    if kind in (int, float) and math.isfinite(value.high):
        yield value.kind(2 * value.high + 1)
    if kind is float:
        yield math.nan


class Nodes:
    """Parameters and states of the running nodes, by the services that every node has."""

    def __init__(self, connection: Connection) -> None:
        self._node = connection.node
        self._clients: dict[str, Any] = {}

    def call_service(self, kind: Any, name: str, request: Any) -> Any:
        """The answer of a service."""
        if name not in self._clients:
            self._clients[name] = self._node.create_client(kind, name)
        return call(self._clients[name], request, PATIENCE_S)

    def put(self, node: str, name: str, value: Any) -> str:
        """Set a parameter; the reason why it was refused, "" = it was not."""
        return self._put(node, Parameter(name, value=value).to_parameter_msg())

    def _put(self, node: str, message: Message) -> str:
        (result,) = self.call_service(
            SetParameters, f"{node}/set_parameters", SetParameters.Request(parameters=[message])
        ).results
        return "" if result.successful else result.reason

    def check_every_parameter(self) -> None:
        """Set every parameter to wrong values, and then to its own again.

        Raises:
            AssertionError: an answer that does not name the parameter.
        """
        for node in NODES:
            for parameter in node.load_parameters():
                name = parameter.name
                for value in _wrong(parameter.value):
                    reason = self.put(node.name, name, value)
                    assert name in reason, f"{node.name}: {name} = {value!r}: {reason!r}"
                request = GetParameters.Request(names=[name])
                (now,) = self.call_service(GetParameters, f"{node.name}/get_parameters", request).values
                again = self._put(node.name, Message(name=name, value=now))
                fixed = name in again and "read-only" in again and not parameter.live  # for the life of the process
                assert not again or fixed, f"{node.name}: {name}: {again!r}"

    def change(self, node: str, transition: int) -> None:
        """Have a node change its state."""
        answer = self.call_service(
            ChangeState, f"{node}/change_state", ChangeState.Request(transition=Transition(id=transition))
        )
        assert answer.success, f"{node}: transition {transition}"

    def at_rest(self) -> Iterator[tuple[str, str, int, str]]:
        """Interface, state, code and sentence of requests to nodes that are not active."""
        for node, name, kind in AT_REST:
            self.change(node, Transition.TRANSITION_DEACTIVATE)
            answer = self.call_service(kind, name, kind.Request())
            self.change(node, Transition.TRANSITION_ACTIVATE)
            yield name, f"{node} is inactive", answer.error_code, answer.message
