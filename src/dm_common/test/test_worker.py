"""Worker services and actions, and calls from threads, beside an executor that goes on."""

from __future__ import annotations

import math
import threading
import time
from functools import partial
from types import SimpleNamespace
from typing import Any, Literal, cast

import pytest
import rclpy
from action_msgs.msg import GoalStatus
from dm_msgs.action import Converge, Degauss, MoveFocus
from dm_msgs.msg import ErrorCode, FocusRequest
from dm_msgs.srv import Flatten, HoldMirror, PredictError, SetSignals
from rclpy.node import Node
from rclpy.time import Time
from std_msgs.msg import Int32

from dm_common.errors import Refusal
from dm_common.ros.clients import MirrorHolder, ServiceCallError, ThreadedActionClient, call, run_goal
from dm_common.ros.worker import WorkerActionServer, WorkerGoal, WorkerService, never_silent, sleep
from dm_common.values import Fields, real
from ros_fixtures import Observer
from waiting import wait_until


def _longer(received: list[Any], count: int) -> bool:
    return len(received) > count


def test_stream_is_served_while_a_service_blocks(observer: Observer) -> None:
    release = threading.Event()

    def blocking(_request: Any, response: Any) -> Any:
        assert release.wait(20)
        response.message = "done"
        return response

    WorkerService(observer.node, Flatten, "slow", blocking)
    received = observer.record(Int32, "stream")
    publisher = observer.node.create_publisher(Int32, "stream", 10)
    client = observer.node.create_client(Flatten, "slow")
    wait_until(client.service_is_ready)
    future = client.call_async(Flatten.Request())
    for value in range(20):
        publisher.publish(Int32(data=value))
        wait_until(partial(_longer, received, value), what="the stream stalled behind the service")
    assert not future.done()
    release.set()
    wait_until(future.done)
    assert future.result().message == "done"


def test_waiting_for_a_worker_does_not_poll(observer: Observer) -> None:
    release = threading.Event()
    WorkerService(observer.node, Flatten, "slow", lambda _request, response: (release.wait(20), response)[1])
    client = observer.node.create_client(Flatten, "slow")
    wait_until(client.service_is_ready)
    future = client.call_async(Flatten.Request())
    time.sleep(0.3)
    before = time.process_time()
    time.sleep(1.0)
    used = time.process_time() - before
    release.set()
    wait_until(future.done)
    assert used < 0.5, f"{used:.2f} s of CPU in 1 s of waiting: something polls"


def test_what_has_begun_is_awaited_beside_the_requests_after_it(observer: Observer) -> None:
    begun: list[threading.Event] = []

    def begin(_request: Any, response: Any) -> Any:
        ends = threading.Event()
        response.message = str(len(begun))
        for earlier in begun:
            earlier.set()
        begun.append(ends)
        if len(begun) == 3:
            return response

        def end() -> Any:
            assert ends.wait(20), "no later request began"
            return response

        return end

    WorkerService(observer.node, Flatten, "begin", begin)
    client = observer.node.create_client(Flatten, "begin")
    wait_until(client.service_is_ready)
    futures = [client.call_async(Flatten.Request()) for _ in range(3)]
    wait_until(lambda: all(future.done() for future in futures))
    assert [future.result().message for future in futures] == ["0", "1", "2"]


def test_a_failing_service_callback_answers_with_the_reason(observer: Observer) -> None:
    def failing(_request: Any, _response: Any) -> Any:
        raise RuntimeError("the plate is bent")

    WorkerService(observer.node, SetSignals, "failing", failing)
    observer.node.create_service(SetSignals, "failing_at_once", never_silent(observer.node, "failing_at_once", failing))
    WorkerService(observer.node, SetSignals, "failing_later", lambda *request: lambda: failing(*request))
    for name in ("failing", "failing_at_once", "failing_later"):
        response = observer.call(SetSignals, name)
        assert response.error_code == ErrorCode.INTERNAL
        assert "the plate is bent" in response.message


