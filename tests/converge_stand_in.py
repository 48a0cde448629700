"""What the actions `converge` and `build_recipes` work with: a host, and a mirror that is not as calibrated."""

from __future__ import annotations

import numpy as np
from dm_msgs.msg import Calibration, FocusRequest
from rclpy.node import Node

from calibration_stand_in import StandIn
from dm_common.errors import ErrorCode, Refusal
from dm_common.hysteresis.model import HysteresisState
from dm_common.ros.parameters import declare
from dm_controller.focus_parameters import LOOP_PARAMETERS, REACHABLE_TOLERANCE
from dm_controller.loop_actions import LoopHost, serve_loops
from dm_controller.planning.active_calibration import ActiveCalibration, active_calibration
from dm_controller.planning.target import FocusTarget
from focus_bench import calibration, mirror_info
from linear_mirror import LinearMirror, hexagon, make_mirror

#: The mirror answers more weakly than its calibration says.
GAIN = 0.85


def bench(node: Node) -> StandIn:
    """Driver and interferometer as services on the observer's node."""
    return StandIn(node, make_mirror(), LinearMirror(*hexagon(), gains=np.full(37, GAIN)))


class Host(Node, LoopHost):
    """What the focus controller does to host the action."""

    def __init__(self) -> None:
        Node.__init__(self, "converge_host")
        self.refuse = False
        self.calibration: Calibration | None = calibration(held_out_rms=1e-10, held_out_max_zernike=1e-10)
        self.values = declare(self, (*LOOP_PARAMETERS, REACHABLE_TOLERANCE))
        self.actions = serve_loops(self, self.values, self)

    def target(self, wanted: FocusRequest) -> FocusTarget:
        if self.refuse:
            raise Refusal(ErrorCode.STALE, "header.stamp: the request is 9 s old")
        return FocusTarget(wanted.curvature, wanted.conic_constant, tuple(wanted.zernike))

    def active_calibration(self) -> ActiveCalibration:
        return active_calibration(self.calibration, mirror_info())

    def hysteresis(self) -> HysteresisState | None:
        return None
