"""Worker threads for callbacks that have to wait, beside an executor that never waits.

A service or action callback that would block (settling, files, fits, other services) runs as ordinary code in a worker
thread; the executor gets its outcome and sends the response. Meanwhile topics are served undisturbed, without polling.
"""

import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal

from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.service import Service

from dm_common.errors import EXPECTED, ClockError, ErrorCode, Refusal, error_code
from dm_common.messages import answer_with
from dm_common.ros import qos
from dm_common.ros.executor import ResendingActionServer, until_discovered
from dm_common.values import Fields, fill_with_nan

#: Every known client fetches its result at once; rclpy's default of 900 s makes servers slower with every goal.
RESULT_TIMEOUT_S = 10
#: Longest wait for a simulator's first message on /clock, s.
CLOCK_S = 10.0
#: For requests that need no check, or that their callback checks.
NO_FIELDS = Fields({})


def _check_active(node: Node) -> None:
    """Raise Refusal when a lifecycle node rests, see `dm_common.ros.lifecycle.ManagedNode`."""
    getattr(node, "check_active", lambda: None)()


def _answer_error(node: Node, what: str, error: Exception, answer: Any) -> None:
    """Log an exception of the body of `what`; answer it as ErrorCode.INTERNAL."""
    if node.context.ok():  # while the process ends, errors are expected: everything the worker used is gone
        node.get_logger().error(f"{what}:\n{traceback.format_exc()}")
    answer_with(answer, ErrorCode.INTERNAL, f"{type(error).__name__}: {error}")


def never_silent(
    node: Node, name: str, callback: Callable[[Any, Any], Any], fields: Fields = NO_FIELDS
) -> Callable[[Any, Any], Any]:
    """`callback(request, response) -> response` of service `name` that answers with an error code instead of raising.

    A service whose callback raises sends no answer, and its caller waits until it gives up. An EXPECTED error is
    answered with its own code and logged as a warning, once even if it repeats. Requests with `fields` that are not
    allowed never reach `callback`.
    """
    refused = ""

    def answer(request: Any, response: Any) -> Any:
        nonlocal refused
        before, refused = refused, ""
        try:
            _check_active(node)
            fields.check(request)
            return callback(request, response)
        except EXPECTED as error:
            if response == type(response)():  # otherwise the callback has filled it in already
                fill_with_nan(response)
            refused = str(error)
            answer_with(response, error_code(error), refused)
            if refused != before:
                node.get_logger().warning(f"{name}: {refused}")
        except Exception as error:
            _answer_error(node, f"service {name}", error, response)
        return response

    return answer


class WorkerService:
    """A service whose callback runs in a worker thread.

    `callback(request, response) -> response` may block. Requests of one service are served one after another, in order;
    `fields` are checked first. The callback may instead return a function that waits for the end of the work begun and
    returns the response. Meanwhile the next request is served; if that begins work too, the wait must end.
    """

    def __init__(
        self, node: Node, srv_type: Any, name: str, callback: Callable[[Any, Any], Any], fields: Fields = NO_FIELDS
    ) -> None:
        self._node = node
        self._callback = never_silent(node, name, callback, fields)
        self._pool, self._ends = (ThreadPoolExecutor(1, name.replace("/", "_") + end) for end in ("", "_end"))
        self._service: Service = node.create_service(srv_type, name, lambda *both: both, qos_profile=qos.SERVICE)
        # The executor calls `callback` and passes its result to `send_response(response, header)`: the only access to
        # the header, which a later answer needs.
        self._send = until_discovered(self._service.send_response)
        self._service.send_response = self._start

    def _start(self, request_and_response: tuple[Any, Any], header: Any) -> None:
        self._pool.submit(self._work, self._callback, *request_and_response, header)

    def _work(self, callback: Callable[[Any, Any], Any], request: Any, response: Any, header: Any) -> None:
        answer = callback(request, response)
        if callable(answer):
            end = never_silent(self._node, self._service.srv_name, lambda *_: answer())
            self._ends.submit(self._work, end, request, response, header)
        elif self._node.executor is not None:
            self._node.executor.create_task(self._send, answer, header)


