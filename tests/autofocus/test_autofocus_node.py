"""Node `autofocus` as a process over DDS; the test plays controller, driver and a camera that blurs with the focus."""

from __future__ import annotations

import array
import io
import math
import os
import re
import runpy
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import defocused_camera
import numpy as np
import pytest
import rclpy
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from dm_msgs.action import Autofocus, FocusStack
from dm_msgs.msg import ActuatorState, AutofocusState, Capabilities, ErrorCode, FocusRequest, FocusState
from dm_msgs.srv import GetFocusRange, HoldMirror, SetFocus, SetFocusDistance
from PIL import Image as PillowImage
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from scipy.ndimage import gaussian_filter
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Range

from dm_autofocus import CameraFocusClient
from dm_autofocus.optics import FocusOptics, depth_of_focus, distance_of
from dm_client import DeformableMirrorError
from dm_common.ros import qos
from dm_common.ros.worker import WorkerService
from dm_tools.recording.bag import BagReader
from dm_tools.recording.player import play
from dm_tools.recording.recorder import Recorder
from documentation import unexplained
from support import NodeProcess, Observer, wait_until

REST_DISTANCE = 10.0
OPTICS = FocusOptics.from_rest_distance(REST_DISTANCE)
LOW, HIGH, RADIUS = -0.05, 0.05, 0.011
#: How long the played mirror moves [s]; its images meanwhile are sharper than any settled one.
MOVE_TIME = 0.03
PARAMETERS = {
    "optics.rest_distance": REST_DISTANCE,
    "region": [0.0, 0.0, 1.0, 1.0],
    "settle_time": 0.0,
    "move_timeout": 3.0,
}


