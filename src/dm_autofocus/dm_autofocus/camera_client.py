"""A plain Python interface of the camera pipeline: no callbacks, no executors. See docs/camera.md."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Unpack

import numpy as np
from dm_msgs.action import Autofocus, FocusStack
from dm_msgs.msg import AutofocusState
from dm_msgs.srv import GetFocusRange, SetFocusDistance
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, Image

from dm_autofocus.boresight import STEP, Boresight, find_boresight
from dm_autofocus.focus_probe import IMAGES
from dm_autofocus.images import grey, pixels_of, raw_image
from dm_autofocus.sharpness import check_region, cut
from dm_client import Claim, DeformableMirrorClient, DeformableMirrorError
from dm_client.fields import filled
from dm_common import Floats
from dm_common.errors import ErrorCode
from dm_common.messages import seconds as seconds_of
from dm_common.optics.zernike import PISTON_TILT, TERMS
from dm_common.ros import qos

#: Wait after a move before images count [s].
SETTLE_S = 0.05

_OWN: dict[str, Any] = {
    "set_focus_distance": SetFocusDistance,
    "get_focus_range": GetFocusRange,
    "autofocus": Autofocus,
    "focus_stack": FocusStack,
}


class CameraFocusClient(DeformableMirrorClient):
    """A client of one mirror's nodes and of the node `autofocus` beside them, made and used as its base class."""

    watched = {
        **DeformableMirrorClient.watched,
        "autofocus": (AutofocusState, "autofocus_state", qos.STATE, _OWN),
    }

    def focus_range(self) -> GetFocusRange.Response:
        """Range of object distances at which the camera can focus."""
        return self.call("get_focus_range", GetFocusRange.Request())

    def focus_distance(
        self, distance: float, *, dry_run: bool = False, **claim: Unpack[Claim]
    ) -> SetFocusDistance.Response:
        """Focus on an object at `distance` (m; 0 or inf = infinity)."""
        request = filled(SetFocusDistance.Request, distance=distance, dry_run=dry_run, **claim)
        return self.call("set_focus_distance", request)

    def focus_dioptre(
        self, dioptre: float, *, dry_run: bool = False, **claim: Unpack[Claim]
    ) -> SetFocusDistance.Response:
        """Focus on 1 / distance (1/m; 0 = infinity), as libcamera and Android count."""
        request = filled(SetFocusDistance.Request, dioptre=dioptre, dry_run=dry_run, **claim)
        return self.call("set_focus_distance", request)

    def autofocus(
        self,
        region: Sequence[float] = (),
        *,
        curvature_range: tuple[float, float] = (0.0, 0.0),
        on_feedback: Callable[[Any], None] = lambda feedback: None,
        timeout_s: float = 60.0,
        **claim: Unpack[Claim],
    ) -> Autofocus.Result:
        """Search the sharpest focus in a region of the image and stay there.

        Args:
            region: left, top, width, height as shares 0..1 of the image (`sharpness.region_of` makes them of pixels);
                empty = as configured.
            curvature_range: search only here [1/m]; (0, 0) = the whole reachable range.
            on_feedback: called after each image that was used.
            timeout_s: longest time the search may take.
        """
        goal = filled(Autofocus.Goal, region=region, **_ends(curvature_range), **claim)
        return self.run_action("autofocus", goal, on_feedback, timeout_s)

    def track(
        self,
        seconds: float,
        region: Sequence[float] = (),
        *,
        on_feedback: Callable[[Any], None] = lambda feedback: None,
        timeout_s: float = 60.0,
        **claim: Unpack[Claim],
    ) -> None:
        """Search the sharpest focus in a region as `autofocus`, then stay on it for `seconds`."""
        if not (isinstance(seconds, float | int) and seconds >= 0):
            raise DeformableMirrorError(ErrorCode.OUT_OF_RANGE, f"seconds = {seconds!r}: must be a number, 0 or more")
        goal = filled(Autofocus.Goal, region=region, track=True, **claim)
        ends = math.inf

        def follow(feedback: Any) -> None:
            nonlocal ends
            if feedback.phase == AutofocusState.PHASE_TRACK:
                ends = min(ends, time.monotonic() + seconds)
            on_feedback(feedback)

        try:
            self.run_action("autofocus", goal, follow, timeout_s + seconds, lambda: time.monotonic() > ends)
        except DeformableMirrorError:
            if time.monotonic() < ends:
                raise

    def focus_stack(
        self,
        *,
        images: int = 0,
        curvature_range: tuple[float, float] = (0.0, 0.0),
        on_feedback: Callable[[Any], None] = lambda feedback: None,
        timeout_s: float = 60.0,
        **claim: Unpack[Claim],
    ) -> tuple[FocusStack.Result, NDArray, NDArray]:
        """Sweep the focus through the scene.

        Args:
            images: their number; 0 = as many as the depth of focus requires.
            curvature_range: sweep only here [1/m]; (0, 0) = the whole reachable range.
            on_feedback: called after each image.
            timeout_s: longest time the stack may take.

        Returns:
            The result; an image that is sharp everywhere, (H, W, channels) in the camera's encoding; distances [m],
            (H, W): NaN = not known, inf = infinity or beyond the far end of the range, -inf = nearer than its near end.
        """
        goal = filled(FocusStack.Goal, images=images, **_ends(curvature_range), **claim)
        topics = ("focus_stack/image", "focus_stack/depth")
        for topic in topics:
            self.subscribe(topic, Image, qos.LATCHED)
        result = self.run_action("focus_stack", goal, on_feedback, timeout_s)
        image, depth = (pixels_of(self.stamped(topic, result.stamp)) for topic in topics)
        return result, image, depth[..., 0]

    def boresight(
        self,
        region: Sequence[float],
        *,
        pairs: int = 6,
        image_topic: str = "image_raw",
        stamp_lead: float = 0.0,
        **claim: Unpack[Claim],
    ) -> Boresight:
        """Measure how the picture moves with the mirror's tilt and with the focus; ends at the focus of the region.

        Args:
            region: left, top, width, height as shares 0..1 of the image: an object that stands still.
            pairs: number of images on either side of the focus, taken alternately; 2 at least.
            image_topic: of the camera, as in `autofocus`; the same with /compressed appended is used as well.
            stamp_lead: by how much an exposure begins before its image's stamp [s], as in `autofocus`.

        Raises:
            DeformableMirrorError: an argument is invalid, a search or a move failed, or images do not arrive, cannot be
                used or do not follow tilt.
        """
        try:
            part = check_region(region)
            if pairs < 2:
                raise ValueError(f"pairs = {pairs}: must be 2 or more")
        except (TypeError, ValueError) as error:
            raise DeformableMirrorError(ErrorCode.OUT_OF_RANGE, str(error)) from error
        topics = {image_topic: Image, f"{image_topic}/compressed": CompressedImage}
        for topic, kind in topics.items():
            self.subscribe(topic, kind, IMAGES)
        focus = self.autofocus(part, **claim).curvature
        reach = self.focus_range()
        step = STEP * reach.curvature_tolerance
        focus = min(max(focus, reach.curvature_min + 2 * step), reach.curvature_max - 2 * step)

        def see(curvature: float, tilt: Floats) -> NDArray:
            zernike = np.zeros(len(TERMS))
            zernike[1:PISTON_TILT] = tilt
            state = self.focus(curvature, zernike=zernike.tolist(), **claim)
            begin = seconds_of(state.header.stamp) + state.predicted_duration + SETTLE_S + stamp_lead

            def fresh() -> list[Any]:
                received = [self.messages[topic] for topic in topics if topic in self.messages]
                return [image for image in received if seconds_of(image.header.stamp) >= begin]

            if not self.wait(lambda: bool(fresh())):
                raise DeformableMirrorError(
                    ErrorCode.TIMEOUT, f"no image on {image_topic} that was stamped after a move"
                )
            return cut(grey(raw_image(fresh()[0])), part)

        try:
            return find_boresight(see, focus, step, pairs)
        except ValueError as error:  # raised for unusable images as well
            raise DeformableMirrorError(ErrorCode.NOT_CONVERGED, str(error)) from error
        finally:  # remove the deliberate tilt
            self.focus(focus, **claim)


def _ends(curvature_range: tuple[float, float]) -> dict[str, float]:
    try:
        low, high = curvature_range
    except (TypeError, ValueError) as error:
        text = f"curvature_range = {curvature_range!r}: must be two curvatures, from and to"
        raise DeformableMirrorError(ErrorCode.INVALID_ARGUMENT, text) from error
    return {"curvature_min": low, "curvature_max": high}
