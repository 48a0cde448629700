"""A plain Python interface of the suite, for vision stacks and scripts: no callbacks, no executors.

from dm_client import DeformableMirrorClient

with DeformableMirrorClient() as mirror:
    print(mirror.capabilities.message)
    state = mirror.focus(curvature=0.02)        # 1/m of the surface; optical power = 2 x curvature
    print(f"{state.predicted_rms * 1e9:.1f} nm rms expected")
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Self, Unpack

from dm_msgs.action import BuildRecipes, Calibrate, Converge, Degauss, MoveFocus
from dm_msgs.msg import ActuatorState, Calibration, Capabilities, FocusRequest, FocusState, MirrorInfo, SurfaceMapInfo
from dm_msgs.srv import (
    Flatten,
    HoldMirror,
    IngestFile,
    ListCalibrations,
    LoadCalibration,
    Measure,
    SetFocus,
    SetSignals,
    UpdateCalibration,
)
from sensor_msgs.msg import Image

from dm_client.connection import RESTING, Connection, DeformableMirrorError, Watched
from dm_client.fields import Claim, FocusOptions, filled
from dm_common.errors import ErrorCode
from dm_common.messages import driver_refusal
from dm_common.ros import qos

TOPICS = {
    "mirror_info": (MirrorInfo, qos.LATCHED),
    "calibration": (Calibration, qos.LATCHED),
    "capabilities": (Capabilities, qos.LATCHED),
    "actuator_state": (ActuatorState, qos.STATE),
}
WATCHED: Watched = {
    "pdm_driver": (
        MirrorInfo,
        "mirror_info",
        qos.LATCHED,
        {"set_signals": SetSignals, "degauss": Degauss, "hold_mirror": HoldMirror},
    ),
    "interferometer": (SurfaceMapInfo, "surface_map_info", qos.STATE, {"measure": Measure, "ingest_file": IngestFile}),
    "calibration": (
        Calibration,
        "calibration",
        qos.LATCHED,
        {
            "calibrate": Calibrate,
            "list_calibrations": ListCalibrations,
            "load_calibration": LoadCalibration,
            "update_calibration": UpdateCalibration,
        },
    ),
    "focus_controller": (
        Capabilities,
        "capabilities",
        qos.LATCHED,
        {
            "set_focus": SetFocus,
            "flatten": Flatten,
            "move_focus": MoveFocus,
            "converge": Converge,
            "build_recipes": BuildRecipes,
        },
    ),
}
INTERFACES = {name: interface for *_, served in WATCHED.values() for name, interface in served.items()}
#: `timeout_s` for nodes that the same program has only just started, s.
STARTING_S = 60.0


class DeformableMirrorClient(Connection):
    """Client of one mirror's nodes, for any thread except the one that calls `on_feedback`. Use as a context manager.

    Args:
        namespace: of the mirror, "" for none; the namespace of the process itself is ignored.
        domain: ROS domain; None = the environment's.
        timeout_s: longest wait for a service that should answer at once. Measurements and moves have time limits of
            their own; if such a limit is infinite, the node decides when to give up.
    """

    #: The nodes that it calls.
    watched: Watched = WATCHED

    def __init__(self, namespace: str = "", domain: int | None = None, timeout_s: float = 10.0) -> None:
        super().__init__("dm_client", namespace, domain, TOPICS, self.watched, timeout_s=timeout_s)
        self.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    # --- what is known ---

    def latest(self, topic: str, timeout_s: float | None = None) -> Any:
        """The latest message on a subscribed topic. Raises DeformableMirrorError for others, or if none came."""
        if topic not in self._subscribed:
            text = f"{topic!r}: must be one of {', '.join(sorted(self._subscribed))}, or one given to `subscribe`"
            raise DeformableMirrorError(ErrorCode.UNKNOWN_NAME, text)
        if not self.wait(lambda: topic in self.messages, timeout_s):
            raise DeformableMirrorError(ErrorCode.TIMEOUT, f"no message on {topic}: are the nodes running (./dm up)?")
        return self.messages[topic]

    def wait_until_active(self, timeout_s: float = 20.0) -> None:
        """Wait until the driver, and the controller if there is one, take requests. Raises DeformableMirrorError."""

        def refusal() -> tuple[int, str]:
            state, able = self.messages.get("actuator_state"), self.messages.get("capabilities")
            if (driver := self._servers["set_signals"]).lost:
                return ErrorCode.DRIVER_UNAVAILABLE, driver.text
            if (refused := driver_refusal(state)) is not None:
                return refused.error_code, str(refused)
            return (able.error_code, able.message) if able and able.error_code in RESTING else (0, "")

        if not self.wait(lambda: not refusal()[0], timeout_s) and (refused := refusal())[0]:
            raise DeformableMirrorError(*refused)

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
        """Signals at the electronics, and the state of the driver."""
        return self.latest("actuator_state")

    # --- services ---

    def focus(
        self,
        curvature: float,
        conic_constant: float = 0.0,
        zernike: Sequence[float] = (),
        *,
        dry_run: bool = False,
        **options: Unpack[FocusOptions],
    ) -> FocusState:
        """Set the surface curvature [1/m] (concave positive) and return the prediction; `dry_run` moves nothing."""
        request = filled(FocusRequest, curvature=curvature, conic_constant=conic_constant, zernike=zernike, **options)
        return self.call("set_focus", filled(SetFocus.Request, request=request, dry_run=dry_run)).state

    def focus_power(self, power: float, *, dry_run: bool = False, **options: Unpack[FocusOptions]) -> FocusState:
        """Set the optical power [dioptre] = 2 x surface curvature."""
        return self.focus(filled(FocusState, power=power).power / 2.0, dry_run=dry_run, **options)

    def flatten(self, *, dry_run: bool = False, **claim: Unpack[Claim]) -> FocusState:
        """Make the surface as flat as the mirror can."""
        return self.call("flatten", filled(Flatten.Request, dry_run=dry_run, **claim)).state

    def set_signals(
        self, signals: Sequence[float], *, wait: bool = True, **claim: Unpack[Claim]
    ) -> SetSignals.Response:
        """Set all actuator signals (normalised, -1..+1); with `wait`, return once they are reached."""
        request = filled(SetSignals.Request, signals=signals, wait=wait, **claim)
        return self.call("set_signals", request, math.inf if wait else None, again=True)

    def degauss(
        self,
        steps: int = 0,
        *,
        on_feedback: Callable[[Any], None] = lambda feedback: None,
        timeout_s: float = math.inf,
        **claim: Unpack[Claim],
    ) -> Degauss.Result:
        """Remove the hysteresis and end at mid range; `steps` half-swings, 0 = as configured in the driver."""
        return self.run_action("degauss", filled(Degauss.Goal, steps=steps, **claim), on_feedback, timeout_s)

    def measure(self, label: str = "", timeout_s: float = 0.0, *, answer_only: bool = False) -> Measure.Response:
        """Take one map with the interferometer, which gives up after `timeout_s` (0 = as configured) and says why.

        With `answer_only` the map is not published: for maps of another object in place of the mirror.
        """
        request = filled(Measure.Request, label=label, timeout=timeout_s, answer_only=answer_only)
        return self.call("measure", request, timeout_s + 5.0 if timeout_s else math.inf)

    def ingest(self, path: str, timeout_s: float = 60.0) -> IngestFile.Response:
        """Read one map file."""
        return self.call("ingest_file", filled(IngestFile.Request, path=path), timeout_s)

    def measure_map(self, label: str = "", timeout_s: float = 0.0) -> tuple[Measure.Response, Image]:
        """Take one map, and return the map itself as well (sensor_msgs/Image, 32FC1, m)."""
        if self.subscribe("surface_map", Image, qos.MAP):
            self.wait(lambda: self.node.count_publishers("surface_map") > 0)
            time.sleep(0.3)  # the publisher must have discovered this subscription too
        response = self.measure(label, timeout_s)
        return response, self.stamped("surface_map", response.info.header.stamp, ErrorCode.MAP_TIMEOUT)

    def list_calibrations(self) -> ListCalibrations.Response:
        """Calibrations in the store, newest first."""
        return self.call("list_calibrations", ListCalibrations.Request())

    def load_calibration(self, name: str = "") -> LoadCalibration.Response:
        """Load a stored calibration; "" = the newest that fits."""
        return self.call("load_calibration", filled(LoadCalibration.Request, calibration=name))

    def update_calibration(
        self,
        *,
        dry_run: bool = False,
        forget: bool = False,
        without: Sequence[int] = (),
        timeout_s: float = math.inf,
        **claim: Unpack[Claim],
    ) -> UpdateCalibration.Response:
        """Compare the calibration in use with a map taken now, and let it improve the calibration unless `dry_run`.

        `forget` takes no map but drops all earlier updates. `without` are the numbers, from 1, of actuators that no
        longer move: from now on they count as without effect, at the position that the map shows.
        """
        request = filled(UpdateCalibration.Request, dry_run=dry_run, forget=forget, without=without, **claim)
        return self.call("update_calibration", request, timeout_s)

    # --- actions ---

    def move_focus(
        self,
        curvature: float,
        conic_constant: float = 0.0,
        *,
        tolerance: float = 0.0,
        settle_time: float = 0.0,
        on_feedback: Callable[[Any], None] = lambda feedback: None,
        timeout_s: float = math.inf,
        **options: Unpack[FocusOptions],
    ) -> MoveFocus.Result:
        """Move to a curvature and return once the shape has settled."""
        request = filled(FocusRequest, curvature=curvature, conic_constant=conic_constant, **options)
        goal = filled(MoveFocus.Goal, request=request, tolerance=tolerance, settle_time=settle_time)
        return self.run_action("move_focus", goal, on_feedback, timeout_s)

    def converge(
        self,
        curvature: float,
        conic_constant: float = 0.0,
        *,
        method: str = "",
        tolerance: float = 0.0,
        max_maps: int = 0,
        on_feedback: Callable[[Any], None] = lambda feedback: None,
        timeout_s: float = math.inf,
        **claim: Unpack[Claim],
    ) -> Converge.Result:
        """Close the loop on the interferometer until the measured surface is the requested one."""
        request = filled(FocusRequest, curvature=curvature, conic_constant=conic_constant, **claim)
        goal = filled(Converge.Goal, request=request, method=method, tolerance=tolerance, max_maps=max_maps)
        return self.run_action("converge", goal, on_feedback, timeout_s)

    def build_recipes(
        self,
        curvatures: Sequence[float],
        conic_constant: float = 0.0,
        zernike: Sequence[float] = (),
        *,
        tolerance: float = 0.0,
        max_maps: int = 0,
        on_feedback: Callable[[Any], None] = lambda feedback: None,
        timeout_s: float = math.inf,
        **claim: Unpack[Claim],
    ) -> BuildRecipes.Result:
        """Build a recipe for each curvature [1/m] on the bench, with `zernike` [m] added; they are stored."""
        shapes = {"curvatures": curvatures, "conic_constant": conic_constant, "zernike": zernike}
        goal = filled(BuildRecipes.Goal, **shapes, tolerance=tolerance, max_maps=max_maps, **claim)
        return self.run_action("build_recipes", goal, on_feedback, timeout_s)

    def calibrate(
        self,
        goal: Calibrate.Goal | None = None,
        on_feedback: Callable[[Any], None] = lambda feedback: None,
        timeout_s: float = math.inf,
    ) -> Calibrate.Result:
        """Measure and store a calibration; by default the full plan, used at once."""
        return self.run_action("calibrate", goal or Calibrate.Goal(activate=True), on_feedback, timeout_s)