def test_figures_that_a_callback_refuses_to_give_are_nan(observer: Observer) -> None:
    def refusing(request: Any, response: Any) -> Any:
        response.upper = float(len(request.signals))
        raise Refusal(ErrorCode.BUSY, "held")

    answer = never_silent(observer.node, "refusing", refusing)
    assert math.isnan(answer(PredictError.Request(), PredictError.Response()).lower)
    assert answer(PredictError.Request(signals=[0.0]), PredictError.Response()).lower == 0.0, "what it filled in stays"


def test_the_loop_survives_a_callback_that_raises(observer: Observer) -> None:
    received = []

    def callback(message: Int32) -> None:
        if message.data == 0:
            raise ValueError("first message")
        received.append(message.data)

    observer.node.create_subscription(Int32, "numbers", callback, 10)
    publisher = observer.node.create_publisher(Int32, "numbers", 10)
    wait_until(lambda: publisher.get_subscription_count() == 1)
    for value in (0, 1, 0, 2):
        publisher.publish(Int32(data=value))
    wait_until(lambda: received == [1, 2])
    publisher.publish(Int32(data=3))
    wait_until(lambda: received == [1, 2, 3])


class Mover:
    """An action body that runs until it is told to stop or allowed to finish."""

    def __init__(self, observer: Observer, exclusive: Literal["refuse", "preempt"]) -> None:
        self.release = threading.Event()
        self.started: list[float] = []
        fields = Fields({"settle_time": real(0.0, 0.0, 60.0, "s")})
        self.server = WorkerActionServer(
            observer.node, MoveFocus, "move", self.body, exclusive=exclusive, fields=fields
        )

    def body(self, goal_handle: Any) -> tuple[str, Any]:
        self.started.append(goal_handle.request.tolerance)
        result = MoveFocus.Result()
        while not self.release.is_set():
            goal_handle.publish_feedback(MoveFocus.Feedback(progress=0.5))
            if goal_handle.is_cancel_requested:
                result.error_code = ErrorCode.CANCELED
                return "canceled", result
            if self.server.preempted(goal_handle):
                result.error_code = ErrorCode.PREEMPTED
                return "abort", result
            time.sleep(0.01)
        result.duration = goal_handle.request.tolerance
        return "succeed", result


def test_action_succeeds_with_its_result_and_feedback(observer: Observer) -> None:
    mover = Mover(observer, "refuse")
    feedback: list[Any] = []
    _, result = observer.send_goal(MoveFocus, "move", MoveFocus.Goal(tolerance=2.5), feedback.append)
    wait_until(lambda: feedback)
    mover.release.set()
    wait_until(result.done)
    assert result.result().status == GoalStatus.STATUS_SUCCEEDED
    assert result.result().result.duration == 2.5


