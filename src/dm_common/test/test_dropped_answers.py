"""Answers that the middleware drops, since it has not discovered the client yet, reach it all the same."""

from __future__ import annotations

import time
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from dm_msgs.action import Degauss
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.service import Service
from std_srvs.srv import Trigger

from dm_common.ros import executor
from dm_common.ros.clients import ServiceCallError, call
from dm_common.ros.executor import BackgroundExecutor
from dm_common.ros.worker import WorkerActionServer, WorkerService
from ros_fixtures import Observer, wait_until


def test_the_middleware_takes_a_tenth_of_a_second_to_drop_an_answer_which_is_not_printed(
    recwarn: pytest.WarningsRecorder, observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client that wants the answers of before its time never matches a server that keeps none."""
    dropped: list[bool] = []
    judge = executor._dropped

    def spy(*arguments: Any) -> bool:
        dropped.append(judge(*arguments))
        return dropped[-1]

    monkeypatch.setattr(executor, "_dropped", spy)
    monkeypatch.setattr(executor, "PAUSES_S", (0.05, 0.05))
    WorkerService(observer.node, Trigger, "ask", lambda request, response: response)
    assert observer.call(Trigger, "ask", Trigger.Request()) == Trigger.Response()
    assert dropped == [False]
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    client = observer.node.create_client(Trigger, "ask", qos_profile=latched)
    wait_until(lambda: client.call_async(Trigger.Request()) and len(dropped) > 5)
    assert all(dropped[1:])
    assert not [warning for warning in recwarn if "send response" in str(warning.message)]


class Dropping:
    """Sends as the middleware does that drops the first answers of each kind."""

    def __init__(self, handle: Any = None, drops: int = 2) -> None:
        self._handle, self._drops = handle, drops
        self.sent: list[str] = []

    def send(self, kind: str, send: Any, *answer: Any) -> None:
        self.sent.append(kind)
        if self.sent.count(kind) <= self._drops:
            time.sleep(0.1)
        else:
            send(*answer)

    def __getattr__(self, name: str) -> Any:
        there = getattr(self._handle, name)
        if name in ("send_goal_response", "send_result_response"):
            return lambda *answer: self.send(name, there, *answer)
        return there


@pytest.mark.parametrize("worker", [True, False])
def test_the_answer_of_a_service_is_sent_again(
    observer: Observer, monkeypatch: pytest.MonkeyPatch, worker: bool
) -> None:
    dropping, send = Dropping(), Service.send_response
    monkeypatch.setattr(Service, "send_response", lambda *answer: dropping.send("answer", send, *answer))
    node = Node("server", context=observer.node.context)
    if worker:
        WorkerService(node, Trigger, "ask", lambda request, response: Trigger.Response(message="here"))
    else:
        node.create_service(Trigger, "ask", lambda request, response: Trigger.Response(message="here"))
    served = BackgroundExecutor(node)
    client = observer.node.create_client(Trigger, "ask")
    wait_until(client.service_is_ready)
    answered = client.call_async(Trigger.Request())
    wait_until(answered.done)
    assert answered.result().message == "here"
    assert len(dropping.sent) == 3
    served.destroy_node()


def test_a_request_that_is_slowly_handed_to_its_worker_is_carried_out_once(
    observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine that stalls takes as long for that as the middleware to drop an answer."""
    start, carried_out = WorkerService._start, []

    def slowly(self: WorkerService, *arguments: Any) -> None:
        time.sleep(0.1)
        start(self, *arguments)

    def answer(_request: Any, response: Any) -> Any:
        carried_out.append(response)
        return response

    monkeypatch.setattr(WorkerService, "_start", slowly)
    node = Node("server", context=observer.node.context)
    WorkerService(node, Trigger, "ask", answer)
    served = BackgroundExecutor(node)
    observer.call(Trigger, "ask", Trigger.Request())
    time.sleep(2 * executor.PAUSES_S[0])
    assert len(carried_out) == 1
    served.destroy_node()


def test_a_request_that_was_lost_is_sent_once_more_where_it_may_be_carried_out_twice(observer: Observer) -> None:
    """What a server that has not discovered the client yet never hears; here it hears and says nothing."""
    server = Node("server", context=observer.node.context)
    service = server.create_service(Trigger, "ask", lambda request, response: Trigger.Response(message="here"))
    answer = service.send_response
    lost: list[Any] = []

    def forgetful(*arguments: Any) -> None:
        if len(lost) < losses:
            lost.append(arguments)
        else:
            answer(*arguments)

    service.send_response = forgetful
    served = BackgroundExecutor(server)
    client = observer.node.create_client(Trigger, "ask")
    losses = 1
    assert call(client, Trigger.Request(), timeout_s=20.0, again_s=0.1).message == "here"
    losses = 2
    with pytest.raises(ServiceCallError, match=r"no answer within 0\.5 s"):
        call(client, Trigger.Request(), timeout_s=0.5)
    losses = 10
    with pytest.raises(ServiceCallError, match=r"no answer within 0\.5 s"):
        call(client, Trigger.Request(), timeout_s=0.5, again_s=0.1)
    wait_until(lambda: len(lost) >= 4)
    time.sleep(0.3)
    assert len(lost) == 4  # once more, not for ever
    served.destroy_node()


def test_acceptance_and_result_of_a_goal_are_sent_again(observer: Observer, monkeypatch: pytest.MonkeyPatch) -> None:
    server = WorkerActionServer(observer.node, Degauss, "run", lambda goal: ("succeed", Degauss.Result(message="done")))
    dropping = Dropping(server._handle)
    monkeypatch.setattr(server, "_handle", dropping)
    _, result = observer.send_goal(Degauss, "run", Degauss.Goal())
    wait_until(result.done)
    assert (result.result().status, result.result().result.message) == (GoalStatus.STATUS_SUCCEEDED, "done")
    sent = {kind: dropping.sent.count(kind) for kind in dropping.sent}
    assert sent == {"send_goal_response": 3, "send_result_response": 3}
