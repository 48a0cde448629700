"""The ROS side of the console: one node on a thread of its own, the latest messages, and calls as coroutines."""

import asyncio
import contextlib
import time
import uuid
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from action_msgs.srv import CancelGoal
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from dm_msgs.msg import ActuatorEstimate, SurfaceMapInfo, ZernikeCoefficients
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import Image

from dm_client import client
from dm_client.connection import Connection, DeformableMirrorError
from dm_common.errors import ErrorCode, Refusal
from dm_common.messages import seconds
from dm_common.ros import qos
from dm_tools.console.state_observer import StateObserver
from dm_tools.long_actions import LONG, ExternalGoals

TOPICS = client.TOPICS | {
    "actuator_estimate": (ActuatorEstimate, qos.LATCHED),
    "surface_map": (Image, qos.MAP),
    "surface_map_info": (SurfaceMapInfo, qos.MAP),
    "zernike": (ZernikeCoefficients, qos.STATE),
}
#: What the console has no button for.
NOT_OFFERED = ("ingest_file", "update_calibration")
INTERFACES = {name: interface for name, interface in client.INTERFACES.items() if name not in NOT_OFFERED}
#: Names of the levels of rcl_interfaces/Log.
LOG_LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "FATAL"}
#: Lines of the log that are kept.
LOG_LINES = 200
#: A node whose diagnostics were not heard for so long counts as missing, s. Nodes publish once a second.
SILENCE_S = 5.0
#: Time for an answer that comes at once, s.
ANSWER_S = 10.0
#: Time that runs back by more than this is another time: a simulator that was started again, s.
TIME_JUMP_S = 60.0


@dataclass(frozen=True)
class Snapshot:
    """The latest message of each topic; None = none was heard.

    Attributes:
        diagnostics: {node: latest status}, of this namespace's nodes and others.
        present: names of the nodes heard lately, without the namespace.
        bench_time: s, ROS time as far as heard.
    """

    mirror_info: Any = None
    calibration: Any = None
    capabilities: Any = None
    actuator_state: Any = None
    actuator_estimate: Any = None
    surface_map: Any = None
    surface_map_info: Any = None
    zernike: Any = None
    diagnostics: dict[str, DiagnosticStatus] = field(default_factory=dict)
    present: frozenset[str] = frozenset()
    bench_time: float = 0.0