class FilmedScene:
    """Controller, driver and camera. The scene is one textured plane, in focus at `object_curvature`."""

    def __init__(self, observer: Observer, object_curvature: float, rate: float = 100.0) -> None:
        self.node = observer.node
        self.object_curvature = object_curvature
        self.refuse_beyond = HIGH
        self.dead = False
        self.degausses, self.degauss_s = 0, 1.2  # requests that wait for one before they are carried out
        self.requests: list[FocusRequest] = []
        self.asked: list[FocusRequest] = []  # by the service `set_focus`
        self.history_known = False
        self.render: Callable[[float], np.ndarray] | None = None  # a curvature's image, instead of the plane's
        self.stamped = True
        self.encoding = "mono8"
        self.texture = 100 + 40 * np.random.default_rng(5).standard_normal((48, 64))
        self._frames: list[Time] = []
        self._first_settled: list[int] = []  # first image after each move
        self._lock = threading.Lock()
        self._noise = np.random.default_rng(6)
        self._curvature = 0.0
        self._arrival = 0.0
        self._pending: FocusState | None = None
        self.info = self.node.create_publisher(CameraInfo, "camera_info", qos_profile_sensor_data)
        self._image = self.node.create_publisher(Image, "image_raw", qos_profile_sensor_data)
        self.compressed = False
        topic = "camera/image/compressed"
        self._compressed = self.node.create_publisher(CompressedImage, topic, qos_profile_sensor_data)
        self._state = self.node.create_publisher(FocusState, "focus_state", qos.STATE)
        self._driver = self.node.create_publisher(ActuatorState, "actuator_state", qos.STATE)
        self._live()
        self.request = self.node.create_publisher(FocusRequest, "focus_request", qos.COMMAND)
        self.node.create_subscription(FocusRequest, "focus_request", self._on_request, qos.COMMAND)
        WorkerService(self.node, SetFocus, "set_focus", self._on_set_focus)
        self.taken_over = False
        WorkerService(self.node, HoldMirror, "hold_mirror", self._on_hold)
        self.states: list[AutofocusState] = observer.record(AutofocusState, "autofocus_state", qos.STATE)
        self._stop = threading.Event()
        self._camera = threading.Thread(target=self._film, args=(1 / rate,), daemon=True)

    def __enter__(self) -> FilmedScene:
        self.aperture(RADIUS)
        self._camera.start()
        return self

    def _live(self) -> None:
        self._capabilities = self.node.create_publisher(Capabilities, "capabilities", qos.with_lease(qos.LATCHED))

    def die(self) -> None:
        """The controller answers nothing any more."""
        self.dead = True
        self.node.destroy_publisher(self._capabilities)

    def revive(self) -> None:
        """It is there again, and knows its calibration a little later."""
        self._live()
        self.dead = False
        time.sleep(0.5)
        self.aperture(RADIUS)

    def aperture(self, radius: float, error_bound: float = 0.0) -> None:
        """Publish capabilities with an aperture of this radius and this bound of a move's error, m."""
        capabilities = Capabilities(
            quality=Capabilities.CALIBRATED,
            curvature_min=LOW,
            curvature_max=HIGH,
            aperture_radius=radius,
            error_bound=error_bound,
        )
        self._capabilities.publish(capabilities)

    def until_known(self, observer: Observer) -> None:
        """Wait until the node has taken an image and the capabilities, which come in any order."""
        wait_until(lambda: self.states, what="the first figure of an image")
        wait_until(lambda: observer.call(GetFocusRange, "get_focus_range").error_code == ErrorCode.OK, what="the range")

    def passed_over(self) -> list[int]:
        """How many images of the standing mirror came before each that counted."""
        counted = [state for state in self.states if state.phase != AutofocusState.PHASE_IDLE]
        numbers = [self._frames.index(state.header.stamp) for state in counted]
        return [number - max(first for first in self._first_settled if first <= number) for number in numbers]

    def __exit__(self, *_exception: object) -> None:
        self._stop.set()
        self._camera.join()

    def _judge(self, request: FocusRequest) -> FocusState:
        state = FocusState(curvature=request.curvature, signals=[request.curvature] * 3)
        state.conic_constant, state.zernike = request.conic_constant, request.zernike
        state.applied = abs(request.curvature) <= self.refuse_beyond
        state.history_known = self.history_known
        state.curvature_min, state.curvature_max = -self.refuse_beyond, self.refuse_beyond
        state.predicted_max_zernike_upper = 500e-9  # after a night, most of it creep of hours
        state.header.stamp = self.node.get_clock().now().to_msg()
        if not state.applied:
            state.error_code, state.message = ErrorCode.UNREACHABLE, "curvature: beyond the played range"
        return state

    def _on_request(self, request: FocusRequest) -> None:
        if self.dead:
            return
        self.requests.append(request)
        if self.degausses:
            self.degausses -= 1
            first = FocusState(curvature=request.curvature, message="the mirror is degaussed first")
            first.predicted_duration = 30.0
            self._state.publish(first)
            time.sleep(self.degauss_s)
        state = self._judge(request)
        if state.applied:
            with self._lock:
                self._curvature, self._pending = request.curvature, state
                self._arrival = time.monotonic() + MOVE_TIME
        self._state.publish(state)

    def _on_hold(self, request: HoldMirror.Request, response: HoldMirror.Response) -> HoldMirror.Response:
        if self.taken_over and request.operation == HoldMirror.Request.RENEW:
            response.error_code, response.message = ErrorCode.BUSY, "taken over by calibration"
        return response

    def _on_set_focus(self, request: SetFocus.Request, response: SetFocus.Response) -> SetFocus.Response:
        self.asked.append(request.request)
        response.state = self._judge(request.request)
        response.error_code, response.message = response.state.error_code, response.state.message
        return response

    def _film(self, period: float) -> None:
        while not self._stop.wait(period):
            with self._lock:
                exposed = self.node.get_clock().now().to_msg()
                moving = time.monotonic() < self._arrival
                off = 0.0 if moving else abs(self._curvature - self.object_curvature)
                if self._pending is not None and not moving:
                    report = ActuatorState(driver_state=ActuatorState.STATE_ACTIVE, requested=self._pending.signals)
                    report.header.stamp, self._pending = exposed, None
                    self._driver.publish(report)
                    self._first_settled.append(len(self._frames))
                self._frames.append(exposed)
            if self.render is not None:
                self._publish_image(self.render(self._curvature), exposed)
                continue
            blurred = gaussian_filter(self.texture, 0.6 + 400 * off, mode="wrap") * (4.0 if moving else 1.0)
            blurred += self._noise.standard_normal(blurred.shape)
            self._publish_image(np.clip(blurred, 0, 255).astype(np.uint8), exposed)

    def _publish_image(self, pixels: np.ndarray, exposed: Any) -> None:
        if self.compressed:
            file = io.BytesIO()
            PillowImage.fromarray(pixels).save(file, "JPEG", quality=95)
            small = CompressedImage(format="mono8; jpeg compressed mono8", data=array.array("B", file.getvalue()))
            small.header.stamp = exposed
            self._compressed.publish(small)
            return
        height, width = pixels.shape
        message = Image(height=height, width=width, encoding=self.encoding, step=width)
        message.header.frame_id = "camera"
        if self.stamped:
            message.header.stamp = exposed
        colours = bytes(height * width // 2) if self.encoding == "nv21" else b""
        message.data = array.array("B", pixels.tobytes() + colours)
        self._image.publish(message)


Start = Callable[..., NodeProcess]


@pytest.fixture
def scene(start: Start, observer: Observer) -> Iterator[FilmedScene]:
    with FilmedScene(observer, object_curvature=0.0173) as played:
        start("dm_autofocus", "autofocus", PARAMETERS)
        played.until_known(observer)
        yield played


def test_the_sharpest_focus_is_found_and_told_as_distance(scene: FilmedScene, observer: Observer) -> None:
    feedback: list[Any] = []
    goal = Autofocus.Goal()
    _handle, result = observer.send_goal(Autofocus, "autofocus", goal, lambda m: feedback.append(m.feedback))
    wait_until(result.done, 60, "the end of the search")
    found = result.result().result
    assert found.error_code == ErrorCode.OK, found.message
    assert found.curvature == pytest.approx(0.0173, abs=0.0012)
    assert found.distance == pytest.approx(distance_of(OPTICS.dioptre_for(found.curvature)))
    assert found.images == len(feedback)
    assert scene.requests[-1].curvature == found.curvature
    assert {item.phase for item in feedback} == {AutofocusState.PHASE_COARSE, AutofocusState.PHASE_FINE}


def test_a_degauss_that_runs_for_somebody_else_is_waited_for(start: Start, observer: Observer) -> None:
    """Longer than a move may take, too."""
    with FilmedScene(observer, object_curvature=0.0173) as played:
        start("dm_autofocus", "autofocus", {**PARAMETERS, "move_timeout": 1.0})
        played.until_known(observer)
        played.degausses = 2
        found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
        assert found.error_code == ErrorCode.OK, found.message
        assert found.curvature == pytest.approx(0.0173, abs=0.0012)


def test_a_known_camera_and_mirror_take_few_images(scene: FilmedScene, observer: Observer) -> None:
    lens, camera = defocused_camera.LENS, defocused_camera.DefocusedCamera(defocused_camera.clouds(), 0.0173)
    scene.aperture(lens.aperture_radius)

    def sharp(curvature: float) -> np.ndarray:
        return camera.expose(curvature).astype(np.uint8)

    scene.render = sharp
    scene.history_known = True

    def known() -> bool:
        scene.info.publish(CameraInfo(k=[lens.focal_length_px, *8 * [0.0]]))
        return scene.node.count_subscribers("camera_info") > 0

    wait_until(known, what="the node to listen")
    time.sleep(0.3)
    known()
    wait_until(lambda: scene.states[-1].sharpness < 0.1, what="an image of the known camera")
    scene.requests.clear()
    found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert found.error_code == ErrorCode.OK, found.message
    assert found.curvature == pytest.approx(0.0173, abs=depth_of_focus(lens.aperture_radius) / 2)
    assert found.images <= 10 and len(scene.requests) <= found.images + 1, "nothing is passed without an image"
    assert min(scene.passed_over()) == 0, "the first image of the mirror that stands counts"

    scene.aperture(lens.aperture_radius, 500e-9)  # every move errs by as much
    time.sleep(0.3)
    found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert "the range was swept: moves may err by 500 nm" in found.message
    scene.aperture(lens.aperture_radius)

    scene.info.publish(CameraInfo(k=[lens.focal_length_px / 2, *8 * [0.0]]))
    time.sleep(0.3)
    contradicted = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert contradicted.error_code == ErrorCode.OK, contradicted.message
    fits, given = lens.focal_length_px, lens.focal_length_px / 2
    assert f"fits a focal length of {fits:.0f} px, but {given:.0f} px is given (optics.focal_length_px, or fx" in (
        contradicted.message
    )
    known()
    time.sleep(0.3)
    scene.requests.clear()
    blank = np.full((defocused_camera.SIDE, defocused_camera.SIDE), 100, np.uint8)
    scene.render = lambda curvature: sharp(curvature) if len(scene.requests) < 4 else blank
    lost = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert lost.error_code == ErrorCode.NOT_CONVERGED
    assert re.search(rf"was swept: .*; check the focal length, {fits:.0f} px \(optics.focal_length_px", lost.message)
    scene.render = sharp
    handle, result = observer.send_goal(Autofocus, "autofocus", Autofocus.Goal(track=True))
    wait_until(lambda: scene.states[-1].phase == AutofocusState.PHASE_TRACK, 60, "tracking")
    tracked = len(scene.states)
    while (images := len(scene.states) - tracked) < 30:
        camera.place = 0.0173 - 0.0005 * images  # a third of a depth of focus from image to image
        time.sleep(0.002)
    assert scene.states[-1].curvature == pytest.approx(camera.place, abs=0.003)
    assert {state.phase for state in scene.states[tracked:]} == {AutofocusState.PHASE_TRACK}, "without a new search"
    handle.cancel_goal_async()
    wait_until(result.done, what="the end after cancel")


def test_a_focus_stack_gives_a_sharp_image_and_its_distances(
    scene: FilmedScene, observer: Observer, domain: int
) -> None:
    """Two planes side by side, at 7 m and at 20 m."""
    lens, near, far = defocused_camera.LENS, OPTICS.curvature_for(1 / 7), OPTICS.curvature_for(1 / 20)
    halves = [
        defocused_camera.DefocusedCamera(defocused_camera.clouds(seed), place) for seed, place in ((1, near), (2, far))
    ]
    side = defocused_camera.SIDE // 2

    @cache
    def render(curvature: float) -> np.ndarray:
        left, right = (camera.expose(curvature) for camera in halves)
        return np.hstack([left[:, :side], right[:, side:]]).astype(np.uint8)

    scene.aperture(lens.aperture_radius)
    scene.render, scene.encoding = render, "nv21"
    infos = observer.record(CameraInfo, "focus_stack/camera_info", qos.LATCHED)
    scene.request.publish(FocusRequest(curvature=0.004))
    wait_until(lambda: scene.states[-1].curvature == 0.004, what="the focus that was there before")
    with CameraFocusClient(domain=domain) as client:
        result, image, depth = client.focus_stack()
        assert image.shape == (2 * side, 2 * side, 1) and depth.shape == (2 * side, 2 * side)
        assert client.messages["focus_stack/image"].encoding == "mono8", "without its colours"
        for distance, columns in ((7.0, np.s_[12 : side - 12]), (20.0, np.s_[side + 12 : -12])):
            seen = depth[12:-12, columns]
            assert np.isfinite(seen).mean() > 0.9
            assert np.nanmedian(seen) == pytest.approx(distance, rel=0.02)
        assert (result.distance_near, result.distance_far) == (pytest.approx(7, rel=0.05), pytest.approx(20, rel=0.05))
        assert result.images == len({item.curvature for item in scene.requests}) - 1, "one image at each focus"
        assert scene.requests[-1].curvature == 0.004, "back where it was"
        wait_until(lambda: infos, what="camera_info")
        assert (infos[-1].header.stamp, infos[-1].header.frame_id) == (result.stamp, "camera")
        with pytest.raises(DeformableMirrorError, match="images = 3: must be 5"):
            client.focus_stack(images=3)
        scene.render = lambda _curvature: np.full((48, 64), 255, np.uint8)
        with pytest.raises(DeformableMirrorError, match=r"no texture.* largest value, 255") as blank:
            client.focus_stack(images=5)
        assert blank.value.error_code == ErrorCode.NOT_CONVERGED
        scene.render = lambda c: gaussian_filter(scene.texture, 0.6 + 100 * (0.06 - c), mode="wrap").astype(np.uint8)
        with pytest.raises(DeformableMirrorError, match="all that has texture in the image is nearer than the range"):
            client.focus_stack()


def test_compressed_images_are_taken_as_they_come(start: Start, observer: Observer) -> None:
    """Who remaps image_raw remaps its compressed topic, as with image_transport."""
    with FilmedScene(observer, object_curvature=0.0173) as played:
        played.compressed = True
        parameters, remap = {**PARAMETERS, "image_transport": "compressed"}, "image_raw:=/camera/image"
        start("dm_autofocus", "autofocus", parameters, "--ros-args", "-r", remap, "--")
        played.until_known(observer)
        found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
        assert found.error_code == ErrorCode.OK, found.message
        assert found.curvature == pytest.approx(0.0173, abs=0.0012)


def test_a_recorded_search_shows_the_same_sharpness_again(
    start: Start, observer: Observer, domain: int, tmp_path: Path
) -> None:
    with FilmedScene(observer, object_curvature=0.0173) as played:
        process = start("dm_autofocus", "autofocus", PARAMETERS)
        played.until_known(observer)
        with Recorder(tmp_path / "bag", domain=domain) as recorder:
            wait_until(lambda: recorder.counts.get("/image_raw"), what="the recorder")
            played.info.publish(CameraInfo(k=[58e3, *8 * [0.0]]))
            found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
        assert found.error_code == ErrorCode.OK, found.message
        process.stop()

    def seen() -> dict[tuple[int, int], float]:
        return {(state.header.stamp.sec, state.header.stamp.nanosec): state.sharpness for state in played.states}

    recorded = seen()
    played.states.clear()
    start("dm_autofocus", "autofocus", {**PARAMETERS, "optics.rest_distance": 0.0, "monitor_rate": 100.0})
    observer.call(GetFocusRange, "get_focus_range")
    bag = BagReader(tmp_path / "bag")
    counts = play(bag, ["/image_raw", "/camera_info", "/focus_state"], domain=domain)
    assert counts["/image_raw"] >= found.images and counts["/camera_info"] == 1
    again = {stamp: sharpness for stamp, sharpness in seen().items() if stamp in recorded}
    assert len(again) >= 5 and again == {stamp: recorded[stamp] for stamp in again}
    assert played.states[-1].dioptre == pytest.approx(2 * played.states[-1].curvature), "by other optics"


def test_two_cameras_on_one_topic_are_told(scene: FilmedScene, observer: Observer) -> None:
    """Images of both count; the focus that is found is then of neither."""
    scene.node.create_publisher(Image, "image_raw", qos_profile_sensor_data)
    health = observer.record(DiagnosticArray, "/diagnostics", 10)
    told = "/image_raw has 2 publishers, and images of all count"
    wait_until(lambda: any(told in item.status[0].message for item in health), 20, "it in the node's health")
    assert told in observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result.message


def test_images_without_stamps_are_named(scene: FilmedScene, observer: Observer) -> None:
    scene.stamped = False
    wait_until(lambda: scene.states[-1].header.stamp.sec == 0, what="an image without a stamp")
    found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert found.error_code == ErrorCode.TIMEOUT and "their header.stamp is 0" in found.message


def test_a_clock_of_the_camera_that_is_little_ahead_is_named(scene: FilmedScene, observer: Observer) -> None:
    """Also where the newest image is no longer ahead when the wait for it ends."""
    publish = scene._publish_image

    def publish_ahead(pixels: np.ndarray, exposed: Any) -> None:
        sec, nanosec = divmod(10**9 * exposed.sec + exposed.nanosec + 60_000_000, 10**9)
        publish(pixels, Time(sec=sec, nanosec=nanosec))
        time.sleep(0.1)

    scene._publish_image = publish_ahead  # type: ignore[method-assign]
    found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert found.error_code == ErrorCode.TIMEOUT and "s ahead of this node's clock" in found.message, found.message


@pytest.mark.parametrize(
    ("rate", "code", "text"),
    [
        (4.0, ErrorCode.TIMEOUT, r"image_timeout = 0.1 s: .* one image in 0.2\d* s; image_timeout must be above 0.5"),
        (1000.0, ErrorCode.OK, "sharpest at"),
    ],
)
def test_a_slow_camera_is_named_and_a_fast_one_is_no_harm(
    start: Start, observer: Observer, rate: float, code: int, text: str
) -> None:
    with FilmedScene(observer, object_curvature=0.0173, rate=rate) as played:
        start("dm_autofocus", "autofocus", {**PARAMETERS, "image_timeout": 0.1})
        played.until_known(observer)
        found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert found.error_code == code and re.search(text, found.message), found.message


def test_what_is_wrong_with_a_goal_or_the_images_is_named(scene: FilmedScene, observer: Observer) -> None:
    """Field, value and allowed range; and the node goes on with the next goal."""
    top, nothing = np.full((48, 64), 255, np.uint8), np.zeros((48, 64), np.uint8)
    for goal, image, code, text in (
        ({"region": [0.5, 0.0, 0.9, 1.0]}, None, ErrorCode.OUT_OF_RANGE, r"region = \[0.5, 0.0, 0.9, 1.0\].* 0 to 1"),
        ({"region": [0.5, 0.5, 1.5, 0.1]}, None, ErrorCode.OUT_OF_RANGE, r"region\[2\] = 1.5.* 0 to 1"),
        ({"region": [0.0, 1.0, 0.5]}, None, ErrorCode.INVALID_LENGTH, "region has 3 values: must have 0 or 4"),
        ({"region": [0.5, 0.5, 0.01, 0.01]}, None, ErrorCode.INVALID_ARGUMENT, r"region = .* 1 x 1 px .* 3 x 3"),
        (
            {"curvature_max": 0.2},
            None,
            ErrorCode.OUT_OF_RANGE,
            r"curvature_max = .*\+0.2000 1/m: .* \+0.0500 1/m, or both 0",
        ),
        ({}, top, ErrorCode.NOT_CONVERGED, "100 % of its pixels have the largest value, 255"),
        ({}, nothing, ErrorCode.NOT_CONVERGED, "the image is black"),
    ):
        scene.render = None if image is None else lambda _curvature, image=image: image
        found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal(**goal)).result
        assert found.error_code == code and re.search(text, found.message), (goal, found.error_code, found.message)


