"""Time out of focus while a scene changes (`python -m studies.autofocus.changing_scenes`): a table of docs/camera.md.

Each method of staying in focus begins in focus and then meets the same four seconds of a drawn scene: an object that
comes nearer, half the light from one image to the next, lamps that flicker, somebody who walks through the region.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dm_autofocus.search.focus_search import FocusSearch
from dm_autofocus.search.peak_search import Peak
from dm_autofocus.search.tracking import MotionTracker, TrackConfig, Tracker
from dm_autofocus.sharpness import cut, tenengrad
from studies.autofocus.baselines import BASELINES, Task
from studies.autofocus.scenes import RANGE, SIZE, Scene, SceneCamera, draw_scene
from studies.autofocus.trials import COARSE_STEP, RATE, READ_OUT, SETTLE, SLEW, model_of, search_of

SECONDS = 4.0
#: Infinity is in focus at -RANGE; the object comes nearer from START [m] at SPEED [m/s] until NEAREST [m].
START, SPEED, NEAREST = 9.0, 1.0, 5.2
#: When the light falls and the walker comes [s]; the walker's speed [px/s], breadth [px], and curvature in focus [1/m].
CHANGE, WALK, BROAD, WALKER = 1.0, 320.0, 120, 0.04
#: Frequency of the lamps [Hz].
FLICKER = 100.0
#: Tracking parameters, as the node has them by default.
TRACKED = TrackConfig()
KINDS = ("approach", "light", "flicker", "walker")


class Stage:
    """Takes images of a scene that changes, and keeps the time."""

    def __init__(self, seed: int, kind: str) -> None:
        drawn = draw_scene(seed)
        self.kind = kind
        at_first = _focus_on(START) if kind == "approach" else float(np.clip(drawn.object_curvature, -0.04, 0.02))
        self.scene: Scene = replace(
            drawn, object_curvature=at_first, start=at_first, background=None, contrast=max(drawn.contrast, 0.1)
        )
        self._camera = SceneCamera(self.scene)
        self._walker = SceneCamera(replace(self.scene, seed=seed + 500, object_curvature=WALKER))
        self.seconds, self.place = 0.0, at_first
        self._taken: list[tuple[float, float]] = []

    @property
    def running(self) -> bool:
        """Whether there is time left."""
        return self.seconds < SECONDS

    def focus(self, seconds: float) -> float:
        """Curvature at which the object is in focus [1/m]."""
        return _focus_on(max(START - SPEED * seconds, NEAREST)) if self.kind == "approach" else self.scene.start

    def go(self, place: float) -> None:
        """Move the mirror."""
        if place != self.place:
            self.seconds += abs(place - self.place) / SLEW + SETTLE
            self.place = place

    def expose(self) -> tuple[float, NDArray[np.float64]]:
        """Start of the next exposure [s], and the region of interest of its image."""
        begin = (math.floor(self.seconds * RATE) + 1) / RATE
        image = self._camera.expose(self.place - self.focus(begin) + self.scene.start).astype(float)
        if self.kind == "walker":
            right = (begin - CHANGE) * WALK
            left, right = (int(edge) for edge in np.clip((right - BROAD, right), 0, SIZE))
            if right > left:
                image[:, left:right] = self._walker.expose(self.place)[:, left:right]
        elif self.kind == "light" and begin > CHANGE:
            image *= 0.5
        elif self.kind == "flicker":
            image *= 1 + 0.3 * np.sin(2 * np.pi * FLICKER * begin)
        self._taken.append((begin, self.place))
        self.seconds = begin + READ_OUT
        return begin, cut(image, self._camera.region())

    def off(self) -> NDArray[np.float64]:
        """Focus error over time, in depths of focus."""
        times, places = np.array(self._taken).T
        grid = np.arange(0, SECONDS, 0.005)
        positions = places[np.minimum(np.searchsorted(times, grid), len(places) - 1)]
        return np.abs(positions - [self.focus(t) for t in grid]) / self.scene.depth_of_focus


def track(stage: Stage, by_optics: bool = True) -> None:
    """Track as the node does, by the optics or by sharpness alone."""
    config, model = search_of(stage.scene), model_of(stage.scene)

    def tracker_of(peak: Peak) -> Tracker:
        if by_optics:
            return MotionTracker(peak, config, TRACKED, model)
        return Tracker(peak, config, TRACKED)

    tracker = tracker_of(Peak(stage.scene.start, tenengrad(stage.expose()[1]), False))
    while stage.running:
        stage.go(tracker.step.curvature)
        begin, image = stage.expose()
        tracker.feed(tenengrad(image), (image,), begin)
        if tracker.lost:
            search = FocusSearch(config, model, stage.place)
            while not search.current.done and stage.running:
                stage.go(search.current.step.curvature)
                seen = stage.expose()[1]
                search.feed(tenengrad(seen), (seen,))
            tracker = tracker_of(search.current.peak or Peak(tracker.centre, tenengrad(image), False))


def search_anew(stage: Stage) -> None:
    """Keep the focus, and begin the contrast search anew when the sharpness has changed."""
    depth = stage.scene.depth_of_focus
    normal, other = tenengrad(stage.expose()[1]), 0
    while stage.running:
        sharpness = tenengrad(stage.expose()[1])
        other = other + 1 if abs(sharpness - normal) > TRACKED.drop * normal else 0
        if other < TRACKED.patience:
            continue
        search = BASELINES["contrast rules"](Task(-RANGE, RANGE, stage.place, COARSE_STEP * depth, depth))
        try:
            place = next(search)
            while stage.running:
                stage.go(place)
                place = search.send(tenengrad(stage.expose()[1]))
        except StopIteration as end:
            if end.value is not None:
                stage.go(end.value)
        normal, other = tenengrad(stage.expose()[1]), 0


WAYS: dict[str, Callable[[Stage], None]] = {
    "by the optics": track,
    "by sharpness": lambda stage: track(stage, by_optics=False),
    "contrast search anew": search_anew,
}


def out_of_focus(kind: str, way: str, seed: int) -> tuple[float, float]:
    """Shares of the time in which the focus is off by more than one, and by more than two depths of focus."""
    stage = Stage(seed, kind)
    WAYS[way](stage)
    off = stage.off()
    return float(np.mean(off > 1)), float(np.mean(off > 2))


def _focus_on(distance: float) -> float:
    return 1 / (2 * distance) - RANGE


def main() -> None:
    """Print the table. Arguments: number of scenes, then the changes to include; none = all."""
    seeds = range(4300, 4300 + int(sys.argv[1] if len(sys.argv) > 1 else 12))
    for kind in sys.argv[2:] or KINDS:
        for way in WAYS:
            one, two = 100 * np.mean([out_of_focus(kind, way, seed) for seed in seeds], axis=0)
            print(f"{kind:9s} {way:21s} off by more than 1: {one:3.0f} %, by more than 2: {two:3.0f} %", flush=True)


if __name__ == "__main__":
    main()
