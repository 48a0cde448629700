"""The ROS side of the console: one node on a thread of its own, the latest messages, and calls as coroutines."""

import asyncio
import math
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from action_msgs.srv import CancelGoal
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from dm_msgs.msg import ActuatorEstimate, RecipeBook, SurfaceMapInfo, ZernikeCoefficients
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image

from dm_client import client
from dm_client.connection import Connection, DeformableMirrorError
from dm_common.errors import ErrorCode, Refusal
from dm_common.messages import seconds
from dm_common.ros import qos
from dm_tools.console.state_observer import StateObserver
from dm_tools.long_actions import LONG, ExternalGoals
from dm_tools.running_suite import NEEDED

TOPICS = client.TOPICS | {
    "actuator_estimate": (ActuatorEstimate, qos.LATCHED),
    "recipes": (RecipeBook, qos.LATCHED),
    "surface_map": (Image, qos.MAP),
    "surface_map_info": (SurfaceMapInfo, qos.MAP),
    "zernike": (ZernikeCoefficients, qos.STATE),
}
#: Services for which the console has no button.
NOT_OFFERED = ("ingest_file", "update_calibration")
WATCHED = {
    node: (kind, topic, profile, {name: served[name] for name in served if name not in NOT_OFFERED})
    for node, (kind, topic, profile, served) in client.WATCHED.items()
}
#: Names of the levels of rcl_interfaces/Log.
LOG_LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "FATAL"}
#: Lines of the log that are kept.
LOG_LINES = 200
#: A node whose diagnostics were not heard for this long counts as missing, s. Nodes publish once a second.
SILENCE_S = 5.0
#: Time limit for a service that answers at once, s.
ANSWER_S = 10.0
#: ROS time that jumps back by more than this means that a simulator was restarted, s.
TIME_JUMP_S = 60.0


@dataclass(frozen=True)
class Snapshot:
    """The latest message of each topic; None = none was heard.

    Attributes:
        calibration: in use; None = none is, or none was heard.
        diagnostics: {node: latest status}, of this namespace's nodes and others; STALE = no longer heard.
        health: the same, only for nodes of this namespace that were heard lately, by their names without namespace.
        bench_time: latest ROS time that was heard, s.
    """

    mirror_info: Any = None
    calibration: Any = None
    recipes: Any = None
    capabilities: Any = None
    actuator_state: Any = None
    actuator_estimate: Any = None
    surface_map: Any = None
    surface_map_info: Any = None
    zernike: Any = None
    diagnostics: dict[str, DiagnosticStatus] = field(default_factory=dict)
    health: dict[str, DiagnosticStatus] = field(default_factory=dict)
    bench_time: float = 0.0


