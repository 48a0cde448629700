"""A plain Python face of the suite, for vision stacks and scripts: no callbacks, no executors.

from dm_client import DeformableMirrorClient

with DeformableMirrorClient() as mirror:
    print(mirror.capabilities.message)
    state = mirror.focus(curvature=0.02)        # 1/m of the surface; optical power = 2 x curvature
    print(f"{state.predicted_rms * 1e9:.1f} nm rms expected")
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any

import rclpy
from dm_msgs.action import BuildRecipes, Calibrate, Converge, MoveFocus
from dm_msgs.msg import ActuatorState, Calibration, Capabilities, FocusRequest, FocusState, MirrorInfo, SurfaceMapInfo
from dm_msgs.srv import (
    Degauss,
    Flatten,
    IngestFile,
    ListCalibrations,
    LoadCalibration,
    Measure,
    SetFocus,
    SetSignals,
    UpdateCalibration,
)
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image

from dm_common.errors import ErrorCode, Refusal
from dm_common.ros import qos
from dm_common.ros.action_client import ThreadedActionClient
from dm_common.ros.executor import BackgroundExecutor
from dm_common.ros.worker import ServiceCallError, answers_arrive, call

SERVICES = {
    SetSignals: "set_signals",
    Degauss: "degauss",
    SetFocus: "set_focus",
    Flatten: "flatten",
    IngestFile: "ingest_file",
    Measure: "measure",
    ListCalibrations: "list_calibrations",
    LoadCalibration: "load_calibration",
    UpdateCalibration: "update_calibration",
}
ACTIONS = {Calibrate: "calibrate", MoveFocus: "move_focus", Converge: "converge", BuildRecipes: "build_recipes"}
#: Two clients of one process need two names.
_NUMBERS = itertools.count(1)


#: `timeout_s` for nodes that the same program has only just started, s.
STARTING_S = 60.0


class DeformableMirrorError(Refusal):
    """The suite refused or could not carry out a request.

    Attributes:
        error_code: a value of ErrorCode.
        response: the whole response or result, when there is one.
    """

    def __init__(self, error_code: int, message: str, response: Any = None) -> None:
        super().__init__(error_code, message)
        self.response = response


class DeformableMirrorClient:
    """Talk to one mirror's nodes. Use as a context manager.

    Args:
        namespace: of the mirror, "" for none.
        domain: ROS domain; None = the environment's.
        timeout_s: how long to wait for a service that should answer at once.
    """

    def __init__(self, namespace: str = "", domain: int | None = None, timeout_s: float = 10.0) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node(f"dm_client_{os.getpid()}_{next(_NUMBERS)}", namespace=namespace, context=self._context)
        self._timeout_s = timeout_s
        self._latest: dict[str, Any] = {}
        self._clients: dict[str, Any] = {}
        for message_type, topic, profile in (
            (MirrorInfo, "mirror_info", qos.LATCHED),
            (Calibration, "calibration", qos.LATCHED),
            (Capabilities, "capabilities", qos.LATCHED),
            (ActuatorState, "actuator_state", qos.STATE),
        ):
            self._keep_latest(message_type, topic, profile)
        # Early, so that the nodes have discovered them all by the time the first is used.
        for service_type, name in SERVICES.items():
            self._client(service_type, name)
        for action_type, name in ACTIONS.items():
            self._client(action_type, name)
        self._background = BackgroundExecutor(self.node)

    def _keep_latest(self, message_type: Any, topic: str, profile: Any) -> None:
        self.node.create_subscription(message_type, topic, lambda m: self._latest.__setitem__(topic, m), profile)

    def __enter__(self) -> DeformableMirrorClient:
        return self

    def __exit__(
        self, _type: type[BaseException] | None, _error: BaseException | None, _traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the ROS graph; the mirror keeps its shape."""
        self._background.destroy_node()
        self._context.try_shutdown()

    # --- what is known ---

    def latest(self, topic: str, timeout_s: float | None = None) -> Any:
        """The latest message of `mirror_info`, `calibration`, `capabilities` or `actuator_state`.

        Raises:
            DeformableMirrorError: none came within the time.
        """
        if not self.wait(lambda: topic in self._latest, timeout_s):
            raise DeformableMirrorError(ErrorCode.INTERNAL, f"no message on {topic}: are the nodes running (./dm up)?")
        return self._latest[topic]

    def wait(self, condition: Callable[[], Any], timeout_s: float | None = None) -> bool:
        """Wait until `condition()` is true; False when it was not in time."""
        deadline = time.monotonic() + (self._timeout_s if timeout_s is None else timeout_s)
        while not condition():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.005)
        return True

    def wait_until_active(self, timeout_s: float = 20.0) -> None:
        """Wait until the driver accepts commands. Raises DeformableMirrorError with the driver's own reason."""

        def active() -> bool:
            state = self._latest.get("actuator_state")
            return state is not None and state.driver_state == ActuatorState.STATE_ACTIVE

        if not self.wait(active, timeout_s):
            reason = self.latest("actuator_state", 0.1).message or "it is not in the lifecycle state `active`"
            raise DeformableMirrorError(ErrorCode.DRIVER_INACTIVE, f"pdm_driver does not accept commands: {reason}")

    @property
    def capabilities(self) -> Capabilities:
        """Reachable range, calibration quality and error bound."""
        return self.latest("capabilities")

    @property
    def mirror_info(self) -> MirrorInfo:
        """Geometry and limits of the mirror."""
        return self.latest("mirror_info")

    @property
    def actuator_state(self) -> ActuatorState:
        """What stands at the electronics."""
        return self.latest("actuator_state")

    def _client(self, interface: Any, name: str) -> Any:
        """The service or action client of that name."""
        if name not in self._clients:
            is_action = hasattr(interface, "Goal")
            make = ThreadedActionClient if is_action else Node.create_client
            self._clients[name] = make(self.node, interface, name)
        return self._clients[name]

    # --- services ---

    def call(self, service_type: Any, name: str, request: Any, timeout_s: float | None = None) -> Any:
        """Call any service of the suite; raise DeformableMirrorError when it refuses or does not answer."""
        client = self._client(service_type, name)
        try:
            response = call(client, request, self._timeout_s if timeout_s is None else timeout_s)
        except ServiceCallError as error:
            raise DeformableMirrorError(ErrorCode.TIMEOUT, str(error)) from error
        if response.error_code != 0:
            raise DeformableMirrorError(response.error_code, response.message, response)
        return response

    def focus(
        self,
        curvature: float,
        conic_constant: float = 0.0,
        zernike: Sequence[float] = (),
        *,
        dry_run: bool = False,
    ) -> FocusState:
        """Set the surface curvature [1/m] (concave positive) and return the prediction; `dry_run` moves nothing."""
        request = FocusRequest(curvature=float(curvature), conic_constant=float(conic_constant), zernike=list(zernike))
        return self.call(SetFocus, "set_focus", SetFocus.Request(request=request, dry_run=dry_run)).state

    def focus_power(self, power: float, *, dry_run: bool = False) -> FocusState:
        """Set the optical power [dioptre] = 2 x surface curvature."""
        return self.focus(power / 2.0, dry_run=dry_run)

    def flatten(self, *, dry_run: bool = False) -> FocusState:
        """Make the surface as flat as the mirror can."""
        return self.call(Flatten, "flatten", Flatten.Request(dry_run=dry_run)).state

    def set_signals(self, signals: Sequence[float], *, wait: bool = True) -> SetSignals.Response:
        """Set all actuator signals (normalised, -1..+1)."""
        return self.call(SetSignals, "set_signals", SetSignals.Request(signals=list(map(float, signals)), wait=wait))

    def degauss(self, timeout_s: float = 120.0) -> Degauss.Response:
        """Remove the hysteresis and end at mid range."""
        return self.call(Degauss, "degauss", Degauss.Request(), timeout_s)

    def measure(self, label: str = "", timeout_s: float = 60.0) -> Measure.Response:
        """Take one map with the interferometer."""
        return self.call(Measure, "measure", Measure.Request(label=label), timeout_s)

    def ingest(self, path: str, timeout_s: float = 60.0) -> IngestFile.Response:
        """Read one map file."""
        return self.call(IngestFile, "ingest_file", IngestFile.Request(path=path), timeout_s)

    def measure_map(self, label: str = "", timeout_s: float = 60.0) -> tuple[Measure.Response, Image]:
        """Take one map and return it too (sensor_msgs/Image, 32FC1, m)."""
        if "surface_map" not in self._latest:
            self._keep_latest(Image, "surface_map", qos.MAP)
            self._keep_latest(SurfaceMapInfo, "surface_map_info", qos.MAP)
            self._latest["surface_map"] = None
            self.wait(lambda: self.node.count_publishers("surface_map") > 0)
            time.sleep(0.3)  # the publisher must have discovered this subscription too
        response = self.measure(label, timeout_s)

        def arrived() -> bool:
            image = self._latest["surface_map"]
            return image is not None and image.header.stamp == response.info.header.stamp

        if not self.wait(arrived):
            raise DeformableMirrorError(ErrorCode.MAP_TIMEOUT, "the map did not arrive on surface_map")
        return response, self._latest["surface_map"]

    def list_calibrations(self) -> ListCalibrations.Response:
        """Calibrations in the store, newest first."""
        return self.call(ListCalibrations, "list_calibrations", ListCalibrations.Request())

    def load_calibration(self, name: str = "") -> LoadCalibration.Response:
        """Load a stored calibration; "" = the newest that fits."""
        return self.call(LoadCalibration, "load_calibration", LoadCalibration.Request(calibration=name))

    def update_calibration(
        self, *, dry_run: bool = False, forget: bool = False, timeout_s: float = 70.0
    ) -> UpdateCalibration.Response:
        """Compare the calibration in use with a map taken now, and let it improve the calibration unless `dry_run`.

        `forget` takes no map but drops all earlier updates.
        """
        request = UpdateCalibration.Request(dry_run=dry_run, forget=forget)
        return self.call(UpdateCalibration, "update_calibration", request, timeout_s)

    # --- actions ---

    def run_action(
        self, action_type: Any, name: str, goal: Any, on_feedback: Callable[[Any], None], timeout_s: float
    ) -> Any:
        """Run a goal to its end. Ctrl-C cancels it first, so that the mirror is left safe."""
        client = self._client(action_type, name)
        if not self.wait(lambda: answers_arrive(client, client.server_is_ready)):
            raise DeformableMirrorError(ErrorCode.TIMEOUT, f"{name}: no such action; is its node running?")
        accepted = client.send_goal_async(goal, feedback_callback=lambda message: on_feedback(message.feedback))
        finished = None
        try:
            if not self.wait(accepted.done):
                raise DeformableMirrorError(ErrorCode.TIMEOUT, f"{name}: no answer to the goal")
            if not accepted.result().accepted:
                raise DeformableMirrorError(ErrorCode.BUSY, f"{name}: refused, another goal is running")
            finished = accepted.result().get_result_async()
            if not self.wait(finished.done, timeout_s):
                raise DeformableMirrorError(ErrorCode.TIMEOUT, f"{name}: not finished within {timeout_s:g} s")
        except BaseException:
            self._cancel(accepted, finished)
            raise
        result = finished.result().result
        if result.error_code != 0:
            raise DeformableMirrorError(result.error_code, result.message, result)
        return result

    def _cancel(self, accepted: Any, finished: Any) -> None:
        """Cancel a goal that may not be accepted yet, and wait for its end."""
        if not self.wait(accepted.done) or not accepted.result().accepted:
            return
        handle = accepted.result()
        handle.cancel_goal_async()
        self.wait((finished or handle.get_result_async()).done, 20.0)

    def move_focus(
        self,
        curvature: float,
        conic_constant: float = 0.0,
        *,
        tolerance: float = 0.0,
        settle_time: float = 0.0,
        on_feedback: Callable[[Any], None] = lambda feedback: None,
        timeout_s: float = 30.0,
    ) -> MoveFocus.Result:
        """Move to a curvature and return when the shape stands."""
        request = FocusRequest(curvature=float(curvature), conic_constant=float(conic_constant))
        goal = MoveFocus.Goal(request=request, tolerance=float(tolerance), settle_time=float(settle_time))
        return self.run_action(MoveFocus, "move_focus", goal, on_feedback, timeout_s)

    def converge(
        self,
        curvature: float,
        conic_constant: float = 0.0,
        *,
        method: str = "",
        tolerance: float = 0.0,
        max_maps: int = 0,
        on_feedback: Callable[[Any], None] = lambda feedback: None,
        timeout_s: float = 600.0,
    ) -> Converge.Result:
        """Close the loop on the interferometer until the measured surface is the requested one."""
        request = FocusRequest(curvature=float(curvature), conic_constant=float(conic_constant))
        goal = Converge.Goal(request=request, method=method, tolerance=float(tolerance), max_maps=max_maps)
        return self.run_action(Converge, "converge", goal, on_feedback, timeout_s)

    def build_recipes(
        self,
        curvatures: Sequence[float],
        conic_constant: float = 0.0,
        *,
        tolerance: float = 0.0,
        max_maps: int = 0,
        on_feedback: Callable[[Any], None] = lambda feedback: None,
        timeout_s: float = 14400.0,
    ) -> BuildRecipes.Result:
        """Build a recipe for each curvature [1/m] on the bench, and store them with the calibration in use."""
        goal = BuildRecipes.Goal(
            curvatures=[float(curvature) for curvature in curvatures],
            conic_constant=float(conic_constant),
            tolerance=float(tolerance),
            max_maps=max_maps,
        )
        return self.run_action(BuildRecipes, "build_recipes", goal, on_feedback, timeout_s)

    def calibrate(
        self,
        goal: Calibrate.Goal | None = None,
        on_feedback: Callable[[Any], None] = lambda feedback: None,
        timeout_s: float = 7200.0,
    ) -> Calibrate.Result:
        """Measure and store a calibration; by default the full plan, used at once."""
        goal = goal if goal is not None else Calibrate.Goal(activate=True)
        return self.run_action(Calibrate, "calibrate", goal, on_feedback, timeout_s)