class WorkerGoal:
    """A goal for its body: also cancelled by the deactivation of its node, or by a goal that takes over.

    Attributes:
        handle: of rclpy.
        request, publish_feedback: of the handle.
        since: steady time of its arrival, s.
    """

    def __init__(self, handle: ServerGoalHandle, node: Node) -> None:
        self.handle, self._node = handle, node
        self.request, self.publish_feedback = handle.request, handle.publish_feedback
        self.taken_over, self._session_at_start, self.since = False, self._session, time.monotonic()

    @property
    def _session(self) -> int:
        return getattr(self._node, "session", 0)

    @property
    def is_cancel_requested(self) -> bool:
        """Whether the goal is to end."""
        return bool(self.handle.is_cancel_requested or self.ended_by)

    @property
    def ended_by(self) -> str:
        """What ends the goal other than its client, as a sentence; "" = nothing."""
        if self._session != self._session_at_start:
            return f"{self._node.get_name()} was deactivated"
        return "a newer goal has taken over" if self.taken_over else ""


class WorkerActionServer(ResendingActionServer):
    """An action server whose body runs in a worker thread.

    `body(goal) -> (outcome, result)` may block; `outcome` is "succeed", "abort" or "canceled". It should return soon
    after `goal.is_cancel_requested` or after `preempted(goal)` becomes true.

    Args:
        exclusive: "refuse" refuses a goal while another runs, unless it sets `take_over`: then the running goal is
            cancelled; "preempt" asks the running goal to stop and starts the newest one after it.
        fields, admit: checks of the goal's fields, and a function that raises, and logs, the Refusal of a goal.

    Every goal is accepted; a refused one is then aborted, since only a result can carry the reason. A refused goal does
    not affect others.
    """

    def __init__(
        self,
        node: Node,
        action_type: Any,
        name: str,
        body: Callable[[WorkerGoal], tuple[str, Any]],
        *,
        exclusive: Literal["refuse", "preempt"] = "refuse",
        fields: Fields = NO_FIELDS,
        admit: Callable[[Any], object] = lambda _request: None,
    ) -> None:
        self._worker_node, self._worker_name = node, name
        self._body = body
        self._exclusive, self._fields, self._admit = exclusive, fields, admit
        self._turn = threading.Lock()  # held by the goal that runs
        self._bookkeeping = threading.Lock()
        self._newest: WorkerGoal | None = None
        self._running = 0
        super().__init__(
            node,
            action_type,
            name,
            execute_callback=lambda goal_handle: action_type.Result(),  # replaced in notify_execute
            cancel_callback=lambda goal_handle: CancelResponse.ACCEPT,
            result_timeout=RESULT_TIMEOUT_S,
            goal_service_qos_profile=qos.SERVICE,
            result_service_qos_profile=qos.SERVICE,
            cancel_service_qos_profile=qos.SERVICE,
        )

    @property
    def busy(self) -> bool:
        """Whether a goal is running or waiting."""
        with self._bookkeeping:
            return self._running > 0

    def preempted(self, goal: WorkerGoal) -> bool:
        """Whether a newer goal waits for this one to stop."""
        with self._bookkeeping:
            return self._newest is not goal

    def _check_free(self, goal: Any) -> None:
        """Raise Refusal while another goal runs that this one does not take over."""
        request = getattr(goal, "request", goal)  # `take_over` may be in a FocusRequest inside the goal
        if self._exclusive == "refuse" and self.busy and not request.take_over:
            assert self._newest is not None
            lasts = time.monotonic() - self._newest.since
            text = f"action {self._worker_name} has been running for {lasts:.0f} s: cancel it first, or set take_over"
            raise Refusal(ErrorCode.BUSY, text)

    def notify_execute(self, goal_handle: ServerGoalHandle, execute_callback: Any) -> None:
        """Run the body in a thread; rclpy's own execution only publishes the outcome once it is known."""
        try:
            try:
                _check_active(self._worker_node)
                self._fields.check(goal_handle.request)
                self._check_free(goal_handle.request)
            except Refusal as refusal:
                self._worker_node.get_logger().warning(f"goal refused: {refusal}")
                raise
            self._admit(goal_handle.request)
        except Refusal as refusal:
            result = fill_with_nan(self._action_type.Result())
            answer_with(result, refusal.error_code, str(refusal))
            self._finish(goal_handle, "abort", result)
            return
        goal = WorkerGoal(goal_handle, self._worker_node)
        with self._bookkeeping:
            if self._newest is not None and self._exclusive == "refuse":
                self._newest.taken_over = True
            self._newest = goal
            self._running += 1
        threading.Thread(target=self._work, args=(goal,), daemon=True).start()

    def _work(self, goal: WorkerGoal) -> None:
        try:
            with self._turn:
                outcome, result = self._body(goal)
        except Exception as error:
            outcome, result = "abort", fill_with_nan(self._action_type.Result())
            _answer_error(self._worker_node, "action", error, result)
        finally:
            with self._bookkeeping:
                self._running -= 1
        if goal.ended_by and outcome == "canceled":
            result.message = f"{goal.ended_by}: {result.message}"
            result.error_code = ErrorCode.PREEMPTED if goal.taken_over else result.error_code
        self._finish(goal.handle, outcome, result)

    def _finish(self, goal_handle: ServerGoalHandle, outcome: str, result: Any) -> None:
        """Make the executor publish the outcome."""

        def finish(_goal_handle: ServerGoalHandle) -> Any:
            # Only a goal whose client requested its cancellation may end as cancelled.
            if outcome == "canceled" and not goal_handle.is_cancel_requested:
                goal_handle.abort()
            else:
                getattr(goal_handle, outcome)()
            return result

        if self._worker_node.executor is not None:
            self._worker_node.executor.create_task(ActionServer.notify_execute, self, goal_handle, finish)