def test_what_the_controller_refuses_is_left_out(scene: FilmedScene, observer: Observer) -> None:
    scene.refuse_beyond = 0.043
    found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert found.error_code == ErrorCode.OK, found.message
    assert found.curvature == pytest.approx(0.0173, abs=0.0012)


def test_a_scene_without_texture_ends_without_a_focus(scene: FilmedScene, observer: Observer) -> None:
    scene.texture[:] = 100.0
    unasked = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert "; the mirror stays where it is" in unasked.message, "nobody knows where it was"
    scene.request.publish(FocusRequest(curvature=0.004, conic_constant=-1.0, zernike=[1e-8] * 21))
    wait_until(lambda: scene.states[-1].curvature == 0.004, what="the focus that was there before")
    found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert found.error_code == ErrorCode.NOT_CONVERGED and "; the mirror is back where it was" in found.message
    back = scene.requests[-1]
    assert (back.curvature, back.conic_constant, list(back.zernike)) == (0.004, -1.0, [1e-8] * 21)


def test_tracking_finds_an_object_that_moved_and_ends_on_cancel(scene: FilmedScene, observer: Observer) -> None:
    handle, result = observer.send_goal(Autofocus, "autofocus", Autofocus.Goal(track=True))
    wait_until(lambda: scene.states[-1].phase == AutofocusState.PHASE_TRACK, 60, "tracking")
    scene.object_curvature = -0.03
    wait_until(lambda: scene.states[-1].phase == AutofocusState.PHASE_COARSE, 60, "a new search")

    def on_it() -> bool:
        last = scene.states[-1]
        return last.phase == AutofocusState.PHASE_TRACK and abs(last.curvature + 0.03) < 0.002

    wait_until(on_it, 60, "tracking of the moved object")
    other = SetFocusDistance.Request(distance=7.0, holder="operator")
    assert observer.call(SetFocusDistance, "set_focus_distance", other).error_code == ErrorCode.BUSY
    other.dry_run = True
    assert observer.call(SetFocusDistance, "set_focus_distance", other).error_code == ErrorCode.OK
    other.dry_run, other.take_over = False, True
    assert observer.call(SetFocusDistance, "set_focus_distance", other).error_code == ErrorCode.OK
    assert [(request.holder, request.take_over) for request in scene.asked] == [("operator", False), ("operator", True)]
    stack = observer.run_goal(FocusStack, "focus_stack", FocusStack.Goal()).result
    assert (stack.error_code, stack.message) == (
        ErrorCode.BUSY,
        "the action autofocus is running; cancel it first, or take the mirror over",
    )
    handle.cancel_goal_async()
    wait_until(result.done, what="the end after cancel")
    assert result.result().status == GoalStatus.STATUS_CANCELED
    assert result.result().result.curvature == pytest.approx(-0.03, abs=0.002)


