"""What the actions `converge` and `build_recipes` work with: a host, and a mirror that is not as calibrated."""

from __future__ import annotations

import numpy as np
from dm_msgs.msg import Calibration, FocusRequest, MirrorInfo
from rclpy.node import Node

from calibration_stand_in import StandIn
from dm_common.errors import ErrorCode, Refusal
from dm_common.hysteresis.model import HysteresisState
from dm_common.messages import doubles
from dm_common.ros.parameters import declare
from dm_controller.focus_parameters import LOOP_PARAMETERS, REACHABLE_TOLERANCE
from dm_controller.loop_actions import LoopHost, serve_loops
from dm_controller.planning.active_calibration import ActiveCalibration, active_calibration
from dm_controller.planning.target import FocusTarget
from linear_mirror import RADIUS, LinearMirror, hexagon, make_mirror

X, Y = hexagon()
#: The mirror answers more weakly than its calibration says.
GAIN = 0.85


def bench(node: Node) -> StandIn:
    """Driver and interferometer as services on the observer's node."""
    return StandIn(node, make_mirror(), LinearMirror(X, Y, gains=np.full(37, GAIN)))


def calibration() -> Calibration:
    mirror = LinearMirror(X, Y)
    points = mirror.points
    return Calibration(
        id="known",
        aperture_radius=RADIUS,
        actuators=37,
        terms=21,
        points=len(points),
        maps_used=100,
        influence_zernike=doubles(mirror.fit_terms(mirror.influence.T).T.ravel()),
        zernike_offset=doubles(mirror.figure_coefficients),
        sample_x=doubles(points.x),
        sample_y=doubles(points.y),
        sample_weight=doubles(points.weight),
        influence_sag=doubles(mirror.influence.ravel()),
        sag_offset=doubles(mirror.modes @ mirror.figure_coefficients),
        in_sample_rms=1e-10,
        held_out_rms=1e-10,
        held_out_max_zernike=1e-10,
    )


def mirror_info() -> MirrorInfo:
    pairs = make_mirror().limits.pairs
    return MirrorInfo(
        actuators=37,
        actuator_x=doubles(X),
        actuator_y=doubles(Y),
        signal_min=-1.0,
        signal_max=1.0,
        neighbour_a=[int(a) for a, _b in pairs],
        neighbour_b=[int(b) for _a, b in pairs],
        neighbour_difference_max=2.0,
        working_aperture_diameter=2.0 * RADIUS,
    )


class Host(Node, LoopHost):
    """What the focus controller does to host the action."""

    def __init__(self) -> None:
        Node.__init__(self, "converge_host")
        self.refuse = False
        self.calibration: Calibration | None = calibration()
        self.values = declare(self, (*LOOP_PARAMETERS, REACHABLE_TOLERANCE))
        self.actions = serve_loops(self, self.values, self)

    def target(self, wanted: FocusRequest) -> FocusTarget:
        if self.refuse:
            raise Refusal(ErrorCode.STALE, "header.stamp: the request is 9 s old")
        return FocusTarget(wanted.curvature, wanted.conic_constant, tuple(wanted.zernike))

    def active_calibration(self) -> ActiveCalibration:
        return active_calibration(self.calibration, mirror_info(), 0.01)

    def hysteresis(self) -> HysteresisState | None:
        return None
