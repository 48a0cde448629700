"""What `dm demo --camera` has the camera do: searches, a focus stack, tracking; and the images of it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dm_tools.output import console, progress_bar
from dm_tools.verbs.up import DISTANCES

if TYPE_CHECKING:  # slow to import, and `dm --help` does not need it
    from dm_autofocus import CameraFocusClient

#: How fast the nearest object comes nearer [m/s] until it is so far away [m].
SPEED, NEAREST = 0.7, 4.5
#: Time for the mirror to settle before an image is looked at, s.
SETTLE_S = 0.3


@dataclass(frozen=True)
class Shot:
    """One counted image: grey levels (H, W), curvature [1/m] and sharpness."""

    image: NDArray[np.uint8]
    curvature: float
    sharpness: float


@dataclass
class Focused:
    """The search on one object.

    Attributes:
        distance: true distance of the object [m].
        region: left, top, width, height as shares of the image.
        result: what the action answered.
        shots: counted images in order.
        final: the image after the search.
        by_distance: sharpness after `set_focus_distance` with the true distance, without looking.
    """

    distance: float
    region: tuple[float, float, float, float]
    result: Any = None
    shots: list[Shot] = field(default_factory=list)
    final: Shot | None = None
    by_distance: float = math.nan


@dataclass
class Approach:
    """Tracking of the first object while it comes nearer.

    Attributes:
        shots: counted images.
        distances: true ones of the object when each came [m].
    """

    shots: list[Shot] = field(default_factory=list)
    distances: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Sweep:
    """A focus stack.

    Attributes:
        shots: its images, in order of the curvature.
        sharp: image that is sharp everywhere (H, W).
        depth: distances (H, W) [m].
        seconds: that it took.
    """

    shots: list[Shot]
    sharp: NDArray[np.uint8]
    depth: NDArray[np.float32]
    seconds: float


class Recorder:
    """Keeps the images that counted, with what `autofocus_state` says of them."""

    def __init__(self, client: CameraFocusClient) -> None:
        from dm_msgs.msg import AutofocusState
        from sensor_msgs.msg import Image

        from dm_common.ros import qos

        self._images: dict[tuple[int, int], Any] = {}
        self.shots: list[Shot] = []
        self.newest: Any = None
        self.count = 0
        client.node.create_subscription(Image, "image_raw", self._on_image, qos.MAP)
        client.node.create_subscription(AutofocusState, "autofocus_state", self._on_state, qos.STATE)

    def _on_image(self, message: Any) -> None:
        self.newest = message
        self.count += 1
        self._images[message.header.stamp.sec, message.header.stamp.nanosec] = message
        for old in list(self._images)[:-60]:
            del self._images[old]

    def _on_state(self, state: Any) -> None:
        from dm_autofocus.images import grey

        message = self._images.get((state.header.stamp.sec, state.header.stamp.nanosec))
        if message is not None and state.phase != state.PHASE_IDLE:
            self.shots.append(Shot(grey(message).copy(), state.curvature, state.sharpness))


def image_now(client: CameraFocusClient, recorder: Recorder) -> NDArray[np.uint8]:
    """The second image from now: its exposure began after this call."""
    from dm_autofocus.images import grey

    before = recorder.count
    if not client.wait(lambda: recorder.count >= before + 2, 5.0):
        raise RuntimeError("no images came on image_raw within 5 s")
    return grey(recorder.newest).copy()


def focus_on(client: CameraFocusClient, recorder: Recorder, item: Focused) -> None:
    """Search on one object, then focus it by its distance alone for comparison."""
    from dm_autofocus.sharpness import cut, tenengrad

    recorder.shots.clear()
    with progress_bar() as progress:
        task = progress.add_task(f"object at {item.distance:g} m", total=None)
        item.result = client.autofocus(
            item.region, on_feedback=lambda f: progress.update(task, total=f.steps, completed=f.step)
        )
        progress.update(task, total=item.result.images, completed=item.result.images)
    time.sleep(SETTLE_S)
    image = image_now(client, recorder)
    item.shots = list(recorder.shots)
    item.final = Shot(image, item.result.curvature, tenengrad(cut(image, item.region)))
    client.focus_distance(item.distance)
    time.sleep(SETTLE_S)
    item.by_distance = tenengrad(cut(image_now(client, recorder), item.region))


def follow(client: CameraFocusClient, recorder: Recorder, region: tuple[float, float, float, float]) -> Approach:
    """Stay on the first object while it comes nearer."""
    from dm_msgs.msg import AutofocusState
    from rclpy.parameter import Parameter
    from rclpy.parameter_client import AsyncParameterClient

    bench, begun, approach = AsyncParameterClient(client.node, "virtual_bench"), math.nan, Approach()
    recorder.shots.clear()

    def move(feedback: Any) -> None:
        nonlocal begun
        if feedback.phase != AutofocusState.PHASE_TRACK:
            return
        now = time.monotonic()
        begun = now if math.isnan(begun) else begun
        distance = max(DISTANCES[0] - SPEED * (now - begun), NEAREST)
        if recorder.shots and distance > NEAREST:
            approach.shots.append(recorder.shots[-1])
            approach.distances.append(distance)
        bench.set_parameters([Parameter("camera.distances", value=[distance, *DISTANCES[1:]])])

    with console.status(f"the nearest object comes nearer by {SPEED:g} m/s"):
        client.track((DISTANCES[0] - NEAREST) / SPEED, region, on_feedback=move)
        bench.set_parameters([Parameter("camera.distances", value=list(DISTANCES))])
        time.sleep(SETTLE_S)
    return approach


def sweep_of(client: CameraFocusClient, recorder: Recorder) -> Sweep:
    """A focus stack and its images."""
    recorder.shots.clear()
    with console.status("a focus stack"):
        result, sharp, depth = client.focus_stack()
    shots = sorted(recorder.shots, key=lambda shot: shot.curvature)
    return Sweep(shots, sharp[..., 0], depth, result.duration)
