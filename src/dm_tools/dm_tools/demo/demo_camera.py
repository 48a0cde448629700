"""`dm demo --camera`: a virtual camera behind the mirror focuses on objects at three distances."""

from __future__ import annotations

import math
import os
import shutil
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dm_tools.demo.demo_bench import bench_config, new_folder, running_bench, wait_for_calibration
from dm_tools.output import console, next_step, progress_bar, write_json
from dm_tools.verbs.up import DISTANCES, RATE, add_camera

if TYPE_CHECKING:  # both are slow to import, and `dm --help` needs neither
    from dm_autofocus import CameraFocusClient
    from dm_tools.demo.demo import Hysteresis

#: How fast the nearest object comes nearer [m/s] until it is so far away [m], and how long the search may take [s].
SPEED, NEAREST, SEARCH_S = 0.7, 4.5, 1.5
#: Of the calibration: fewer and smaller maps than a bench would take, for a quick demonstration.
MAPS, PIXELS = 120, 472


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


def camera_config(folder: Path, law: str, creep: float, seed: int) -> dict[str, dict[str, Any]]:
    """The bench in real time, with the camera and the node `autofocus`; the calibration is the newest in `folder`."""
    config = bench_config(folder, law, creep, seed, speed=0.0)
    add_camera(config)
    config["calibration"]["load_on_start"] = "newest"
    return config


