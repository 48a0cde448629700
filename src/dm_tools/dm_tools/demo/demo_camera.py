"""`dm demo --camera`: a virtual camera behind the mirror focuses on objects at three distances."""

import os
import shutil
import time
from pathlib import Path
from typing import Any

from rich.table import Table

from dm_autofocus import CameraFocusClient
from dm_autofocus.sharpness import Region
from dm_client import DeformableMirrorClient
from dm_common.ros.domains import own_domain
from dm_tools.demo.camera_runs import Focused, Recorder, focus_on, follow, sweep_of
from dm_tools.demo.demo_bench import (
    bench_config,
    identify_hysteresis,
    make_empty,
    running_bench,
    usable_folder,
    wait_for_calibration,
)
from dm_tools.demo.pictures import save_animation, save_contact_sheet
from dm_tools.output import console, figures, next_step, write_json
from dm_tools.verbs import calibrate
from dm_tools.verbs.up import DISTANCES, RATE, add_camera

#: Number of maps of the calibration and their width [pixels]: less than on a bench, for a quick demonstration.
MAPS, PIXELS = 120, 472


def camera_config(folder: Path, law: str, creep: float, seed: int) -> dict[str, dict[str, Any]]:
    """The bench in real time, with the camera and the node `autofocus`; the calibration is the newest in `folder`."""
    config = bench_config(folder, law, creep, seed, speed=0.0)
    add_camera(config)
    config["calibration"]["load_on_start"] = "newest"
    return config


def regions(count: int) -> list[Region]:
    """The middle of each of `count` strips side by side."""
    return [((number + 0.15) / count, 0.15, 0.7 / count, 0.7) for number in range(count)]


def figures_of(item: Focused) -> dict[str, Any]:
    """One object for JSON."""
    return figures(item.result, "curvature", "images", "images_dropped") | {
        "distance_m": item.distance,
        "found_m": item.result.distance,
        "dioptre_error": item.result.dioptre - 1 / item.distance,
        "sharpness": item.final.sharpness,
        "sharpness_dullest": min(shot.sharpness for shot in item.shots),
        "sharpness_by_distance_only": item.by_distance,
        "seconds": item.result.duration,
    }


def show(found: list[Focused], depth: float) -> None:
    """Print the table."""
    table = Table(title=f"autofocus at {RATE:g} images per second; depth of focus +-{2 * depth:.4f} dioptre")
    for heading in ("object m", "found m", "error dioptre", "sharpness", "by distance only", "images", "seconds"):
        table.add_column(heading, justify="right")
    for item in found:
        row = figures_of(item)
        table.add_row(
            f"{item.distance:g}",
            f"{item.result.distance:.2f}",
            f"{row['dioptre_error']:+.4f}",
            f"{row['sharpness']:.3f}",
            f"{row['sharpness_by_distance_only']:.3f}",
            str(item.result.images),
            f"{item.result.duration:.1f}",
        )
    console.print(table)


def demo_camera(law: str, creep: float, seed: int, speed: float, out: Path, json: Path | None) -> None:
    """Calibrate in fast time, then start again in real time with a camera and focus on every object."""
    started = time.monotonic()
    folder = usable_folder(out)
    make_empty(folder)
    console.print(f"virtual bench with a camera: PDM30-37, hysteresis {law}, creep {creep:.0%}, seed {seed}")
    with own_domain() as domain:
        config = bench_config(folder, law, creep, seed, speed)
        config["virtual_bench"]["interferometer.pixels"] = PIXELS
        with running_bench(config, folder / "calibration", domain, DeformableMirrorClient) as client:
            calibrated = identify_hysteresis(client, MAPS, "camera")
    shutil.rmtree(folder / "maps")
    # A new domain: the first suite's time ran ahead, and none of its messages must pass for a recent one.
    with own_domain() as domain:
        config = camera_config(folder, law, creep, seed)
        with running_bench(config, folder / "camera", domain, CameraFocusClient) as camera:
            wait_for_calibration(camera, calibrated.id)
            camera.degauss()  # from here on the controller knows the actuators' history
            recorder = Recorder(camera)
            reach = camera.focus_range()
            console.print(f"the camera focuses {reach.message}")
            recorder.image_now()
            found = [
                focus_on(camera, recorder, distance, region)
                for distance, region in zip(DISTANCES, regions(len(DISTANCES)), strict=True)
            ]
            sweep = sweep_of(camera, recorder)
            approach = follow(camera, recorder, found[0].region)
    show(found, reach.curvature_tolerance)
    console.print(
        f"focus stack of {len(sweep.shots)} images in {sweep.seconds:.1f} s; tracked an approaching object over "
        f"{len(approach.shots)} images"
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
            "creep_per_decade": creep,
            "seed": seed,
            "calibration": calibrate.figures_of(calibrated),
            "camera": [figures_of(item) for item in found],
            "stack": {"images": len(sweep.shots), "seconds": sweep.seconds},
            "tracked_images": len(approach.shots),
            "depth_of_focus_dioptre": 2 * reach.curvature_tolerance,
            "seconds": time.monotonic() - started,
        },
    )
    console.print(f"done in {time.monotonic() - started:.0f} s")
    next_step("./dm up --camera starts these nodes for you to play with; docs/camera.md puts your camera in its place")
