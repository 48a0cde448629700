"""The one executor of the suite, and the life of a node process.

`rclpy.experimental.EventsExecutor` has half the latency and a quarter of the CPU use of the others, but must be driven
with care (measured with rclpy 7.1.6):

* `spin()` without a time limit never dispatches in the PyPI wheels; `spin_once(timeout_sec=...)` in a loop does.
* An exception in a callback leaves `spin_once` and with it the rest of the batch: messages that arrived together with
  the one that raised would wait for the next event, and all later ones would be delivered one event late.
* `async def` service callbacks are not run, and a pending `await` in an action callback is polled at 100 % CPU. Work
  that waits therefore runs in worker threads (see :mod:`dm_common.ros.worker`), and callbacks stay short.
* It keeps a reference to every entity it serves: a node destroyed before its executor is shut down stays in the
  ROS graph, latched messages and all. (So does one with action clients or servers: `Node.destroy_node` skips these, and
  each refers to its node, see `destroy`.)
* On a busy machine a client may have discovered a server before the server has discovered the client. rmw_fastrtps then
  waits 0.1 s and drops the answer, and rclpy only warns ("client will not receive response"): the client waits for ever
  (ros2/rmw_fastrtps#706, ros2/rclcpp#2760). `until_discovered` sends the answer again, and reports when it is lost for
  good; the warning is not printed.
* A signal may raise KeyboardInterrupt inside any callback, and is not noticed while the loop sleeps. `StopOnSignals`
  turns SIGINT and SIGTERM into an orderly end instead.
"""

import gc
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import rclpy
from rclpy.action import ActionClient, ActionServer, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.exceptions import InvalidHandle, ParameterException
from rclpy.executors import Executor
from rclpy.experimental import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dm_common.ros import SUPERVISOR

#: Signals that end a node in an orderly way.
STOPPING = (signal.SIGINT, signal.SIGTERM)
#: Longest time the loop sleeps without an event; only bounds the reaction to a shutdown from another thread.
WAKE_PERIOD_S = 1.0
#: An answer that took this long to send was dropped, s; others take less than a millisecond.
DROPPED_S = 0.09
#: Pauses before each further try to send a dropped answer, s. Each try blocks the process for a tenth of a second, and
#: the client may never be discovered.
PAUSES_S = (0.3, 1.0, 3.0)


def make_executor(node: Node) -> Executor:
    """Return the suite's executor with `node` added."""
    warnings.filterwarnings("ignore", "failed to send response", RuntimeWarning)  # see `until_discovered`
    executor = EventsExecutor(context=node.context)
    executor.add_node(node)
    return executor


def spin(executor: Executor, until: Callable[[], bool] = lambda: False) -> None:
    """Dispatch events until the ROS context is shut down or `until()` is true; lifecycle nodes start themselves."""
    context = executor.context
    for node in executor.get_nodes():
        getattr(node, "autostart", lambda: None)()
        for service in node.services:
            if "send_response" not in vars(service):  # a `worker.WorkerService` has replaced it and sends by itself
                service.send_response = until_discovered(service.send_response)
    with suppress(KeyboardInterrupt):
        while context.ok() and not until():
            spin_once(executor, WAKE_PERIOD_S)


def spin_once(executor: Executor, timeout_s: float) -> None:
    """Dispatch the next events. A callback that raises is logged with its traceback, and the others are served."""
    try:
        executor.spin_once(timeout_sec=timeout_s)
    except Exception:
        if executor.context.ok():
            _log_exception()
            _serve_rest_of_batch(executor)


def _log_exception() -> None:
    get_logger("dm_common.ros").error(f"a callback raised:\n{traceback.format_exc()}")


def _serve_rest_of_batch(executor: Executor) -> None:
    """Serve what the executor dropped when a callback raised."""
    for node in executor.get_nodes():
        for subscription in list(node.subscriptions):
            while (taken := subscription.handle.take_message(subscription.msg_type, subscription.raw)) is not None:
                try:
                    subscription.callback(taken[0])
                except Exception:
                    _log_exception()
        for service in list(node.services):
            while (taken := service.handle.service_take_request(service.srv_type.Request))[0] is not None:
                request, header = taken
                try:
                    service.send_response(service.callback(request, service.srv_type.Response()), header)
                except Exception:
                    _log_exception()


class StopOnSignals:
    """Turns SIGINT and SIGTERM into a flag and wakes the executor, so that no callback is interrupted half way.

    To be made after the executor, which sets handlers of its own.
    """

    def __init__(self, executor: Executor) -> None:
        self.requested = False
        # Python runs a handler only once the main thread has returned from the executor's C++ code; a byte in this pipe
        # makes it return.
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        for number in STOPPING:
            signal.signal(number, self._on_signal)

        def wake() -> None:
            while os.read(reader, 1):
                executor.create_task(lambda: None)

        threading.Thread(target=wake, daemon=True).start()

    def _on_signal(self, _number: int, _frame: object) -> None:
        self.requested = True


