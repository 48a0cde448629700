"""What `dm demo --camera` has the camera do: searches, a focus stack, tracking; and the images taken meanwhile."""

import math
import time
from collections import deque
from typing import Any, NamedTuple

import numpy as np
from dm_msgs.msg import AutofocusState
from numpy.typing import NDArray
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import Image

from dm_autofocus import CameraFocusClient
from dm_autofocus.images import grey
from dm_autofocus.sharpness import Region, cut, tenengrad
from dm_common.ros import qos
from dm_tools.output import console, progress_bar
from dm_tools.verbs.up import DISTANCES

#: Speed at which the nearest object approaches [m/s], and the distance at which it stops [m].
SPEED, NEAREST = 0.7, 4.5
#: Time for the mirror to settle before an image is taken, s.
SETTLE_S = 0.3
#: Number of images kept until `autofocus_state` reports on them.
WAITING = 60


class Shot(NamedTuple):
    """One image that the autofocus evaluated: grey levels (H, W), curvature [1/m] and sharpness."""

    image: NDArray[np.uint8]
    curvature: float
    sharpness: float


class Focused(NamedTuple):
    """The search on one object.

    Attributes:
        distance: true distance of the object [m].
        result: what the action answered.
        shots: evaluated images in order.
        final: the image after the search.
        by_distance: sharpness after `set_focus_distance` with the true distance, without a search.
    """

    distance: float
    region: Region
    result: Any
    shots: list[Shot]
    final: Shot
    by_distance: float = math.nan


class Approach(NamedTuple):
    """Tracking of the first object while it approaches: evaluated images, and its true distance at each [m]."""

    shots: list[Shot]
    distances: list[float]


class Sweep(NamedTuple):
    """A focus stack.

    Attributes:
        shots: its images, in order of curvature.
        sharp: image that is sharp everywhere (H, W).
        depth: distances (H, W) [m].
        seconds: duration [s].
    """

    shots: list[Shot]
    sharp: NDArray[np.uint8]
    depth: NDArray[np.float32]
    seconds: float


class Recorder:
    """Keeps the images that the autofocus evaluated, with the curvature and sharpness from `autofocus_state`."""

    def __init__(self, client: CameraFocusClient) -> None:
        self._client = client
        self._images: deque[Any] = deque(maxlen=WAITING)
        self._count = 0
        self.shots: list[Shot] = []
        client.node.create_subscription(Image, "image_raw", self._on_image, qos.MAP)
        client.node.create_subscription(AutofocusState, "autofocus_state", self._on_state, qos.STATE)

    def _on_image(self, image: Any) -> None:
        self._images.append(image)
        self._count += 1

    def _on_state(self, state: Any) -> None:
        if state.phase != state.PHASE_IDLE:
            counted = [image for image in self._images if image.header.stamp == state.header.stamp]
            self.shots += [Shot(grey(image).copy(), state.curvature, state.sharpness) for image in counted]

    def image_now(self) -> NDArray[np.uint8]:
        """The second image from now: its exposure began after this call."""
        before = self._count
        if not self._client.wait(lambda: self._count >= before + 2, 5.0):
            raise RuntimeError("no images came on image_raw within 5 s")
        return grey(self._images[-1]).copy()


def focus_on(client: CameraFocusClient, recorder: Recorder, distance: float, region: Region) -> Focused:
    """Search on the object at `distance` [m], then focus it by its distance alone for comparison."""
    recorder.shots.clear()
    with progress_bar() as progress:
        task = progress.add_task(f"object at {distance:g} m", total=None)
        result = client.autofocus(region, on_feedback=lambda f: progress.update(task, total=f.steps, completed=f.step))
        progress.update(task, total=result.images, completed=result.images)
    time.sleep(SETTLE_S)
    image, shots = recorder.image_now(), list(recorder.shots)
    client.focus_distance(distance)
    time.sleep(SETTLE_S)
    by_distance = tenengrad(cut(recorder.image_now(), region))
    final = Shot(image, result.curvature, tenengrad(cut(image, region)))
    return Focused(distance, region, result, shots, final, by_distance)


def follow(client: CameraFocusClient, recorder: Recorder, region: Region) -> Approach:
    """Stay on the first object while it comes nearer."""
    bench, begun, approach = AsyncParameterClient(client.node, "virtual_bench"), math.nan, Approach([], [])
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
