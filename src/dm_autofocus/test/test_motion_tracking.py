"""An object that moves is followed by how blurred the images are; one that stands still is not left."""

from __future__ import annotations

import math

import numpy as np
import pytest
from defocused_camera import DEPTH, LENS, SIDE, DefocusedCamera, clouds

from dm_autofocus.search.defocus_model import DefocusModel
from dm_autofocus.search.peak_search import Peak, SearchConfig
from dm_autofocus.search.tracking import BEFORE, MotionTracker, TrackConfig, Tracker
from dm_autofocus.sharpness import tenengrad

LOW, HIGH = -0.05, 0.05
PERIOD = 1 / 30


@pytest.fixture(scope="module")
def model() -> DefocusModel:
    return DefocusModel((SIDE, SIDE), LENS, HIGH - LOW)


def tracker_at(place: float, model: DefocusModel, sharpness: float) -> MotionTracker:
    return MotionTracker(Peak(place, sharpness, False), SearchConfig(LOW, HIGH, DEPTH), TrackConfig(wait=0.0), model)


def follow(model: DefocusModel, start: float, speed: float, images: int) -> tuple[MotionTracker, np.ndarray]:
    """A tracker after that many images, and by how much each was off, in depths of focus."""
    camera = DefocusedCamera(clouds(3), start)
    tracker = tracker_at(start, model, tenengrad(camera.expose(start)))
    off = []
    for number in range(images):
        camera.place = start + speed * number * PERIOD
        off.append(tracker.step.curvature - camera.place)
        image = camera.expose(tracker.step.curvature)
        tracker.feed(tenengrad(image), (image,), 100.0 + number * PERIOD)
    return tracker, np.abs(off) / DEPTH


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.0, 0.02, -0.02])
def test_the_focus_stays_on_an_object_that_moves(model: DefocusModel, speed: float) -> None:
    """An object that comes nearer by 1 m/s at 5 m: 0.02 1/m per second, half a depth of focus from image to image."""
    tracker, off = follow(model, 0.0, speed, 40)
    assert not tracker.lost
    assert np.all(off[10:] < 1.5) and np.median(off[10:]) < 0.8
    assert tracker.speed == pytest.approx(speed, abs=0.005)


def test_it_ends_near_the_end_of_the_range(model: DefocusModel) -> None:
    """Where the object was a few images before it was lost."""
    tracker, _off = follow(model, HIGH - 0.01, 0.03, 30)
    assert HIGH - tracker.centre < BEFORE * 0.03 * PERIOD + DEPTH and LOW <= tracker.step.curvature <= HIGH


@pytest.mark.slow
@pytest.mark.parametrize(("direction", "end"), [(1, 0.013), (-1, 0.007)])
def test_it_stays_where_the_mirror_reaches_no_farther(model: DefocusModel, direction: int, end: float) -> None:
    """Be it less than half of the range that there was."""
    reached = sorted([end, end - direction * 0.04])
    camera = DefocusedCamera(clouds(3), 0.01)
    tracker, refused = tracker_at(0.01, model, tenengrad(camera.expose(0.01))), 0
    for number in range(30):
        camera.place += direction * min(0.005 * PERIOD, direction * (end - camera.place) + DEPTH)
        while direction * (tracker.step.curvature - end) > 0:
            tracker.refuse(*reached)
            refused += 1
        image = camera.expose(tracker.step.curvature)
        tracker.feed(tenengrad(image), (image,), 100.0 + number * PERIOD)
    assert refused and not tracker.lost and abs(tracker.step.curvature - end) < DEPTH
    with pytest.raises(ValueError, match=r"range = .*: must span .* 1/m or more"):
        for _refusal in range(1000):
            tracker.refuse(math.nan, math.nan)


@pytest.mark.slow
@pytest.mark.parametrize("cover", [0.1, 4.0])
def test_the_focus_waits_while_somebody_walks_past(model: DefocusModel, cover: float) -> None:
    """Duller or sharper than the object: for half a second nothing of theirs is believed."""
    camera = DefocusedCamera(clouds(3), 0.01)
    normal = tenengrad(camera.expose(0.01))
    tracker = MotionTracker(Peak(0.01, normal, False), SearchConfig(LOW, HIGH, DEPTH), TrackConfig(), model)
    for number in range(40):
        image = camera.expose(tracker.step.curvature)
        covered = 10 <= number < 25
        tracker.feed(cover * normal if covered else tenengrad(image), (image,), number * PERIOD)
        assert tracker.hidden == (12 <= number < 25) and not tracker.lost
        assert abs(tracker.centre - 0.01) < DEPTH
    for number in range(40, 40 + 40):
        tracker.feed(cover * normal, (image,), number * PERIOD)
        if tracker.lost:
            break
    assert tracker.lost == (cover < 1), "what is sharper for long is the new normal"


def test_what_is_seen_no_more_is_lost(model: DefocusModel) -> None:
    tracker = tracker_at(0.0, model, 1.0)
    blank = np.full((SIDE, SIDE), 100.0)
    for number in range(3):
        tracker.feed(0.0, (blank,), number * PERIOD)
    assert tracker.lost
    other = tracker_at(0.0, model, 1.0)
    other.feed(1.0, (blank[1:],), 0.0)
    assert other.lost, "images of another size"
    with pytest.raises(ValueError, match="finite"):
        other.feed(math.nan, (blank,), 0.0)


@pytest.mark.parametrize("kind", [Tracker, MotionTracker])
def test_what_comes_where_nothing_was_found_is_searched(kind: type[Tracker], model: DefocusModel) -> None:
    """Be it sharper: blurred as it is, it would become the normal sharpness of a place without anything in focus."""
    camera, blank = DefocusedCamera(clouds(3), 0.015), DefocusedCamera(np.ones((2 * SIDE, 2 * SIDE)), 0.0)
    known = (model,) if kind is MotionTracker else ()
    before = Peak(0.0, tenengrad(blank.expose(0.0)), False)
    tracker = kind(before, SearchConfig(LOW, HIGH, DEPTH), TrackConfig(), *known)
    tracker.found = False
    for number in range(60):
        image = (blank if number < 10 else camera).expose(tracker.step.curvature)
        tracker.feed(tenengrad(image), (image,), number * PERIOD)
        assert not (tracker.lost and number < 10 + 30), "nothing has come yet, or it may only pass by"
    assert tracker.lost
