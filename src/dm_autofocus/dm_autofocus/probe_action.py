"""Base class of the node's actions: they move the focus and take images until they are done or stopped."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

from dm_msgs.msg import Capabilities
from rclpy.node import Node

from dm_autofocus.focus_probe import FocusProbe, SharpnessSample
from dm_autofocus.optics import FocusOptics
from dm_autofocus.search.peak_search import Phase
from dm_common.errors import EXPECTED, ErrorCode, Refusal, error_code
from dm_common.optics.conic import range_text
from dm_common.ros.worker import WorkerActionServer, WorkerGoal
from dm_common.values import Fields, fill_with_nan, real, text

#: Share of the reachable range left out at each end: the controller's own test of the limits must not fail on rounding.
MARGIN = 0.002

#: Allowed values of the fields that every goal has.
GOAL_FIELDS = {"curvature_min": real(0.0), "curvature_max": real(0.0), "holder": text("")}

#: How long a goal waits for a controller that may still be starting, s.
START_GRACE_S = 5.0


def ready_capabilities(probe: FocusProbe) -> Capabilities:
    """The mirror's capabilities. Raises Refusal when it cannot be focused."""
    if probe.controller.missing():
        raise Refusal(ErrorCode.TIMEOUT, probe.controller.text)
    capabilities = probe.capabilities
    if capabilities is None:
        raise Refusal(ErrorCode.TIMEOUT, "no capabilities from focus_controller yet: is it running?")
    if capabilities.quality == Capabilities.UNCALIBRATED or capabilities.error_code != ErrorCode.OK:
        raise Refusal(capabilities.error_code or ErrorCode.NOT_CALIBRATED, capabilities.message)
    return capabilities


def range_of(goal: Any, capabilities: Capabilities) -> tuple[float, float]:
    """The range of curvatures [1/m] that a goal asks for by `curvature_min` and `curvature_max`; both 0 = all of it.

    Raises:
        Refusal: it is not in the reachable range.
    """
    margin = MARGIN * (capabilities.curvature_max - capabilities.curvature_min)
    low, high = capabilities.curvature_min + margin, capabilities.curvature_max - margin
    if goal.curvature_min != 0 or goal.curvature_max != 0:
        wanted = (goal.curvature_min, goal.curvature_max)
        if not (low - margin <= wanted[0] < wanted[1] <= high + margin):
            raise Refusal(
                ErrorCode.OUT_OF_RANGE,
                f"curvature_min, curvature_max = {wanted[0]:+.4f}, {wanted[1]:+.4f} 1/m: must be a rising range "
                f"inside {range_text(low - margin, high + margin, '1/m')}, or both 0",
            )
        low, high = max(wanted[0], low), min(wanted[1], high)
    if not low < high:
        raise Refusal(ErrorCode.OUT_OF_RANGE, f"range of curvatures = {low} to {high} 1/m: must be finite and rising")
    return low, high


class ProbeAction(ABC):
    """An action that uses the probe, served in worker threads; a new goal pre-empts the running one.

    Args:
        node: hosts the action.
        probe: moves and measures.
        values: parameters of the node.
        optics: returns the present optics, which convert curvatures to distances.
        publish: (phase, sample): publishes an image that counted.
    """

    #: Type and name of the action, and the allowed values of the fields of its goal.
    action_type: Any
    name: str
    fields: Fields

    def __init__(
        self,
        node: Node,
        probe: FocusProbe,
        values: Mapping[str, Any],
        optics: Callable[[], FocusOptics],
        publish: Callable[[Phase, SharpnessSample], None],
    ) -> None:
        self._log = node.get_logger()
        self._probe = probe
        self._values = values
        self._optics = optics
        self._publish = publish
        self._server = WorkerActionServer(
            node, self.action_type, self.name, self._run, exclusive="preempt", fields=self.fields, admit=self._admit
        )

    @abstractmethod
    def _plan(self, goal: Any) -> Any:
        """Make the plan of a goal. Raises Refusal."""

    @abstractmethod
    def _carry_out(self, goal_handle: WorkerGoal, plan: Any, result: Any) -> None:
        """Carry out the plan and fill the result with its message. Raises Refusal; ValueError for unusable images."""

    def _admit(self, goal: Any) -> None:
        """Raise Refusal for a goal that cannot be carried out, before it pre-empts the running one."""
        if self._probe.capabilities is None:
            return  # `_run` waits for them
        try:
            self._plan(goal)
        except EXPECTED as error:
            self._log.warning(f"goal refused: {error}")
            raise Refusal(error_code(error), str(error)) from error

    def _run(self, goal_handle: WorkerGoal) -> tuple[str, Any]:
        started = time.monotonic()
        result = fill_with_nan(self.action_type.Result())  # until they are known
        outcome = "succeed"

        def check() -> None:
            if goal_handle.is_cancel_requested:
                raise Refusal(ErrorCode.CANCELED, "canceled; the mirror holds the shape it has")
            if self._server.preempted(goal_handle):
                raise Refusal(ErrorCode.PREEMPTED, "a newer goal took over")

        try:
            self._probe.await_capabilities(START_GRACE_S, check)
            plan = self._plan(goal_handle.request)
            with self._probe.held(goal_handle.request, self.name, check):
                try:
                    self._carry_out(goal_handle, plan, result)
                finally:
                    result.images, result.images_dropped = self._probe.counted, self._probe.dropped
        except EXPECTED as error:
            result.error_code, result.message = error_code(error), str(error)
            outcome = "canceled" if result.error_code == ErrorCode.CANCELED else "abort"
        if problem := self._probe.several_cameras():
            result.message += f"; {problem}"
        result.duration = time.monotonic() - started
        return outcome, result
