"""What `autofocus` does at one curvature: move the focus there and measure the sharpness of the images."""

import math
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from dm_msgs.msg import ActuatorState, Capabilities, FocusRequest, FocusState
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from dm_autofocus.images import STAMP_AHEAD, STAMP_AHEAD_SIMULATED, SettledGate, grey, raw_image
from dm_autofocus.sharpness import METRICS, Region, cut
from dm_common.errors import ErrorCode, Refusal
from dm_common.limits import same_signals
from dm_common.messages import seconds
from dm_common.ros import qos
from dm_common.ros.clients import MirrorHolder, ServiceCallError

#: Profile that cameras publish with; depth 1: an image that was not fetched in time is replaced by the next.
IMAGES = QoSProfile(depth=1, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)

#: Most unusable images in a row, as when a few bytes are lost, that do not end an action.
DAMAGED_MAX = 2


@dataclass(frozen=True)
class SharpnessSample:
    """Sharpness of an image, its message and region (H, W); of several: the median, the last message, all regions."""

    sharpness: float
    image: Image
    regions: tuple[NDArray, ...]


class FocusProbe:
    """Moves by `focus_request` and measures on `image_raw`. Both block, so they belong in a worker thread.

    Args:
        node: hosts the topics.
        values: parameters `image_transport`, `metric`, `images_per_step`, `image_timeout`, `move_timeout`,
            `settle_time`, `stamp_lead`.

    Attributes:
        controller: whether the focus controller is present.
        capabilities: the latest of the controller; None before the first.
        shape: the last that the driver took: curvature [1/m] (NaN = none yet), conic constant, terms [m].
        user: action that holds the mirror; "" = none does.
        target: curvature that `move` requested last [1/m]; NaN while nobody holds the mirror.
        topic: of the images.
        newest: the latest image as received; None before the first.
        camera_info: the latest; None before the first.
        answer: of the controller to the latest `move`; None before it.
        counted, dropped: number of images used and not used since the mirror was held.
    """

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._values = values
        self._changed = threading.Condition()
        self._gate = SettledGate(values["settle_time"], values["stamp_lead"])
        self.controller = qos.watch(node, "focus_controller", Capabilities, "capabilities", qos.LATCHED)
        self.capabilities: Capabilities | None = None
        self.shape: tuple[float, float, Sequence[float]] = (math.nan, 0.0, ())
        self.newest: Image | CompressedImage | None = None
        self.camera_info: CameraInfo | None = None
        self.counted = self.dropped = 0
        self._driver: ActuatorState | None = None
        self.answer: FocusState | None = None
        self.user = ""
        self._check: Callable[[], None] = lambda: None  # raises Refusal if the user is to stop
        self.target = math.nan
        self._requested: deque[float] = deque(maxlen=8)  # own requests: a late answer to one is no other node's
        self._other_request: float | None = None  # curvature requested by another node while held [1/m]
        self._degauss_s = 0.0  # duration of a degauss that the latest move waits for
        self._measuring, self._apart = False, 0.0  # _apart: time between the stamps of the latest two images [s]
        self._arrived = math.inf  # when the latest came [s]
        self._fresh: Image | CompressedImage | None = None
        self._now = lambda: seconds(node.get_clock().now().to_msg())
        self._request = node.create_publisher(FocusRequest, "focus_request", qos.COMMAND)
        self._hold = MirrorHolder(node, node.get_name())
        self._node, self.topic = node, ""
        self._images: Any = None
        node.create_subscription(CameraInfo, "camera_info", partial(setattr, self, "camera_info"), IMAGES)
        node.create_subscription(FocusState, "focus_state", self._on_focus_state, qos.STATE)
        node.create_subscription(ActuatorState, "actuator_state", self._on_actuator_state, qos.STATE)
        node.create_subscription(Capabilities, "capabilities", partial(setattr, self, "capabilities"), qos.LATCHED)

    def subscribe(self) -> None:
        """Subscribe to images by the present value of `image_transport`."""
        compressed = self._values["image_transport"] == "compressed"
        # The name follows a remapping of image_raw, as with image_transport.
        topic = self._node.resolve_topic_name("image_raw") + ("/compressed" if compressed else "")
        if topic == self.topic:
            return
        if self._images is not None:
            self._node.destroy_subscription(self._images)
        kind = CompressedImage if compressed else Image
        self._images = self._node.create_subscription(kind, topic, self._on_image, IMAGES)
        self.topic, self.newest = topic, None

    # --- messages ---

    def _on_image(self, message: Image | CompressedImage) -> None:
        with self._changed:
            before, self.newest, self._arrived = self.newest, message, self._now()
            self._apart = seconds(message.header.stamp) - seconds(before.header.stamp) if before is not None else 0.0
            if not (self._measuring and self._gate.open_for(seconds(message.header.stamp), self._arrived)):
                self.dropped += 1
                return
            self.dropped += self._fresh is not None
            self._fresh = message
            self._changed.notify_all()

    def _on_focus_state(self, message: FocusState) -> None:
        with self._changed:
            if message.applied:
                self.shape = (message.curvature, message.conic_constant, message.zernike)
            if math.isnan(self.target):
                return
            if message.curvature == self.target:
                answered = message.applied or message.error_code != ErrorCode.OK  # otherwise a degauss runs first
                self._degauss_s = 0.0 if answered else message.predicted_duration
                if answered:
                    self.answer = self.answer or message
            elif message.applied and message.curvature not in self._requested:
                self._other_request = message.curvature
            self._changed.notify_all()

    def _on_actuator_state(self, message: ActuatorState) -> None:
        with self._changed:
            self._driver = message
            self._update_gate()
            self._changed.notify_all()

    def _update_gate(self) -> None:
        answer, driver = self.answer, self._driver
        if answer is None or driver is None or not answer.applied:
            return
        reached = same_signals(driver.requested, np.asarray(answer.signals))
        self._gate.written(seconds(driver.header.stamp), driver.moving, reached)

    # --- moving and measuring ---

    def busy(self) -> Refusal:
        """The refusal of others that would move the mirror while an action of this node holds it."""
        return Refusal(ErrorCode.BUSY, f"the action {self.user} is running; cancel it first, or take the mirror over")

    @contextmanager
    def held(self, request: Any, action: str, check: Callable[[], None]) -> Iterator[None]:
        """Hold the mirror for one action of this node during the block, here and at the driver.

        Args:
            request: the goal of the action, see `MirrorHolder.held`.
            action: its name.
            check: raises Refusal if the action is to stop; called while `move` and `measure` wait.

        Raises:
            Refusal: another action or somebody else has it, or there is no driver.
        """

        def free() -> bool:
            with self._changed:
                if self.user:
                    return False
                self.user = action
                return True

        self._hold.wait_for(free, request, str(self.busy()), self._values["move_timeout"])
        self._other_request, self.counted, self.dropped = None, 0, 0
        self._check = check
        try:
            with self._hold.held(request, f"action {action}; cancel it to end it", 0.0, self._values["move_timeout"]):
                yield
        except ServiceCallError as error:  # from holding the mirror: actions call no service
            raise Refusal(ErrorCode.DRIVER_UNAVAILABLE, str(error)) from error
        finally:
            self.target = math.nan
            self._other_request = None
            self.user = ""

    def move(self, curvature: float, conic_constant: float = 0.0, zernike: Sequence[float] = ()) -> None:
        """Request a curvature [1/m], with terms added [m], and wait until the move has ended.

        Raises:
            Refusal: refused, no answer, another node moves the mirror, the move does not end, or the user is to stop.
        """
        self._wait(lambda: True, 0.0, self._check)  # an action that is to stop must not request another shape
        with self._changed:
            simulated = self._node.get_clock().ros_time_is_active
            ahead = STAMP_AHEAD_SIMULATED if simulated else STAMP_AHEAD
            self._gate = SettledGate(self._values["settle_time"], self._values["stamp_lead"], ahead)
            self.answer, self._degauss_s = None, 0.0
            self.target = curvature
            self._requested.append(curvature)
        mode, holder, lost_reason = FocusRequest.MODE_DIRECT, self._hold.holder, self.controller.since_now()
        shape = {"curvature": curvature, "conic_constant": conic_constant, "zernike": zernike}
        self._request.publish(FocusRequest(**shape, mode=mode, holder=holder))
        limit = self._values["move_timeout"]
        self._wait(lambda: self.answer is not None or bool(lost_reason()), limit, self._check)
        answer = self.answer
        if answer is None:
            text = f"no answer to a focus request within {limit:g} s: is focus_controller running?"
            raise Refusal(ErrorCode.TIMEOUT, lost_reason() or text)
        if not answer.applied:
            raise Refusal(answer.error_code, answer.message)
        with self._changed:
            self._gate.sent(seconds(answer.header.stamp), answer.predicted_duration)
            self._update_gate()
        if not self._wait(lambda: math.isfinite(self._gate.settled_at), limit, self._check):
            reason = self._driver.message if self._driver is not None else "no actuator_state from pdm_driver"
            raise Refusal(ErrorCode.TIMEOUT, f"the move did not end within {limit:g} s: {reason}")

    def measure(self, region: Region) -> SharpnessSample:
        """Median sharpness of the next images that show the settled shape.

        Raises:
            Refusal: no such image came in time, it cannot be used, or the user is to stop.
        """
        samples, damaged, unusable, limit = list[SharpnessSample](), 0, "", self._values["image_timeout"]
        with self._changed:
            self._fresh, self._measuring = None, True
        try:
            while len(samples) < self._values["images_per_step"]:
                before = self.newest
                self._wait(lambda: self._fresh is not None, limit, self._check)
                with self._changed:
                    message, self._fresh = self._fresh, None
                if message is None:
                    newest = None if self.newest is None or self.newest is before else seconds(self.newest.header.stamp)
                    reason = self._gate.reason(newest, self._apart, limit, self._arrived)
                    if self._node.count_publishers(self.topic) == 0:
                        reason = "nobody publishes there; is the camera running, and is this its topic?"
                    text = f"no image of the settled focus on {self.topic} within image_timeout = {limit:g} s: {reason}"
                    raise Refusal(ErrorCode.TIMEOUT, text + unusable)
                try:
                    samples.append(self.sharpness_of(message, region))
                    damaged, unusable, self.counted = 0, "", self.counted + 1
                except Refusal as error:
                    damaged, unusable, self.dropped = damaged + 1, f"; the last one: {error}", self.dropped + 1
                    if damaged > DAMAGED_MAX:
                        raise
        finally:
            self._measuring = False
        sharpness = statistics.median(sample.sharpness for sample in samples)
        return SharpnessSample(sharpness, samples[-1].image, tuple(sample.regions[0] for sample in samples))

    def sharpness_of(self, message: Image | CompressedImage, region: Region) -> SharpnessSample:
        """Sharpness of an image in a region. Raises Refusal if the image cannot be used."""
        try:
            image = raw_image(message)
            part = cut(grey(image), region)
            sharpness = METRICS[self._values["metric"]](part)
        except ValueError as error:
            raise Refusal(ErrorCode.INVALID_ARGUMENT, f"{self.topic}: {error}") from error
        return SharpnessSample(sharpness, image, (part,))

    def several_cameras(self) -> str:
        """A sentence if the topic of the images has several publishers; "" = it has not."""
        count = self._node.count_publishers(self.topic)
        return f"{self.topic} has {count} publishers, and images of all count: one camera only" if count > 1 else ""

    def await_capabilities(self, timeout_s: float, check: Callable[[], None]) -> None:
        """Wait for the first capabilities, at most `timeout_s`. Raises what `check` raises meanwhile."""
        self._wait(lambda: self.capabilities is not None, timeout_s, check)

    def _wait(self, condition: Callable[[], bool], timeout_s: float, check: Callable[[], None]) -> bool:
        """Wait for a condition; False on time-out. Raises Refusal as `check`, or if another node moves the mirror."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while True:
                check()
                if self.user and self._hold.lost is not None:
                    raise self._hold.lost
                if condition():
                    return True
                if self._other_request is not None:
                    raise Refusal(
                        ErrorCode.PREEMPTED,
                        f"another node asked for a curvature of {self._other_request:+.4f} 1/m meanwhile",
                    )
                if time.monotonic() > deadline + self._degauss_s:
                    return False
                self._changed.wait(0.05)  # poll: `check` cannot notify