def test_tracking_that_has_nothing_left_to_see_searches_what_comes(scene: FilmedScene, observer: Observer) -> None:
    _handle, result = observer.send_goal(Autofocus, "autofocus", Autofocus.Goal(track=True))
    wait_until(lambda: scene.states[-1].phase == AutofocusState.PHASE_TRACK, 60, "tracking")
    texture = scene.texture.copy()
    for place, coming in ((0.0173, 100.0), (0.0253, texture)):
        scene.object_curvature, scene.texture[:] = place, coming
        wait_until(lambda: scene.states[-1].phase == AutofocusState.PHASE_COARSE, 30, "a new search")
        wait_until(lambda: scene.states[-1].phase == AutofocusState.PHASE_TRACK, 60, "tracking")
    assert not result.done() and scene.states[-1].curvature == pytest.approx(0.0253, abs=0.002)


def test_tracking_is_not_ended_by_a_goal_that_cannot_be_nor_by_a_range_that_narrows(
    scene: FilmedScene, observer: Observer
) -> None:
    _handle, result = observer.send_goal(Autofocus, "autofocus", Autofocus.Goal(track=True))
    wait_until(lambda: scene.states[-1].phase == AutofocusState.PHASE_TRACK, 60, "tracking")
    for goal in (Autofocus.Goal(curvature_max=0.2), Autofocus.Goal(region=[0.5, 0.0, 0.9, 1.0])):
        assert observer.run_goal(Autofocus, "autofocus", goal).result.error_code == ErrorCode.OUT_OF_RANGE
    scene.refuse_beyond = scene.states[-1].curvature - 1e-5
    refused = len(scene.requests)

    def follows() -> bool:
        asked = scene.requests[refused:]
        return len(asked) > 10 and all(request.curvature <= scene.refuse_beyond for request in asked[-5:])

    wait_until(lambda: result.done() or follows(), 30, "trials inside the range that is left")
    assert not result.done(), result.result().result.message
    assert scene.states[-1].phase == AutofocusState.PHASE_TRACK
    scene._publish_image = lambda *_image: None  # type: ignore[method-assign]
    wait_until(result.done, 30, "the end without images")
    assert result.result().result.error_code == ErrorCode.TIMEOUT
    health = observer.record(DiagnosticArray, "/diagnostics", 10)

    def warned() -> bool:
        return any("no image on /image_raw within image_timeout" in item.status[0].message for item in health)

    wait_until(warned, 20, "the camera's silence in the node's health")
    scene.refuse_beyond = HIGH
    found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert found.error_code == ErrorCode.TIMEOUT and found.message.endswith("none came; is the camera running?")
    scene.node.destroy_publisher(scene._image)
    wait_until(lambda: not observer.node.count_publishers("image_raw"), 10, "the end of the camera's topic")
    found = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert found.error_code == ErrorCode.TIMEOUT
    assert found.message.endswith("nobody publishes there; is the camera running, and is this its topic?")


