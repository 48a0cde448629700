"""A vision node beside the mirror: distances of what it detects in, focus requests out. See docs/camera.md."""

from __future__ import annotations

import rclpy
from dm_msgs.msg import FocusRequest, FocusState
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Range

from dm_autofocus.optics import FocusOptics, OpticsError, dioptre_of
from dm_common.ros import qos


class VisionNode(Node):
    """Focuses on the latest `object_distance`, without waiting for anything."""

    def __init__(self) -> None:
        super().__init__("vision")
        rest_distance = self.declare_parameter("rest_distance", 10.0).value  # m, in focus while the mirror is flat
        self._optics = FocusOptics.from_rest_distance(rest_distance)
        self._request = self.create_publisher(FocusRequest, "focus_request", qos.COMMAND)
        self.create_subscription(Range, "object_distance", self._on_distance, qos_profile_sensor_data)
        self.create_subscription(FocusState, "focus_state", self._on_state, qos.STATE)

    def _on_distance(self, seen: Range) -> None:
        try:
            curvature = self._optics.curvature_for(dioptre_of(seen.range))
        except OpticsError as error:  # a detection that is no distance
            self.get_logger().warning(str(error), throttle_duration_sec=1.0)
            return
        request = FocusRequest(curvature=curvature)
        request.header.stamp = seen.header.stamp  # a request that is too old is refused
        self._request.publish(request)

    def _on_state(self, state: FocusState) -> None:
        if state.error_code:
            self.get_logger().warning(f"refused: {state.message}", throttle_duration_sec=1.0)
            return
        # Images stamped from then on show this focus.
        arrival = state.header.stamp.sec + 1e-9 * state.header.stamp.nanosec + state.predicted_duration
        self.get_logger().info(f"{self._optics.dioptre_for(state.curvature):+.4f} dioptre from {arrival:.3f} s on")


if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(VisionNode())
    except (OpticsError, InvalidParameterTypeException) as error:  # a parameter that is no distance, or of another type
        raise SystemExit(f"vision: {error}") from None
    except (KeyboardInterrupt, ExternalShutdownException):  # Ctrl-C, or whoever started it ends it
        pass