def test_an_answer_quicker_than_the_sender_is_not_lost(observer: Observer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The executor may take the answer before the sending thread has noted the request's number."""
    mover = Mover(observer, "refuse")
    mover.release.set()
    client = ThreadedActionClient(observer.node, MoveFocus, "move")
    wait_until(client.server_is_ready)

    class Dawdling:
        """The handle of the client, which is slow to return once a goal is sent."""

        def __init__(self, handle: Any) -> None:
            self.handle = handle

        def __getattr__(self, name: str) -> Any:
            return getattr(self.handle, name)

        def send_goal_request(self, request: Any) -> int:
            number = self.handle.send_goal_request(request)
            time.sleep(0.3)
            return number

    monkeypatch.setattr(client, "_client_handle", Dawdling(client._client_handle))
    accepted = client.send_goal_async(MoveFocus.Goal(tolerance=1.0))
    wait_until(accepted.done)
    assert accepted.result().accepted


def test_action_cancel_is_honoured(observer: Observer) -> None:
    Mover(observer, "refuse")
    handle, result = observer.send_goal(MoveFocus, "move", MoveFocus.Goal())
    handle.cancel_goal_async()
    wait_until(result.done)
    assert result.result().status == GoalStatus.STATUS_CANCELED
    assert result.result().result.error_code == ErrorCode.CANCELED


def test_a_second_goal_is_refused_while_one_runs(observer: Observer) -> None:
    mover = Mover(observer, "refuse")
    _, first = observer.send_goal(MoveFocus, "move", MoveFocus.Goal())
    wait_until(lambda: mover.started)
    second = observer.run_goal(MoveFocus, "move", MoveFocus.Goal())
    assert second.status == GoalStatus.STATUS_ABORTED and second.result.error_code == ErrorCode.BUSY
    assert "action move has been running for 0 s: cancel it first, or set take_over" in second.result.message
    mover.release.set()
    wait_until(first.done)
    assert observer.run_goal(MoveFocus, "move", MoveFocus.Goal()).status == GoalStatus.STATUS_SUCCEEDED


@pytest.mark.parametrize(
    ("kind", "taking_over"),
    [
        (Degauss, Degauss.Goal(take_over=True)),
        (Converge, Converge.Goal(request=FocusRequest(take_over=True))),
    ],
)
def test_a_goal_that_takes_over_ends_the_one_that_runs(observer: Observer, kind: Any, taking_over: Any) -> None:
    def run(goal: WorkerGoal) -> tuple[str, Any]:
        if goal.request == taking_over:
            return "succeed", kind.Result()
        wait_until(lambda: goal.is_cancel_requested)
        return "canceled", kind.Result(error_code=ErrorCode.CANCELED, message="at mid range")

    WorkerActionServer(observer.node, kind, "run", run)
    _, first = observer.send_goal(kind, "run", kind.Goal())
    assert observer.run_goal(kind, "run", taking_over).status == GoalStatus.STATUS_SUCCEEDED
    wait_until(first.done)
    result = first.result().result
    assert (result.error_code, result.message) == (ErrorCode.PREEMPTED, "a newer goal has taken over: at mid range")


def test_a_run_loses_the_mirror_to_another_of_its_node_that_takes_it_over(observer: Observer) -> None:
    observer.node.create_service(HoldMirror, "hold_mirror", lambda _request, response: response)
    holder, holding = MirrorHolder(observer.node, "node"), threading.Event()
    lost: list[Any] = []

    def run() -> None:
        with holder.held(Degauss.Goal(), "the first", 0.0, 30.0):
            holding.set()
            wait_until(lambda: holder.lost is not None)
            lost.append(holder.lost)

    threading.Thread(target=run).start()
    assert holding.wait(30.0)
    with pytest.raises(Refusal, match="the first"), holder.held(Degauss.Goal(), "the second", 0.0, 30.0):
        pass
    assert not lost
    with holder.held(Degauss.Goal(take_over=True), "the third", 0.0, 30.0):
        assert holder.lost is None and lost[0].error_code == ErrorCode.PREEMPTED


def test_the_newest_goal_preempts(observer: Observer) -> None:
    mover = Mover(observer, "preempt")
    _, first = observer.send_goal(MoveFocus, "move", MoveFocus.Goal(tolerance=1.0))
    wait_until(lambda: mover.started == [1.0])
    _, second = observer.send_goal(MoveFocus, "move", MoveFocus.Goal(tolerance=2.0))
    wait_until(first.done)
    assert first.result().result.error_code == ErrorCode.PREEMPTED
    mover.release.set()
    wait_until(second.done)
    assert second.result().status == GoalStatus.STATUS_SUCCEEDED
    assert mover.started == [1.0, 2.0]


def test_a_goal_that_makes_no_sense_is_refused_and_leaves_the_one_that_runs(observer: Observer) -> None:
    mover = Mover(observer, "preempt")
    _, first = observer.send_goal(MoveFocus, "move", MoveFocus.Goal(tolerance=1.0))
    wait_until(lambda: mover.started == [1.0])
    refused = observer.run_goal(MoveFocus, "move", MoveFocus.Goal(tolerance=1.0, settle_time=math.nan)).result
    assert refused.error_code == ErrorCode.NOT_FINITE and "settle_time = nan" in refused.message
    assert math.isnan(refused.duration) and math.isnan(refused.state.predicted_rms)
    mover.release.set()
    wait_until(first.done)
    assert first.result().status == GoalStatus.STATUS_SUCCEEDED
    assert mover.started == [1.0]


def test_call_names_the_service_that_is_missing(observer: Observer) -> None:
    client = observer.node.create_client(Flatten, "nowhere")
    with pytest.raises(ServiceCallError, match="nowhere: no such service"):
        call(client, Flatten.Request(), timeout_s=0.1)


def test_call_gives_up_on_a_silent_server_and_on_cancel(observer: Observer) -> None:
    release = threading.Event()
    WorkerService(observer.node, Flatten, "silent", lambda _request, response: (release.wait(20), response)[1])
    client = observer.node.create_client(Flatten, "silent")
    wait_until(client.service_is_ready)
    with pytest.raises(ServiceCallError, match="no answer within"):
        call(client, Flatten.Request(), timeout_s=2.0)
    with pytest.raises(ServiceCallError, match="cancelled"):
        call(client, Flatten.Request(), timeout_s=20, cancelled=lambda: True)
    context = rclpy.Context()  # of a process that ends: its worker threads must not keep it alive
    rclpy.init(context=context, domain_id=observer.node.context.get_domain_id())
    client = Node("ending", context=context).create_client(Flatten, "silent")
    wait_until(client.service_is_ready)
    threading.Timer(0.2, context.try_shutdown).start()
    with pytest.raises(ServiceCallError, match="cancelled"):
        call(client, Flatten.Request(), timeout_s=10.0)
    release.set()


def test_sleep_ends_early_when_cancelled(observer: Observer) -> None:
    assert sleep(observer.node.get_clock(), 0.05)
    assert not sleep(observer.node.get_clock(), 60.0, cancelled=lambda: True)


@pytest.mark.parametrize(("simulated", "step_s"), [(False, 3600.0), (False, -3600.0), (True, -3600.0)])
def test_sleep_lasts_as_long_when_the_clock_is_set_meanwhile(simulated: bool, step_s: float) -> None:
    began = time.monotonic()

    def now() -> Time:
        passed = time.monotonic() - began
        return Time(seconds=1e9 + passed + (step_s if passed > 0.1 else 0.0))

    assert sleep(cast(Any, SimpleNamespace(now=now, ros_time_is_active=simulated)), 0.3)
    assert 0.3 <= time.monotonic() - began < 3.0


@pytest.mark.parametrize(
    ("code", "said"), [(ErrorCode.CANCELED, "run: 7 maps"), (ErrorCode.OK, "run: done already: 7 maps")]
)
def test_who_interrupts_a_goal_is_told_what_became_of_it(code: int, said: str) -> None:
    result = Degauss.Result(error_code=code, message="7 maps")
    ended = SimpleNamespace(done=lambda: True, result=lambda: SimpleNamespace(result=result))
    runs = SimpleNamespace(done=lambda: False)
    futures, cancelled = [ended, runs], list[bool]()  # the last is asked first
    goal = SimpleNamespace(get_result_async=lambda: futures.pop(), cancel_goal_async=lambda: cancelled.append(True))
    accepted = SimpleNamespace(done=lambda: True, result=lambda: goal)
    client = SimpleNamespace(
        _action_name="run", server_is_ready=lambda: True, send_goal_async=lambda *_arguments: accepted
    )
    asked = iter((False, False))

    def stop() -> bool:
        if (answer := next(asked, None)) is None:
            raise KeyboardInterrupt
        return answer

    with pytest.raises(KeyboardInterrupt) as interrupted:
        run_goal(cast(Any, client), None, 5.0, stop=stop)
    assert (str(interrupted.value), cancelled) == (said, [True])