def test_a_stack_of_images_of_two_encodings_is_refused(scene: FilmedScene, observer: Observer) -> None:
    """It would be published as what only the last one is."""

    def change(feedback: Any) -> None:
        if feedback.feedback.step == 5:
            scene.encoding = "8UC1"

    _handle, result = observer.send_goal(FocusStack, "focus_stack", FocusStack.Goal(), change)
    wait_until(result.done, 60, "the end")
    assert result.result().result.error_code == ErrorCode.INVALID_ARGUMENT
    assert result.result().result.message == "the images changed their encoding from mono8 to 8UC1"


def test_tracking_goes_on_when_the_controller_is_back(scene: FilmedScene, observer: Observer) -> None:
    handle, result = observer.send_goal(Autofocus, "autofocus", Autofocus.Goal(track=True))
    wait_until(lambda: scene.states[-1].phase == AutofocusState.PHASE_TRACK, 60, "tracking")
    scene.die()
    died = "the node focus_controller has died"
    wait_until(lambda: died in observer.call(GetFocusRange, "get_focus_range").message, what="its name")
    time.sleep(0.5)  # tracking has been refused a move meanwhile
    requests = len(scene.requests)
    scene.revive()
    wait_until(lambda: len(scene.requests) > requests + 3, what="the next trials")
    assert scene.states[-1].phase == AutofocusState.PHASE_TRACK and not result.done()
    handle.cancel_goal_async()
    wait_until(result.done, what="the end after cancel")


