"""Lifecycle nodes: started by themselves, refusing while they rest, ending goals, and put right before they go on."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from dm_msgs.action import MoveFocus
from dm_msgs.srv import Flatten
from rclpy.action import ActionClient
from rclpy.parameter import Parameter as RosParameter

from dm_common.errors import ErrorCode
from dm_common.ros.executor import BackgroundExecutor
from dm_common.ros.lifecycle import ERROR, OK, WARN, ManagedNode
from dm_common.ros.parameters import AUTOSTART, Parameter
from dm_common.ros.worker import WorkerActionServer, WorkerGoal, WorkerService, sleep
from dm_common.values import real, whole
from ros_fixtures import Observer
from waiting import wait_until

TABLE = (
    AUTOSTART,
    Parameter("gain", real(2.0, 0.0, 10.0), "gain", live=True),
    Parameter("count", whole(3, 0, 10), "count; 7 will not do with anything, 8 and 9 will not begin"),
)


class Example(ManagedNode):
    """Writes down what it does."""

    def __init__(self, **keywords: Any) -> None:
        super().__init__("example", TABLE, **keywords)
        self.did: list[str] = []
        WorkerService(self, Flatten, "flatten", lambda _request, response: response)
        WorkerActionServer(self, MoveFocus, "move_focus", self.run)

    def run(self, goal: WorkerGoal) -> tuple[str, Any]:
        if sleep(self.get_clock(), 30.0, lambda: goal.is_cancel_requested):
            return "succeed", MoveFocus.Result()
        if goal.request.tolerance > 0.0:
            return "succeed", MoveFocus.Result(message="it was too late")
        return "canceled", MoveFocus.Result(error_code=ErrorCode.CANCELED, message="canceled where it was")

    def configure(self) -> None:
        if self._values["count"] == 7:
            raise ValueError("count = 7: will not do")
        self.did.append(f"configure {self._values['count']}")

    def activate(self) -> None:
        if self._values["count"] == 9:
            raise KeyError("a defect of the node")
        if self._values["count"] == 8:
            raise ValueError("count = 8: will not begin")
        self.did.append("activate")

    def deactivate(self) -> None:
        self.did.append("deactivate")

    def clean_up(self) -> None:
        self.did.append("clean up")

    @property
    def level(self) -> bytes:
        return self._health_in_any_state().level

    def put(self, name: str, value: Any) -> str:
        """Set a parameter; the reason why not."""
        return str(self.set_parameters([RosParameter(name, value=value)])[0].reason)


@pytest.fixture
def served(observer: Observer) -> Iterator[Example]:
    node = Example(context=observer.node.context)
    executor = BackgroundExecutor(node)
    wait_until(lambda: node.active)
    yield node
    executor.destroy_node()


def test_a_node_that_rests_refuses_and_ends_its_goals(served: Example, observer: Observer) -> None:
    assert served.did == ["configure 3", "activate"] and served.level == OK
    client = ActionClient(observer.node, MoveFocus, "move_focus")
    wait_until(client.server_is_ready)
    accepted = client.send_goal_async(MoveFocus.Goal())
    wait_until(accepted.done)
    ended = accepted.result().get_result_async()
    assert observer.call(Flatten, "flatten").error_code == ErrorCode.OK
    served.trigger_deactivate()
    wait_until(ended.done)
    assert ended.result().status == GoalStatus.STATUS_ABORTED
    result = ended.result().result
    assert (result.error_code, result.message) == (ErrorCode.CANCELED, "example was deactivated: canceled where it was")
    answer = observer.call(Flatten, "flatten")
    assert answer.error_code == ErrorCode.NODE_INACTIVE and "ros2 lifecycle set /example activate" in answer.message
    accepted = client.send_goal_async(MoveFocus.Goal())
    wait_until(accepted.done)
    refused = accepted.result().get_result_async()
    wait_until(refused.done)
    assert refused.result().result.error_code == ErrorCode.NODE_INACTIVE
    assert served.level == WARN
    served.trigger_activate()
    assert observer.call(Flatten, "flatten").error_code == ErrorCode.OK
    client.destroy()


def test_a_goal_that_is_done_all_the_same_says_so(served: Example, observer: Observer) -> None:
    _handle, ended = observer.send_goal(MoveFocus, "move_focus", MoveFocus.Goal(tolerance=1.0))
    served.trigger_deactivate()
    wait_until(ended.done)
    assert ended.result().status == GoalStatus.STATUS_SUCCEEDED
    assert ended.result().result.message == "it was too late"


def test_parameters_change_while_it_rests_and_wrong_ones_keep_it_resting(observer: Observer) -> None:
    node = Example(context=observer.node.context, parameter_overrides=[RosParameter("count", value=11)])
    node.autostart()
    assert not node.configured and node.level == ERROR and "count = 11" in node.inactive()
    assert node.put("count", 5) == ""
    node.trigger_configure()
    node.trigger_activate()
    assert node.active and node.level == OK
    assert "ros2 lifecycle set /example deactivate" in node.put("count", 4) and node.put("gain", 1.0) == ""
    node.trigger_deactivate()
    assert node.put("count", 7) == ""
    node.trigger_activate()
    assert not node.active and node.configured and "count = 7: will not do" in node.inactive()
    assert node.put("count", 8) == ""
    node.trigger_activate()
    assert not node.active and "count = 8: will not begin" in node.inactive()
    assert node.put("count", 4) == ""
    node.trigger_activate()
    assert node.did[-2:] == ["configure 4", "activate"]
    node.trigger_shutdown()
    assert node.did[-2:] == ["deactivate", "clean up"] and not node.configured
    assert node.inactive() == "example was shut down: start its process again"
    node.destroy_node()


def test_the_transitions_that_a_parameter_needs_are_those_that_can_be_made(
    observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Example, "requires_activation", False)
    node = Example(context=observer.node.context, parameter_overrides=[RosParameter("count", value=3)])
    node.autostart()
    assert "`ros2 lifecycle set /example deactivate`, then `cleanup` first" in node.put("count", 4)
    node.trigger_deactivate()
    assert "`ros2 lifecycle set /example cleanup` first" in node.put("count", 4)
    node.trigger_cleanup()
    assert node.put("count", 4) == ""
    node.destroy_node()


def test_a_node_that_fails_by_a_defect_says_so_until_it_goes(observer: Observer) -> None:
    node = Example(context=observer.node.context, parameter_overrides=[RosParameter("count", value=9)])
    node.autostart()
    assert not node.active and not node.configured and node.level == ERROR
    assert "a defect of the node" in node.inactive() and "configure`, then `activate" in node.inactive()
    assert node.put("count", 4) == ""
    node.autostart()
    assert node.active and node.level == OK
    node.destroy_node()


def test_a_node_waits_for_its_manager_where_it_is_told_to(observer: Observer) -> None:
    node = Example(context=observer.node.context, parameter_overrides=[RosParameter("autostart", value=False)])
    node.autostart()
    assert not node.configured and node.level == WARN
    node.destroy_node()
