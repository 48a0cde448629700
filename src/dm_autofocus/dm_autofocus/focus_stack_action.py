"""The action `focus_stack`: a sweep of the focus, an image that is sharp everywhere, and the distance of each pixel."""

import copy
import math
from typing import Any

import numpy as np
from dm_msgs.action import FocusStack
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from dm_autofocus.autofocus_parameters import tolerance_of
from dm_autofocus.focus_stack import FEWEST, ImageStack
from dm_autofocus.images import PLANAR, exposure_fault, grey, image_message, pixels_of
from dm_autofocus.probe_action import GOAL_FIELDS, ProbeAction, range_of, ready_capabilities
from dm_autofocus.search.peak_search import NOISE_POINTS, Phase
from dm_autofocus.sharpness import WHOLE
from dm_common import Floats
from dm_common.errors import ErrorCode, Refusal
from dm_common.ros import qos
from dm_common.ros.worker import WorkerGoal
from dm_common.values import Fields, whole

#: Most images of a stack.
MOST = 1000
#: Percentiles of the distances in the result.
NEAR, FAR = 5, 95


class FocusStackAction(ProbeAction):
    """Serves `focus_stack`, and publishes its results."""

    action_type, name = FocusStack, "focus_stack"
    fields = Fields(GOAL_FIELDS | {"images": whole(0, 0, MOST)})

    def __init__(self, node: Node, *shared: Any) -> None:
        super().__init__(node, *shared)
        self._image = node.create_publisher(Image, "focus_stack/image", qos.LATCHED)
        self._depth = node.create_publisher(Image, "focus_stack/depth", qos.LATCHED)
        self._info = node.create_publisher(CameraInfo, "focus_stack/camera_info", qos.LATCHED)

    def _plan(self, goal: Any) -> Floats:
        """Curvatures of the images, in rising order, so that unknown hysteresis stays on one branch."""
        capabilities = ready_capabilities(self._probe)
        low, high = range_of(goal, capabilities)
        if 0 < goal.images < FEWEST:
            raise Refusal(ErrorCode.OUT_OF_RANGE, f"images = {goal.images}: must be {FEWEST} to {MOST}, or 0")
        step = self._values["stack.step"] * tolerance_of(self._values, capabilities.aperture_radius)
        return np.linspace(low, high, goal.images or min(max(NOISE_POINTS, 1 + math.ceil((high - low) / step)), MOST))

    def _carry_out(self, goal_handle: WorkerGoal, plan: Floats, result: Any) -> None:
        before = self._probe.shape
        stack, image = self._sweep(goal_handle, plan)
        if math.isfinite(before[0]):
            self._probe.move(*before)
        try:
            places = stack.in_focus(self._values["search.least_contrast"])
        except ValueError as error:
            raise Refusal(ErrorCode.UNREACHABLE, f"the mirror reaches too little of the range: {error}") from error
        depth = stack.enlarge(self._optics().distances_for(places).astype(np.float32))
        seen = depth[depth > 0]
        if not seen.size:
            fault = exposure_fault(grey(image))
            reason = "focus changes nothing in the image: no texture in it"
            if np.isneginf(depth).any():
                reason = "all that has texture in the image is nearer than the range reaches"
            raise Refusal(ErrorCode.NOT_CONVERGED, f"{reason}; {fault}" if fault else reason)
        self._publish_stack(image, stack.image, depth)
        result.share = seen.size / depth.size
        near, far = np.percentile(seen, (NEAR, FAR), method="nearest")
        result.distance_near, result.distance_far, result.stamp = float(near), float(far), image.header.stamp
        result.message = f"{len(stack.positions)} images, {100 * result.share:.0f} % of the pixels have a distance"

    def _sweep(self, goal_handle: WorkerGoal, plan: Floats) -> tuple[ImageStack, Image]:
        """The stack and its last image. Curvatures that the mirror refuses at the ends of the range are left out."""
        stack = ImageStack(self._values["stack.cell"])
        image = Image()
        for curvature in plan:
            try:
                self._probe.move(float(curvature))
            except Refusal as error:
                if error.error_code != ErrorCode.UNREACHABLE:
                    raise
                if stack.positions:
                    break
                continue
            sample = self._probe.measure(WHOLE)
            before, image = image, sample.image
            if stack.positions and (image.encoding, image.is_bigendian) != (before.encoding, before.is_bigendian):
                raise ValueError(f"the images changed their encoding from {before.encoding} to {image.encoding}")
            if len({region.shape for region in sample.regions}) > 1:
                raise ValueError("the images changed their size")
            stack.add(float(curvature), np.mean(sample.regions, axis=0), pixels_of(image))
            self._publish(Phase.STACK, sample)
            goal_handle.publish_feedback(
                FocusStack.Feedback(step=len(stack.positions), steps=len(plan), curvature=float(curvature))
            )
        return stack, image

    def _publish_stack(self, last: Image, pixels: NDArray, depth: NDArray[np.float32]) -> None:
        """Publish the images with the header of the last one, as depth_image_proc requires."""
        self._info.publish(camera_info_for(last, self._probe.camera_info, self._values["optics.focal_length_px"]))
        encoding = "mono8" if last.encoding in PLANAR else last.encoding
        self._image.publish(image_message(last.header, pixels, encoding, last.is_bigendian))
        self._depth.publish(image_message(last.header, depth, "32FC1"))


def camera_info_for(image: Image, known: CameraInfo | None, focal_length_px: float) -> CameraInfo:
    """The CameraInfo of the camera, completed with a projection, by which depths are converted to points.

    Args:
        image: the image that it belongs to.
        known: what the camera published; None = nothing.
        focal_length_px: focal length of the image as received [px], used if the camera gives none; 0 = not known.
    """
    info = CameraInfo(height=image.height, width=image.width)
    if known is not None and (np.any(known.k) or not focal_length_px > 0):
        info = copy.deepcopy(known)
    info.header = image.header
    if not np.any(info.k) and focal_length_px > 0:
        centre = (image.width - 1) / 2, (image.height - 1) / 2
        info.k = [focal_length_px, 0.0, centre[0], 0.0, focal_length_px, centre[1], 0.0, 0.0, 1.0]
    if not np.any(info.r):
        info.r = np.eye(3).ravel()
    if not np.any(info.p):
        info.p = np.pad(np.reshape(info.k, (3, 3)), [(0, 0), (0, 1)]).ravel()
    return info