def test_tracking_that_stands_still_hears_that_somebody_took_the_mirror_over(start: Start, observer: Observer) -> None:
    with FilmedScene(observer, object_curvature=0.0173) as played:
        start("dm_autofocus", "autofocus", {**PARAMETERS, "track.dither": 0.0})
        played.until_known(observer)
        _handle, result = observer.send_goal(Autofocus, "autofocus", Autofocus.Goal(track=True))
        wait_until(lambda: played.states[-1].phase == AutofocusState.PHASE_TRACK, 60, "tracking")
        played.taken_over = True
        wait_until(result.done, 30, "the end")
        assert result.result().result.error_code == ErrorCode.PREEMPTED
        assert "taken over by calibration" in result.result().result.message


def test_another_node_that_moves_the_mirror_ends_the_search(scene: FilmedScene, observer: Observer) -> None:
    _handle, result = observer.send_goal(Autofocus, "autofocus", Autofocus.Goal())
    wait_until(lambda: len(scene.requests) > 5, what="the search to be under way")
    while not result.done():
        scene.request.publish(FocusRequest(curvature=0.0421))
        time.sleep(0.02)
    found = result.result().result
    assert found.error_code == ErrorCode.PREEMPTED
    assert "+0.0421" in found.message


def test_focus_by_distance_and_by_dioptre(scene: FilmedScene, observer: Observer) -> None:
    def ask(**fields: float) -> SetFocusDistance.Response:
        return observer.call(SetFocusDistance, "set_focus_distance", SetFocusDistance.Request(**fields))

    near = ask(distance=7.0)
    assert near.error_code == ErrorCode.OK, near.message
    assert near.curvature == pytest.approx((1 / 7 - 1 / 10) / 2)
    assert near.power == pytest.approx(2 * near.curvature)
    assert near.state.applied
    assert ask(dioptre=1 / 7).curvature == pytest.approx(near.curvature)
    assert ask().curvature == pytest.approx(-1 / 20), "infinity"
    both = ask(distance=7.0, dioptre=0.1)
    assert (both.error_code, both.state.applied) == (ErrorCode.INVALID_ARGUMENT, False)
    too_near = ask(distance=2.0)
    assert too_near.error_code == ErrorCode.UNREACHABLE
    assert "from 5.00 m to infinity" in too_near.message
    assert ask(distance=-1.0).error_code == ErrorCode.OUT_OF_RANGE