class ConsoleNode:
    """Listens to one mirror's nodes and calls them.

    Args:
        namespace: of the mirror, "" for none.
        domain: ROS domain; None = the environment's.

    Attributes:
        log: the last lines that nodes logged, and what went wrong here: time, level, logger, message.
        lines_logged: how many were heard in all.
    """

    def __init__(self, namespace: str = "", domain: int | None = None) -> None:
        self._prefix = f"{namespace.strip('/')}/" if namespace.strip("/") else ""
        self._heard: dict[str, float] = {}
        self._diagnostics: dict[str, DiagnosticStatus] = {}
        self._bench_time = 0.0
        self._goals: dict[str, Any] = {}
        self._beginning: dict[str, bool] = {}  # goals that are not accepted yet; True = to be cancelled
        self.observer = StateObserver()
        self._connection = Connection("dm_console", namespace, domain, TOPICS, INTERFACES, self._take)
        self.node = self._connection.node
        self.log: deque[tuple[str, str, str, str]] = deque(maxlen=LOG_LINES)
        self.lines_logged = 0
        # Nodes offer their latest lines to those who come late.
        profile = QoSProfile(depth=LOG_LINES, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(Log, "/rosout", self._take_line, profile)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._take_diagnostics, qos.STATE)
        self.watched = {name: ExternalGoals(self.node, INTERFACES[name], name) for name in LONG}
        self._connection.start()

    def _take(self, topic: str, message: Any) -> None:
        if topic == "actuator_state":
            self.observer.observe(message)
        elif topic == "actuator_estimate":
            self.observer.take(message)
        elif topic == "calibration":
            self.observer.use(message)

    def _take_diagnostics(self, message: DiagnosticArray) -> None:
        time_s = seconds(message.header.stamp)
        restarted = time_s < self._bench_time - TIME_JUMP_S
        self._bench_time = time_s if restarted else max(self._bench_time, time_s)
        for status in message.status:
            self._diagnostics[status.name] = status
            self._heard[status.name] = time.monotonic()

    def _take_line(self, line: Log) -> None:
        self.take_log(seconds(line.stamp), LOG_LEVELS.get(line.level, str(line.level)), line.name, line.msg)

    def take_log(self, time_s: float, level: str, logger: str, message: str) -> None:
        """Keep a line of the log."""
        self.log.append((time.strftime("%H:%M:%S", time.localtime(time_s)), level, logger, message))
        self.lines_logged += 1

    def close(self) -> None:
        """Leave the ROS graph; the mirror keeps its shape."""
        self._connection.close()

    def snapshot(self) -> Snapshot:
        """What is known now."""
        recent = time.monotonic() - SILENCE_S
        present = frozenset(
            name.removeprefix(self._prefix)
            for name, when in dict(self._heard).items()
            if when >= recent and name.startswith(self._prefix)
        )
        return Snapshot(
            **dict(self._connection.messages),
            diagnostics=dict(self._diagnostics),
            present=present,
            bench_time=self._bench_time,
        )

    async def call(self, name: str, request: Any, timeout_s: float = ANSWER_S) -> Any:
        """Call a service of the suite.

        Raises:
            Refusal: it refused, with its sentence, or did not answer.
        """
        try:
            return await asyncio.to_thread(self._connection.call, name, request, timeout_s)
        except DeformableMirrorError as error:
            raise Refusal(error.error_code, f"{error} (error {error.error_code})") from error

    async def run(self, name: str, goal: Any, on_feedback: Callable[[Any], None], timeout_s: float = 7200.0) -> Any:
        """Run an action to its end and return its result.

        Raises:
            Refusal: the goal was refused, ended with an error or was cancelled, with the node's sentence.
        """
        action = self._connection.clients[name]
        identity = INTERFACES[name].Impl.SendGoalService.Request().goal_id
        identity.uuid = list(uuid.uuid4().bytes)
        if name in self.watched:
            self.watched[name].own(identity)
        self._beginning[name] = False
        try:
            handle = self._goals[name] = await self._begin(name, goal, on_feedback, identity)
            finished = handle.get_result_async()
            if self._beginning.pop(name):
                await self.cancel(name)
            if not await _until(finished.done, timeout_s, lambda: not action.server_is_ready()):
                with contextlib.suppress(Refusal):
                    await self.cancel(name)
                raise Refusal(
                    ErrorCode.TIMEOUT, f"{name}: no result: its node has gone, or it took longer than {timeout_s:g} s"
                )
        except Refusal:
            if name in self.watched:  # it may run all the same: then it must be seen, and be cancelled from here
                self.watched[name].disown(identity)
            raise
        finally:
            self._beginning.pop(name, None)
            self._goals.pop(name, None)
        result = finished.result().result
        if result.error_code != 0:
            raise Refusal(result.error_code, f"{result.message} (error {result.error_code})")
        return result

    async def _begin(self, name: str, goal: Any, on_feedback: Callable[[Any], None], identity: Any) -> Any:
        """The handle of a goal that was accepted."""
        action = self._connection.clients[name]
        if not await _until(action.server_is_ready, ANSWER_S):
            raise Refusal(ErrorCode.TIMEOUT, f"{name}: no such action within {ANSWER_S:g} s; is its node running?")
        if self._beginning[name]:
            raise Refusal(ErrorCode.CANCELED, f"{name}: cancelled before it began; nothing has changed")
        accepted = action.send_goal_async(goal, lambda message: on_feedback(message.feedback), identity)
        if not await _until(accepted.done, ANSWER_S):
            raise Refusal(ErrorCode.TIMEOUT, f"{name}: no answer to the goal within {ANSWER_S:g} s")
        handle = accepted.result()
        if not handle.accepted:
            raise Refusal(ErrorCode.BUSY, f"{name}: refused, another goal is running")
        return handle

    @property
    def external_action(self) -> str:
        """Name of an action that runs and was not started here; "" = none."""
        return next((name for name, watch in self.watched.items() if watch.running), "")

    async def cancel(self, name: str) -> None:
        """Ask the goal that runs for `name` to stop, whoever sent it; nothing when none runs.

        Raises:
            Refusal: no answer, or the node does not know the goal.
        """
        handle = self._goals.get(name)
        if handle is None and name in self._beginning:
            self._beginning[name] = True  # whoever begins it cancels it as soon as it is accepted
            return
        if handle is not None:
            asked: Future | None = handle.cancel_goal_async()
        else:
            asked = self.watched[name].cancel() if name in self.watched else None
        if asked is None:
            return
        if not await _until(asked.done, ANSWER_S):
            raise Refusal(ErrorCode.TIMEOUT, f"{name}: no answer to the cancellation within {ANSWER_S:g} s")
        code, codes = asked.result().return_code, CancelGoal.Response
        if code not in (codes.ERROR_NONE, codes.ERROR_GOAL_TERMINATED):
            raise Refusal(ErrorCode.NOT_SUPPORTED, f"{name}: its node does not cancel the goal (code {code})")


async def _until(condition: Callable[[], Any], timeout_s: float, lost: Callable[[], bool] = lambda: False) -> bool:
    """Wait until `condition()` is true; False when it was not in time, or `lost()` was true too long."""
    deadline, lost_since = time.monotonic() + timeout_s, float("inf")
    while not condition():
        now = time.monotonic()
        lost_since = min(lost_since, now) if lost() else float("inf")
        if now > deadline or now - lost_since > SILENCE_S:
            return False
        await asyncio.sleep(0.02)
    return True