def regions(count: int) -> list[tuple[float, float, float, float]]:
    """The middle of each of `count` strips side by side."""
    return [((number + 0.15) / count, 0.15, 0.7 / count, 0.7) for number in range(count)]


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
        drift: how far the picture moved over the whole sweep [px].
        sharp: image that is sharp everywhere (H, W).
        depth: distances (H, W) [m].
        seconds: that it took.
    """

    shots: list[Shot]
    drift: float
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


def focus_on(client: CameraFocusClient, recorder: Recorder, item: Focused, settle: float = 0.3) -> None:
    """Search on one object, then focus it by its distance alone for comparison."""
    from dm_autofocus.sharpness import cut, tenengrad

    recorder.shots.clear()
    with progress_bar() as progress:
        task = progress.add_task(f"object at {item.distance:g} m", total=None)
        item.result = client.autofocus(
            item.region, on_feedback=lambda f: progress.update(task, total=f.steps, completed=f.step)
        )
        progress.update(task, total=item.result.images, completed=item.result.images)
    time.sleep(settle)
    image = image_now(client, recorder)
    item.shots = list(recorder.shots)
    item.final = Shot(image, item.result.curvature, tenengrad(cut(image, item.region)))
    client.focus_distance(item.distance)
    time.sleep(settle)
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
        client.track(SEARCH_S + (DISTANCES[0] - NEAREST) / SPEED, region, move)
        bench.set_parameters([Parameter("camera.distances", value=list(DISTANCES))])
        time.sleep(0.3)
    return approach


def sweep_of(client: CameraFocusClient, recorder: Recorder, item: Focused) -> Sweep:
    """A focus stack, and how far it moved the picture of an object."""
    from dm_autofocus.boresight import image_shift
    from dm_autofocus.sharpness import check_region, cut

    recorder.shots.clear()
    with console.status("a focus stack"):
        result, sharp, depth = client.focus_stack()
    shots = sorted(recorder.shots, key=lambda shot: shot.curvature)
    # Pairs that are blurred alike, on either side of the object's focus.
    middle = int(np.argmin([abs(shot.curvature - item.result.curvature) for shot in shots]))
    region, moved = check_region(item.region), []
    for step in range(1, min(4, middle, len(shots) - 1 - middle) + 1):
        below, above = shots[middle - step], shots[middle + step]
        shift = image_shift(cut(below.image, region), cut(above.image, region))
        moved.append(np.hypot(*shift) / (above.curvature - below.curvature))
    drift = float(np.median(moved)) * (shots[-1].curvature - shots[0].curvature) if moved else math.nan
    return Sweep(shots, drift, sharp[..., 0], depth, result.duration)


def figures_of(item: Focused) -> dict[str, Any]:
    """One object for JSON."""
    assert item.final is not None
    return {
        "distance_m": item.distance,
        "found_m": item.result.distance,
        "dioptre_error": item.result.dioptre - 1 / item.distance,
        "curvature": item.result.curvature,
        "sharpness": item.final.sharpness,
        "sharpness_dullest": min(shot.sharpness for shot in item.shots),
        "sharpness_by_distance_only": item.by_distance,
        "images": item.result.images,
        "images_dropped": item.result.images_dropped,
        "seconds": item.result.duration,
    }


def show(found: list[Focused], depth: float) -> None:
    """Print the table."""
    from rich.table import Table

    table = Table(title=f"autofocus at {RATE:g} images per second; depth of focus +-{2 * depth:.4f} dioptre")
    for heading in ("object m", "found m", "error dioptre", "sharpness", "by distance only", "images", "seconds"):
        table.add_column(heading, justify="right")
    for item in found:
        figures = figures_of(item)
        table.add_row(
            f"{item.distance:g}",
            f"{item.result.distance:.2f}",
            f"{figures['dioptre_error']:+.4f}",
            f"{figures['sharpness']:.3f}",
            f"{figures['sharpness_by_distance_only']:.3f}",
            str(item.result.images),
            f"{item.result.duration:.1f}",
        )
    console.print(table)


def demo_camera(
    hysteresis: Hysteresis, creep: float | None, seed: int, speed: float, out: Path, json: Path | None
) -> None:
    """Calibrate in fast time, then start again in real time with a camera and focus on every object."""
    from dm_msgs.action import Calibrate

    from dm_autofocus import CameraFocusClient
    from dm_client import DeformableMirrorClient
    from dm_common.ros.domains import own_domain
    from dm_tools.demo.pictures import save_animation, save_contact_sheet
    from dm_tools.verbs.calibrate import figures_of as calibration_figures
    from dm_tools.verbs.calibrate import run_calibration, show_result

    started = time.monotonic()
    folder = new_folder(out)
    law = hysteresis.value
    actual_creep = creep if creep is not None else (0.0 if law == "off" else 0.01)
    console.print(f"virtual bench with a camera: PDM30-37, hysteresis {law}, creep {actual_creep:.0%}, seed {seed}")
    with own_domain() as domain:
        config = bench_config(folder, law, actual_creep, seed, speed)
        config["virtual_bench"]["interferometer.pixels"] = PIXELS
        with running_bench(config, folder / "calibration", domain, DeformableMirrorClient) as client:
            goal = Calibrate.Goal(
                plan=Calibrate.Goal.PLAN_HYSTERESIS, hysteresis_maps=MAPS, activate=True, note="camera"
            )
            calibrated = run_calibration(client, goal)
        show_result(calibrated)
    shutil.rmtree(folder / "maps")
    # A domain of its own: the first suite's time ran ahead, and nothing of it must be taken for news.
    with own_domain() as domain:
        config = camera_config(folder, law, actual_creep, seed)
        with running_bench(config, folder / "camera", domain, CameraFocusClient) as camera:
            wait_for_calibration(camera, calibrated.id)
            camera.degauss()  # from here on the controller knows the actuators' history
            recorder = Recorder(camera)
            reach = camera.focus_range()
            console.print(f"the camera focuses {reach.message}")
            image_now(camera, recorder)
            found = [
                Focused(distance, region) for distance, region in zip(DISTANCES, regions(len(DISTANCES)), strict=True)
            ]
            for item in found:
                focus_on(camera, recorder, item)
            sweep = sweep_of(camera, recorder, found[1])
            approach = follow(camera, recorder, found[0].region)
    show(found, reach.curvature_tolerance)
    console.print(
        f"focus stack of {len(sweep.shots)} images in {sweep.seconds:.1f} s; the picture moved by {sweep.drift:.1f} px "
        f"meanwhile; an object was tracked over {len(approach.shots)} images"
    )
    title = f"autofocus through a simulated PDM30-37, hysteresis: {law}"
    with console.status("writing the animation"):
        sheet = save_contact_sheet(found, folder / "camera.png", title)
        animation = save_animation(found, sweep, approach, folder / "camera.gif", title)
    console.print(f"pictures: {os.path.relpath(sheet)}, {os.path.relpath(animation)}")
    write_json(
        json,
        {
            "plant": law,
            "creep_per_decade": actual_creep,
            "seed": seed,
            "calibration": calibration_figures(calibrated),
            "camera": [figures_of(item) for item in found],
            "stack": {"images": len(sweep.shots), "seconds": sweep.seconds, "drift_px": sweep.drift},
            "tracked_images": len(approach.shots),
            "depth_of_focus_dioptre": 2 * reach.curvature_tolerance,
            "seconds": time.monotonic() - started,
        },
    )
    console.print(f"done in {time.monotonic() - started:.0f} s")
    next_step("./dm up --camera starts these nodes for you to play with; docs/camera.md puts your camera in its place")