def test_the_focus_range_comes_from_the_capabilities(scene: FilmedScene, observer: Observer) -> None:
    answer = observer.call(GetFocusRange, "get_focus_range")
    assert answer.error_code == ErrorCode.OK
    assert answer.distance_near == pytest.approx(5.0)
    assert math.isinf(answer.distance_far)
    assert (answer.dioptre_min, answer.dioptre_max) == (pytest.approx(0.0, abs=1e-12), pytest.approx(0.2))
    assert answer.curvature_tolerance == pytest.approx(550e-9 / (4 * RADIUS**2))


def test_without_controller_and_camera_the_reason_is_told(start: Start, observer: Observer) -> None:
    start("dm_autofocus", "autofocus", PARAMETERS)
    answer = observer.run_goal(Autofocus, "autofocus", Autofocus.Goal()).result
    assert answer.error_code == ErrorCode.TIMEOUT
    assert "focus_controller" in answer.message
    handle, result = observer.send_goal(Autofocus, "autofocus", Autofocus.Goal())
    handle.cancel_goal_async()  # while it waits for one
    wait_until(result.done, what="the end after cancel")
    assert result.result().status == GoalStatus.STATUS_CANCELED


def test_a_goal_waits_for_a_controller_that_starts_later(start: Start, observer: Observer) -> None:
    start("dm_autofocus", "autofocus", PARAMETERS)
    _handle, result = observer.send_goal(Autofocus, "autofocus", Autofocus.Goal())
    with FilmedScene(observer, object_curvature=0.0173):
        wait_until(result.done, what="the end of the search")
    assert result.result().result.error_code == ErrorCode.OK, result.result().result.message


