"""Clients for worker threads, which may wait (executor callbacks may not): services, actions, hold of the mirror."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from dm_msgs.srv import HoldMirror
from rclpy.action import ActionClient
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from dm_common.errors import Cancelled, ErrorCode, Refusal

#: Interval between renewals of a hold, s: several within the lease of 3 s. Longest wait for its release, s; without an
#: answer the hold ends with its lease.
RENEW_S, RELEASE_S = 0.7, 1.0
#: Longest wait for the end of a cancelled goal, s; time for a cancel request to be sent to a server that is gone, s.
CANCEL_S, SEND_S = 20.0, 0.5


class ServiceCallError(Exception):
    """A service or action did not answer: not there, too slow, or the wait was cancelled.

    Attributes:
        error_code: for callers that pass it on; TIMEOUT unless there is another reason.
    """

    def __init__(self, message: str, error_code: int = ErrorCode.TIMEOUT) -> None:
        super().__init__(message)
        self.error_code = error_code


def call(
    client: Client,
    request: Any,
    timeout_s: float,
    cancelled: Callable[[], object] = lambda: False,
    again_s: float = math.inf,
    send_by: Callable[[Callable[[], Any]], Any] = lambda send: send(),
    ready_s: float = math.inf,
) -> Any:
    """Call a service from a worker thread and wait for the answer.

    Args:
        timeout_s: longest wait for the server, and for its answer.
        again_s: s after which an unanswered request is sent once more; only for requests that may be executed twice.
        send_by: called with a function that sends the request; returns what that function returns.
        ready_s: longest wait for the server, if shorter than `timeout_s`.

    Raises:
        ServiceCallError: no server or no answer in time, `cancelled()` became true, or the process ends.
    """
    began, ready_s = time.monotonic(), min(ready_s, timeout_s)
    deadline = began + timeout_s
    while not client.service_is_ready():
        if cancelled():
            raise ServiceCallError(f"{client.srv_name}: cancelled")
        if time.monotonic() > began + ready_s:
            raise ServiceCallError(f"{client.srv_name}: no such service within {ready_s:g} s; is its node running?")
        time.sleep(0.02)
    done, answers = threading.Event(), list[Any]()

    def answered(future: Any) -> None:
        answers.append(future.result())
        done.set()

    def send() -> Any:
        future = send_by(lambda: client.call_async(request))
        future.add_done_callback(answered)
        return future

    future, again = send(), time.monotonic() + again_s
    while not done.wait(0.02 if deadline - time.monotonic() > 0.02 else 0.001):
        ended = cancelled() or not client.context.ok()  # no answer arrives once the process ends
        if ended or time.monotonic() > deadline:
            client.remove_pending_request(future)
            reason = "cancelled" if ended else f"no answer within {timeout_s:g} s"
            raise ServiceCallError(f"{client.srv_name}: {reason}")
        if time.monotonic() > again:
            client.remove_pending_request(future)
            future, again = send(), math.inf
    return answers[0]


class ThreadedActionClient(ActionClient):
    """`rclpy.action.ActionClient` in which sending a request and taking an answer exclude each other.

    rclpy sends a request first and records its number afterwards. An answer that the executor takes in between is
    discarded ("Ignoring unexpected goal response"), and the caller waits for ever.
    """

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        self._sending = threading.RLock()
        super().__init__(*arguments, **keywords)

    def send_goal_async(self, *arguments: Any, **keywords: Any) -> Any:
        with self._sending:
            return super().send_goal_async(*arguments, **keywords)

    def _get_result_async(self, goal_handle: Any) -> Any:
        with self._sending:
            return super()._get_result_async(goal_handle)

    def _cancel_goal_async(self, goal_handle: Any) -> Any:
        with self._sending:
            return super()._cancel_goal_async(goal_handle)

    async def execute(self, taken_data: Any) -> None:
        with self._sending:
            await super().execute(taken_data)


def run_goal(
    client: ActionClient,
    goal: Any,
    timeout_s: float,
    *,
    answer_s: float | None = None,
    on_feedback: Callable[[Any], None] = lambda feedback: None,
    stop: Callable[[], bool] = lambda: False,
    server_lost: Callable[[], object] = lambda: False,
    identity: Any = None,
    send_by: Callable[[Callable[[], Any]], Any] = lambda send: send(),
) -> Any:
    """Run a goal from a worker thread, return its result. A failed wait, or Ctrl-C (which reports its end), cancels it.

    Args:
        timeout_s: longest wait for the end of the goal, s.
        answer_s: longest wait for the server, and for its answer to the goal, s; None = `timeout_s`.
        on_feedback: called by the executor.
        stop: becomes true to cancel the goal; its result is still awaited and returned.
        server_lost: whether the server is known to be gone; the wait for it then ends.
        identity: of the goal, a unique_identifier_msgs/UUID; None = any.
        send_by: called with a function that sends the goal; returns what that function returns.

    Raises:
        ServiceCallError: no server, no answer or no end in time, or `stop()` before it began.
    """
    name = client._action_name
    answer_s = timeout_s if answer_s is None else answer_s

    def wait(condition: Callable[[], bool], seconds: float, missing: str, hint: str = "") -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            if server_lost() or time.monotonic() > deadline:
                raise ServiceCallError(f"{name}: {missing}{f' within {seconds:g} s' * math.isfinite(seconds)}{hint}")
            time.sleep(0.005)

    wait(lambda: stop() or client.server_is_ready(), answer_s, "no such action", "; is its node running?")
    if stop() or server_lost():
        raise ServiceCallError(f"{name}: cancelled before it began; nothing has changed", ErrorCode.CANCELED)
    accepted = send_by(lambda: client.send_goal_async(goal, lambda message: on_feedback(message.feedback), identity))
    try:
        wait(accepted.done, answer_s, "no answer to the goal")
        finished = accepted.result().get_result_async()
        wait(lambda: finished.done() or stop(), timeout_s, "not finished")
        if not finished.done():
            accepted.result().cancel_goal_async()
            wait(finished.done, timeout_s, "not finished")
        return finished.result().result
    except BaseException as error:
        outcome = "whether it has begun is not known (./dm status)"
        with suppress(ServiceCallError):
            wait(accepted.done, answer_s, "no answer to the goal")
            accepted.result().cancel_goal_async()
            time.sleep(SEND_S if server_lost() else 0.0)
            outcome = "asked to cancel; it ends with what is under way, such as a fit (./dm status)"
            finished = accepted.result().get_result_async()
            wait(finished.done, CANCEL_S, "not finished")
            ended = finished.result().result
            outcome = ended.message if ended.error_code else f"done already: {ended.message}"
        if isinstance(error, KeyboardInterrupt):
            error.args = (f"{name}: {outcome}",)
        raise


class MirrorHolder:
    """Holds the mirror: one hold at a time, taken and released by a worker thread, renewed by the executor.

    A restarted driver receives the renewal too, so that the hold survives the restart.

    Args:
        driver_lost: whether the driver is known to be gone; the wait for the release of a hold then ends.

    Attributes:
        holder: name of the holder, sent with every command as well.
        lost: the refusal, once somebody else has taken the mirror over; None before.
    """

    def __init__(self, node: Node, name: str, driver_lost: Callable[[], bool] = lambda: False) -> None:
        self.holder = self._name = name
        self._driver_lost = driver_lost
        self.lost: Refusal | None = None
        self._client = node.create_client(HoldMirror, "hold_mirror")
        self._request = HoldMirror.Request(holder=name)
        self._renewal: Any = None
        self._one = threading.Lock()  # locked while the mirror is held
        self._sending, self._ended = threading.Lock(), False
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(RENEW_S, self._renew, clock=clock, autostart=False)

    @contextmanager
    def held(
        self,
        request: Any,
        purpose: str,
        duration: float,
        timeout_s: float,
        cancelled: Callable[[], bool] = lambda: False,
    ) -> Iterator[None]:
        """Hold the mirror during the block.

        Args:
            request: a goal or request that needs the mirror. If its `holder` has the mirror already, that hold is used,
                and neither renewed nor released here. Its `take_over` ends the hold of anybody else.
            purpose: of the hold, and how to end it, for clients that are refused meanwhile.
            duration: expected duration, s; 0 = not known.
            timeout_s: longest wait for the driver.
            cancelled: ends that wait.

        Raises:
            Refusal: BUSY, somebody else holds it.
            ServiceCallError: there is no driver.
        """
        busy = f"{self._name} holds the mirror already: {self._request.purpose}"
        self.wait_for(lambda: self._one.acquire(blocking=False), request, busy, timeout_s)
        try:
            self.lost, self.holder = None, self._name
            self._request.purpose, self._request.duration = purpose, duration
            answer = self._ask(HoldMirror.Request.HOLD, timeout_s, cancelled)
            if answer.error_code == ErrorCode.BUSY and answer.holder == request.holder:
                self.holder = request.holder
                yield
                return
            if answer.error_code == ErrorCode.BUSY and request.take_over:
                answer = self._ask(HoldMirror.Request.TAKE_OVER, timeout_s, cancelled)
            if answer.error_code != ErrorCode.OK:
                raise Refusal(answer.error_code, answer.message)
            self._request.operation = HoldMirror.Request.RENEW
            self._timer.reset()
            try:
                yield
            finally:
                self._timer.cancel()
                if self.lost is None:
                    with suppress(ServiceCallError):  # the driver is gone
                        self._ask(HoldMirror.Request.RELEASE, RELEASE_S, self._driver_lost)
        finally:
            self._one.release()

    def wait_for(self, free: Callable[[], bool], request: Any, busy: str, timeout_s: float) -> None:
        """Wait until `free()` if the `request` takes the mirror over from another run of this node, ending that.

        Raises:
            Refusal: BUSY with the sentence `busy`, if `request` does not take over, or the run does not end in time.
        """
        deadline = time.monotonic() + timeout_s
        while not free():
            if not request.take_over or time.monotonic() > deadline:
                raise Refusal(ErrorCode.BUSY, busy)
            self.lost = Refusal(ErrorCode.PREEMPTED, "a newer run of the same node has taken the mirror over")
            time.sleep(0.02)

    def command(self, send: Callable[[], Any]) -> Any:
        """Call `send`, which sends a command, and return its result. Raises Cancelled after `end`."""
        with self._sending:
            if self._ended:
                raise Cancelled("cancelled: the process ends")
            return send()

    def end(self) -> bool:
        """Note that the process ends: no run sends a command from now on. Returns whether a run holds the mirror."""
        with self._sending:
            self._ended = True
            return self._one.locked()

    def _ask(self, operation: int, timeout_s: float, cancelled: Callable[[], bool]) -> Any:
        self._request.operation = operation
        return call(self._client, self._request, timeout_s, cancelled)

    def _renew(self) -> None:
        if self._renewal is not None:
            self._client.remove_pending_request(self._renewal)
        self._renewal = self._client.call_async(self._request)
        self._renewal.add_done_callback(self._renewed)

    def _renewed(self, done: Any) -> None:
        answer = done.result()
        if answer.error_code != ErrorCode.OK and not self._timer.is_canceled():
            self._timer.cancel()
            self.lost = Refusal(ErrorCode.PREEMPTED, answer.message)
