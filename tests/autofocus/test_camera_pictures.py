"""Contact sheet and animation of made-up searches, and the regions of the demonstration."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from dm_autofocus.sharpness import check_region, cut
from dm_tools.demo.camera_runs import Approach, Focused, Shot, Sweep
from dm_tools.demo.demo_camera import camera_config, regions
from dm_tools.demo.pictures import HOLD, save_animation, save_contact_sheet

pytestmark = pytest.mark.slow


@pytest.fixture
def found() -> list[Focused]:
    """Two searches of four images each."""
    noise = np.random.default_rng(3)
    items = []
    for distance, region in zip((6.0, 20.0), regions(2), strict=True):
        shots = [
            Shot(noise.integers(0, 255, (24, 32), dtype=np.uint8), curvature, 1 - abs(curvature))
            for curvature in (-0.02, -0.01, 0.0, 0.01)
        ]
        result = SimpleNamespace(distance=distance + 0.1, curvature=0.0)
        items.append(Focused(distance, region, result, shots, shots[2]))
    return items


def test_the_animation_shows_every_image_and_rests_on_the_last(found: list[Focused], tmp_path: Path) -> None:
    shots = found[0].shots
    sweep = Sweep(shots, shots[0].image, np.full((24, 32), 7.0, np.float32), 1.2)
    approach = Approach(shots[:3], [6.0, 5.5, 5.0])
    file = save_animation(found, sweep, approach, tmp_path / "a.gif", "two objects", frames_per_second=10)
    with Image.open(file) as animation:
        durations = []
        for frame in range(getattr(animation, "n_frames", 1)):  # equal frames are merged into a longer one
            animation.seek(frame)
            durations.append(animation.info["duration"])
    frames = 2 * (4 + HOLD) + len(sweep.shots) + 2 * HOLD + len(approach.shots) + HOLD
    assert len(durations) >= 2 * 4 + 4 + 1 + 3
    assert sum(durations) == pytest.approx(100 * frames, rel=0.02)


def test_the_contact_sheet_is_written(found: list[Focused], tmp_path: Path) -> None:
    with Image.open(save_contact_sheet(found, tmp_path / "sheet.png", "two objects")) as sheet:
        assert np.asarray(sheet.convert("L")).std() > 10


@pytest.mark.parametrize("count", [1, 3, 5])
def test_regions_lie_inside_their_strips(count: int) -> None:
    owner = np.tile(np.arange(320) * count // 320, (240, 1))
    for number, region in enumerate(regions(count)):
        assert set(cut(owner, check_region(region)).ravel()) == {number}


def test_bench_and_autofocus_agree_about_the_optics(tmp_path: Path) -> None:
    config = camera_config(tmp_path, "off", 0.0, 1)
    assert config["virtual_bench"]["camera.rest_distance"] == config["autofocus"]["optics.rest_distance"]