def test_a_senseless_region_keeps_the_node_from_its_work_with_the_reason(start: Start, observer: Observer) -> None:
    process = start("dm_autofocus", "autofocus", {"region": [0.5, 0.0, 0.9, 1.0]})
    answer = observer.call(GetFocusRange, "get_focus_range")
    assert answer.error_code == ErrorCode.NODE_INACTIVE
    assert "region = [0.5, 0.0, 0.9, 1.0]" in answer.message and "region = [0.5, 0.0, 0.9, 1.0]" in process.output
    for region, text in (([0.5, 0.0, 0.5, 1.0], ""), ([0.5, 0.0, 0.9, 1.0], "region = [0.5, 0.0, 0.9, 1.0]: left")):
        request = SetParameters.Request(parameters=[Parameter("region", value=region).to_parameter_msg()])
        (result,) = observer.call(SetParameters, "autofocus/set_parameters", request).results
        assert result.successful == (not text) and result.reason.startswith(text), result.reason


def test_the_example_of_the_documentation_runs(scene: FilmedScene, domain: int) -> None:
    root = Path(__file__).resolve().parents[2]
    example = (root / "examples" / "camera_focus.py").read_text()
    code = example[example.index("from dm_autofocus") :]
    page = (root / "docs" / "camera.md").read_text()
    assert all(line in page for line in code.splitlines())
    done = subprocess.run(
        [sys.executable, str(root / "examples" / "camera_focus.py")],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert f"sharpest at {distance_of(OPTICS.dioptre_for(0.0173)):.1f}" in done.stdout
    assert "of the pixels from" in done.stdout
    assert sorted(unexplained(done.stdout)) == []


@pytest.mark.parametrize(
    ("given", "said"), [("-1.0", "rest_distance = -1.0 m: must be above 0"), ("5", "rest_distance")]
)
def test_the_vision_node_refuses_what_is_no_distance_in_a_sentence(given: str, said: str, domain: int) -> None:
    node = Path(__file__).resolve().parents[2] / "examples" / "vision_node.py"
    command = [sys.executable, str(node), "--ros-args", "-p", f"rest_distance:={given}"]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 1 and said in ended.stderr and "Traceback" not in ended.stderr


def test_the_vision_node_of_the_examples_focuses_on_what_it_detects() -> None:
    root = Path(__file__).resolve().parents[2]
    rclpy.init()
    try:
        node = runpy.run_path(str(root / "examples" / "vision_node.py"))["VisionNode"]()
        asked: list[FocusRequest] = []
        node._request.publish = asked.append
        for distance in (12.0, -1.0, math.inf):
            node._on_distance(Range(range=distance))
        node._on_state(FocusState(curvature=0.01, predicted_duration=0.02))
        node.destroy_node()
    finally:
        rclpy.shutdown()
    assert [request.curvature for request in asked] == [OPTICS.curvature_for(1 / 12.0), OPTICS.curvature_for(0.0)]


def test_a_damaged_image_does_not_end_tracking_but_a_camera_that_sends_no_others_does(
    scene: FilmedScene, observer: Observer
) -> None:
    _handle, result = observer.send_goal(Autofocus, "autofocus", Autofocus.Goal(track=True))
    wait_until(lambda: scene.states[-1].phase == AutofocusState.PHASE_TRACK, 60, "tracking")
    damaged = Image(height=48, width=64, step=64, encoding="mono8", data=[0] * 3069)
    for _ in range(20):
        damaged.header.stamp = scene.node.get_clock().now().to_msg()
        scene._image.publish(damaged)
        time.sleep(0.05)
    assert not result.done()
    scene.encoding = "64FC1"
    wait_until(result.done, 30, "the end")
    assert result.result().result.error_code == ErrorCode.INVALID_ARGUMENT
    assert "encoding = '64FC1'" in result.result().result.message