class ConsoleNode:
    """Listens to one mirror's nodes and calls them.

    Attributes:
        log: the last lines that nodes logged, and what went wrong here: time, level, logger, message.
    """

    def __init__(self, namespace: str = "", domain: int | None = None) -> None:
        self._prefix = f"{namespace.strip('/')}/" if namespace.strip("/") else ""
        self._diagnostics: dict[str, tuple[DiagnosticStatus, float]] = {}  # with the monotonic time of arrival, s
        self._bench_time = 0.0
        self._timed = {f"{self._prefix}{name}" for name in NEEDED}  # others, and the simulation, may have another time
        self._stops: dict[str, threading.Event] = {}  # of the running goals; setting one cancels its goal
        self.observer = StateObserver()
        self._connection = Connection("dm_console", namespace, domain, TOPICS, WATCHED, self._take)
        self.node = self._connection.node
        self.log: deque[tuple[str, str, str, str]] = deque(maxlen=LOG_LINES)
        # Transient local: nodes repeat their latest lines to late subscribers.
        profile = QoSProfile(depth=LOG_LINES, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(Log, "/rosout", self._take_line, profile)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._take_diagnostics, qos.STATE)
        self.watched = {name: ExternalGoals(self.node, client.INTERFACES[name], name) for name in LONG}
        self._connection.start()

    def _take(self, topic: str, message: Any) -> None:
        if topic == "actuator_state":
            self.observer.observe(message)
        elif topic == "actuator_estimate":
            self.observer.take(message)
        elif topic == "calibration":
            self.observer.use(message)

    def _take_diagnostics(self, message: DiagnosticArray) -> None:
        if self._timed.intersection(status.name for status in message.status):
            time_s = seconds(message.header.stamp)
            restarted = time_s < self._bench_time - TIME_JUMP_S
            self._bench_time = time_s if restarted else max(self._bench_time, time_s)
        for status in message.status:
            self._diagnostics[status.name] = status, time.monotonic()

    def _take_line(self, line: Log) -> None:
        self.take_log(seconds(line.stamp), LOG_LEVELS.get(line.level, str(line.level)), line.name, line.msg)

    def take_log(self, time_s: float, level: str, logger: str, message: str) -> None:
        """Keep a line of the log."""
        self.log.append((time.strftime("%H:%M:%S", time.localtime(time_s)), level, logger, message))

    def close(self) -> None:
        """Leave the ROS graph; the mirror keeps its shape."""
        self._connection.close()

    def snapshot(self) -> Snapshot:
        """What is known now."""
        recent, lost = time.monotonic() - SILENCE_S, {"level": DiagnosticStatus.STALE, "message": "no longer heard"}
        diagnostics = {
            name: status if when >= recent else DiagnosticStatus(name=name, **lost)
            for name, (status, when) in self._diagnostics.copy().items()
        }
        messages = dict(self._connection.messages)
        if "calibration" in messages and not messages["calibration"].id:
            del messages["calibration"]
        return Snapshot(
            **messages,
            diagnostics=diagnostics,
            health={
                name.removeprefix(self._prefix): status
                for name, status in diagnostics.items()
                if name.rpartition("/")[0] == self._prefix.rstrip("/") and status.level != DiagnosticStatus.STALE
            },
            bench_time=self._bench_time,
        )

    async def call(self, name: str, request: Any, timeout_s: float = ANSWER_S, again: bool = False) -> Any:
        """Call a service of the suite, as `Connection.call`.

        Raises Refusal when it refused, with its sentence, or did not answer.
        """
        try:
            return await asyncio.to_thread(self._connection.call, name, request, timeout_s, again)
        except DeformableMirrorError as error:
            raise Refusal(error.error_code, f"{error} (error {error.error_code})") from error

    async def run(self, name: str, goal: Any, on_feedback: Callable[[Any], None]) -> Any:
        """Run an action to its end and return its result.

        Raises Refusal with the node's sentence when the goal was refused, ended with an error or was cancelled.
        """
        identity = client.INTERFACES[name].Impl.SendGoalService.Request().goal_id
        identity.uuid = list(uuid.uuid4().bytes)
        watched, stop = self.watched.get(name), threading.Event()
        if watched is not None:
            watched.own(identity)
        self._stops[name] = stop
        try:
            return await asyncio.to_thread(
                self._connection.run_action, name, goal, on_feedback, math.inf, stop.is_set, identity
            )
        except DeformableMirrorError as error:
            if error.response is not None:
                raise Refusal(error.error_code, f"{error} (error {error.error_code})") from error
            if watched is not None:  # the goal may run nevertheless: then it must be shown, and be cancellable
                watched.disown(identity)
            raise
        finally:
            self._stops.pop(name, None)

    @property
    def external_action(self) -> str:
        """Name of a running action that was not started here; "" = none."""
        return next((name for name, watch in self.watched.items() if watch.running), "")

    async def cancel(self, name: str) -> None:
        """Ask the running goal of `name`, if there is one, to stop, whichever client sent it.

        Raises Refusal when there is no answer, or the node does not know the goal.
        """
        own, watched = self._stops.get(name), self.watched.get(name)
        if own is not None:
            own.set()
        # While a goal of this console is starting, the goal of another client is not cancelled.
        cancellation = None if watched is None or (own is not None and watched.running) else watched.cancel()
        if cancellation is None:
            return
        if not await asyncio.to_thread(self._connection.wait, cancellation.done, ANSWER_S):
            raise Refusal(ErrorCode.TIMEOUT, f"{name}: no answer to the cancellation within {ANSWER_S:g} s")
        code, codes = cancellation.result().return_code, CancelGoal.Response
        if code not in (codes.ERROR_NONE, codes.ERROR_GOAL_TERMINATED):
            raise Refusal(ErrorCode.NOT_SUPPORTED, f"{name}: its node does not cancel the goal (code {code})")