class BackgroundExecutor:
    """Serves a node from a thread of its own, for programs that are not nodes themselves."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._executor = make_executor(node)
        self._stop = False
        self._thread = threading.Thread(target=spin, args=(self._executor, lambda: self._stop), daemon=True)
        self._thread.start()

    @property
    def is_here(self) -> bool:
        """Whether the caller is in its thread, where waiting for it would be a deadlock."""
        return threading.current_thread() is self._thread

    def destroy_node(self) -> None:
        """Stop serving and take the node, with all it published, out of the ROS graph."""
        self._stop = True
        self._executor.create_task(lambda: None)  # wake() alone does not end a spin_once
        self._thread.join(2 * WAKE_PERIOD_S)
        self._executor.shutdown(2 * WAKE_PERIOD_S)
        destroy(self._node)


def destroy(node: Node) -> None:
    """Destroy a node that no executor serves any more, with its action clients and servers.

    `Node.destroy_node` skips those; they form reference cycles, so the node would stay in the ROS graph until the
    garbage collector runs.
    """
    for waitable in list(node.waitables):
        if isinstance(waitable, ActionClient | ActionServer):
            waitable.destroy()
    node.destroy_node()


def _interrupt(*_: object) -> None:
    """Raise KeyboardInterrupt, only once: `ros2 launch` may have sent both signals before they were unblocked."""
    for number in STOPPING:
        signal.signal(number, lambda *_: None)
    raise KeyboardInterrupt


def run_node(make_node: Callable[[], Node], images: bool = False) -> int:
    """Run one node as a process: `main()` of every node calls this.

    Only nodes that send or receive `images` use shared memory (others: `shared_memory.use_udp_alone`).

    The node's `make_safe()`, if it has one, runs after the loop has ended and before anything is destroyed, with SIGINT
    and SIGTERM ignored, so that a second Ctrl-C cannot interrupt the way to the safe shape.

    Returns the exit status: 0, or 1 when the node could not be made (the reason is on standard error).
    """
    # Until `StopOnSignals`, both raise KeyboardInterrupt; a background job of a shell would otherwise ignore SIGINT.
    for number in STOPPING:
        signal.signal(number, _interrupt)
    node: Node | None = None
    executor: Executor | None = None
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)  # the parent may have blocked them until now
        # Only for node processes: programs that import a node do not need these.
        from dm_common.ros import shared_memory, stall

        shared_memory.remove_orphaned_segments()  # of killed nodes, such as the predecessor of this one
        if not images:
            shared_memory.use_udp_alone()
        try:
            rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        except RuntimeError as error:  # of rcl: an argument, or a parameter file, that it cannot read
            raise ValueError(str(error)) from error
        node = make_node()
        executor = make_executor(node)
        signals = StopOnSignals(executor)
        stall.watch()
        # Exempt all present objects: a full garbage collection through all modules would stall the node by 30 to 50 ms.
        gc.collect()
        gc.freeze()
        supervisor = os.environ.get(SUPERVISOR)
        spin(executor, until=lambda: signals.requested or supervisor not in (None, str(os.getppid())))
        return 0
    except (ParameterException, ValueError, OSError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        return 1
    except KeyboardInterrupt:
        return 0
    finally:
        for number in STOPPING:
            signal.signal(number, signal.SIG_IGN)
        if node is not None:
            getattr(node, "make_safe", lambda: None)()
            if executor is not None:
                executor.shutdown(WAKE_PERIOD_S)
        rclpy.try_shutdown()  # by this, worker threads know that the node ends
        if node is not None:
            node.destroy_node()


def until_discovered(send: Callable[..., None]) -> Callable[..., None]:
    """Wrap `send` so that an answer that was dropped is sent again, from a thread of its own."""

    def resend_if_dropped(*answer: Any) -> None:
        if _dropped(send, *answer):
            _send_again(send, *answer)

    return resend_if_dropped


class ResendingActionServer(ActionServer):
    """An action server that accepts every goal, and sends acceptance and result again when they were dropped."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        self._accepted_at = self._executed_at = 0.0

        def accept(_goal: Any) -> GoalResponse:
            self._accepted_at = time.monotonic()
            return GoalResponse.ACCEPT

        def execute(goal_handle: ServerGoalHandle) -> None:
            self._executed_at = time.monotonic()
            goal_handle.execute()

        super().__init__(*arguments, goal_callback=accept, handle_accepted_callback=execute, **keywords)

    @property
    def unfinished(self) -> bool:
        """Whether a goal has no outcome yet."""
        return any(handle.is_active for handle in list(self._goal_handles.values()))

    async def _execute_goal_request(self, request: Any) -> None:
        self._accepted_at = self._executed_at = 0.0
        await super()._execute_goal_request(request)
        # rclpy sends the answer after accepting a goal and before executing it.
        if self._executed_at - self._accepted_at >= DROPPED_S:
            answer = self._action_type.Impl.SendGoalService.Response(accepted=True)
            _send_again(self._handle.send_goal_response, request[0], answer)

    def _send_result_response(self, request_header: Any, future: Any) -> None:
        with suppress(rclpy_implementation.RCLError):  # the client may have gone
            until_discovered(self._handle.send_result_response)(request_header, future.result())


def _send_again(send: Callable[..., None], *answer: Any) -> None:
    """Send an answer that was dropped again, from a thread, until its client takes it or all pauses are over."""

    def repeat() -> None:
        with suppress(InvalidHandle, rclpy_implementation.RCLError):  # the node has ended
            for pause in PAUSES_S:
                time.sleep(pause)
                if not _dropped(send, *answer):
                    return
            get_logger("dm_common.ros").warning("an answer was lost: its client could not be discovered")

    threading.Thread(target=repeat, daemon=True).start()


def _dropped(send: Callable[..., None], *answer: Any) -> bool:
    began = time.monotonic()
    send(*answer)
    return time.monotonic() - began >= DROPPED_S
