"""Node `focus_controller`: curvature requests in, actuator commands out, with the prediction of what they will do.

Translates messages, parameters and time; what happens is decided in `dm_controller.focus_controller`.
"""

from __future__ import annotations

import sys
from typing import Any

from dm_msgs.msg import ActuatorState, Calibration, FocusRequest, MirrorInfo
from dm_msgs.srv import Flatten, SetFocus
from rclpy.node import Node

from dm_common.ros import diagnostics, qos
from dm_common.ros.executor import run_node
from dm_common.ros.parameters import declare
from dm_common.ros.worker import never_silent
from dm_controller.focus_actions import MoveFocusAction, serve_loops
from dm_controller.focus_host import FocusHost
from dm_controller.focus_parameters import PARAMETERS


class FocusControllerNode(Node):
    """See README for the interfaces."""

    def __init__(self, **keywords: Any) -> None:
        super().__init__("focus_controller", **keywords)
        values = declare(self, PARAMETERS, on_change=lambda _changes: self._host.publish_capabilities())
        self._host = host = FocusHost(self, values)
        self._mirror: MirrorInfo | None = None
        self._calibration: Calibration | None = None
        self._diagnostics = diagnostics.Diagnostics(self, "", host.health)
        self._actions = MoveFocusAction(self, host, values["settle_time"]), *serve_loops(self, values, host)
        self.create_subscription(MirrorInfo, "mirror_info", self._on_mirror_info, qos.LATCHED)
        self.create_subscription(Calibration, "calibration", self._on_calibration, qos.LATCHED)
        self.create_subscription(ActuatorState, "actuator_state", host.driver_report, qos.STATE)
        self.create_subscription(FocusRequest, "focus_request", self._on_focus_request, qos.COMMAND)
        for kind, name, answer in ((SetFocus, "set_focus", self._on_set_focus), (Flatten, "flatten", self._on_flatten)):
            self.create_service(kind, name, never_silent(self, name, answer), qos_profile=qos.SERVICE)
        host.publish_capabilities()

    def _on_mirror_info(self, message: MirrorInfo) -> None:
        self._mirror, self._diagnostics.hardware_id = message, message.serial
        self._host.use(self._calibration, self._mirror)

    def _on_calibration(self, message: Calibration) -> None:
        self._calibration = message
        self._host.use(self._calibration, self._mirror)

    def _on_focus_request(self, message: FocusRequest) -> None:
        self._host.order(message)

    def _on_set_focus(self, request: SetFocus.Request, response: SetFocus.Response) -> SetFocus.Response:
        return self._answer(request.request, request.dry_run, response)

    def _on_flatten(self, request: Flatten.Request, response: Flatten.Response) -> Flatten.Response:
        return self._answer(FocusRequest(), request.dry_run, response)

    def _answer(self, request: FocusRequest, dry_run: bool, response: Any) -> Any:
        response.state = self._host.state(self._host.order(request, dry_run))
        response.error_code, response.message = response.state.error_code, response.state.message
        return response


def main() -> int:
    """Entry point of the node."""
    return run_node(FocusControllerNode, sys.argv)


if __name__ == "__main__":
    sys.exit(main())