def wait_for_clock(clock: Clock) -> None:
    """Wait in a worker thread until ROS time runs: simulated time is 0 until the first message on /clock.

    Raises:
        ClockError: no time within CLOCK_S.
    """
    deadline = time.monotonic() + CLOCK_S
    while clock.now().nanoseconds == 0:
        if time.monotonic() > deadline:
            raise ClockError(f"use_sim_time is set, but nothing came on /clock within {CLOCK_S:g} s")
        time.sleep(0.01)


def duration_clock(clock: Clock) -> Clock:
    """The clock that durations are taken by: `clock` if it is simulated, else a steady one: system time may be set."""
    return clock if clock.ros_time_is_active else Clock(clock_type=ClockType.STEADY_TIME)


def sleep(clock: Clock, seconds: float, cancelled: Callable[[], bool] = lambda: False) -> bool:
    """Sleep in a worker thread; in ROS time if that is simulated: it may then run fast, or restart.

    Returns True, or False as soon as `cancelled()` is true. Raises ClockError when ROS time stands still (the simulator
    has ended) for 10 s plus ten times `seconds` of wall time.
    """
    wait_for_clock(clock)
    ticking = duration_clock(clock)
    end = ticking.now() + (whole := Duration(nanoseconds=round(seconds * 1e9)))
    give_up = time.monotonic() + 10.0 + 10.0 * seconds
    while (remaining := (end - ticking.now()).nanoseconds * 1e-9) > 0:
        if cancelled():
            return False
        if time.monotonic() > give_up:
            raise ClockError(f"ROS time did not advance by {seconds:g} s; is the publisher of /clock alive?")
        time.sleep(min(remaining, 0.002 if remaining < 0.02 or ticking is clock else 0.02))
        end = min(end, ticking.now() + whole)
    return not cancelled()
