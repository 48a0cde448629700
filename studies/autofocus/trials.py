"""Every search on the same scenes: images, time and error of each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dm_autofocus.search.defocus_model import DefocusModel, FocusLens
from dm_autofocus.search.defocus_search import BEYOND
from dm_autofocus.search.focus_search import FocusSearch
from dm_autofocus.search.peak_search import NOISE_POINTS, PeakSearch, SearchConfig
from dm_autofocus.sharpness import cut, tenengrad
from studies.autofocus.baselines import BASELINES, Task
from studies.autofocus.scenes import RANGE, Scene, SceneCamera, draw_scene

#: Names of our search and of its predecessor, which sweeps the range, each sweep from its low end.
OURS, BEFORE = "few images", "sweep from below"
#: Coarse step in depths of focus, as the node has it.
COARSE_STEP = 8.0
#: Time of a search: camera [images per second], from the end of an exposure to the next request [s], slew of the
#: mirror [1/m per s], and wait after it [s]. Exposures begin at a multiple of the period.
RATE, READ_OUT, SLEW, SETTLE = 30.0, 0.012, 2.5, 0.012


@dataclass(frozen=True)
class Trial:
    """One search on one scene.

    Attributes:
        method: name of the search.
        scene: the scene.
        images: number of images taken.
        seconds: that it would take at RATE images per second.
        error: of the place, in depths of focus; None = it found no focus.
        swept: only of our search: why it swept the whole range after all; "" = it did not.
    """

    method: str
    scene: Scene
    images: int
    seconds: float
    error: float | None
    swept: str = ""


class _Stage:
    """Goes to a place and takes an image there; keeps the time."""

    def __init__(self, camera: SceneCamera) -> None:
        self.camera = camera
        self.images = 0
        self.seconds = 0.0
        self._place = camera.scene.start

    def go(self, place: float) -> None:
        self.seconds += abs(place - self._place) / SLEW + SETTLE
        self._place = place

    def expose(self) -> NDArray[np.uint16]:
        self.images += 1
        self.seconds = (math.floor(self.seconds * RATE) + 1) / RATE + READ_OUT
        return cut(self.camera.expose(self._place), self.camera.region())


def search_of(scene: Scene) -> SearchConfig:
    """Configuration of the search of a scene, as the node has it when the hysteresis is known."""
    depth = scene.depth_of_focus
    points = max(NOISE_POINTS, 1 + math.ceil(2 * RANGE / (COARSE_STEP * depth)))
    return SearchConfig(-RANGE, RANGE, depth, points, approach=0.0)


def model_of(scene: Scene) -> DefocusModel:
    """Model of the camera of a scene, with the wrong parameters that the search is given."""
    assumed = FocusLens(
        scene.aperture_radius * scene.misinformed[1], scene.wavelength, scene.focal_length_px * scene.misinformed[0]
    )
    return DefocusModel((scene.region_px,) * 2, assumed, 2 * RANGE + BEYOND * scene.depth_of_focus)


def _few_images(stage: _Stage) -> tuple[float | None, str]:
    scene = stage.camera.scene
    config, model = search_of(scene), model_of(scene)
    search = FocusSearch(config, model, scene.start)
    while not search.current.done:
        stage.go(search.current.step.curvature)
        image = stage.expose()
        search.feed(tenengrad(image), (image,))
    return (search.current.peak.curvature if search.current.peak else None), search.reason


def _sweep_from_below(stage: _Stage) -> tuple[float | None, str]:
    config = search_of(stage.camera.scene)
    search = PeakSearch(SearchConfig(config.low, config.high, config.tolerance, config.coarse_points))
    while not search.done:
        stage.go(search.step.curvature)
        search.feed(tenengrad(stage.expose()) if search.step.measured else None)
    return (search.peak.curvature if search.peak else None), ""


def _baseline(name: str) -> Callable[[_Stage], tuple[float | None, str]]:
    def run(stage: _Stage) -> tuple[float | None, str]:
        scene = stage.camera.scene
        depth = scene.depth_of_focus
        search = BASELINES[name](Task(-RANGE, RANGE, scene.start, COARSE_STEP * depth, depth))
        try:
            place = next(search)
            while True:
                stage.go(place)
                place = search.send(tenengrad(stage.expose()))
        except StopIteration as end:
            return end.value, ""

    return run


METHODS: dict[str, Callable[[_Stage], tuple[float | None, str]]] = {
    OURS: _few_images,
    BEFORE: _sweep_from_below,
    **{name: _baseline(name) for name in BASELINES},
}


def run_scene(seed: int, textured: bool = True, methods: Iterable[str] = tuple(METHODS)) -> list[Trial]:
    """Every search on the scene of a seed."""
    return run_drawn(draw_scene(seed, textured), methods)


def run_drawn(scene: Scene, methods: Iterable[str] = tuple(METHODS)) -> list[Trial]:
    """Every search on one scene."""
    camera = SceneCamera(scene)
    trials = []
    for method in methods:
        stage = _Stage(camera)
        place, swept = METHODS[method](stage)
        error = None if place is None else (place - scene.object_curvature) / scene.depth_of_focus
        trials.append(Trial(method, scene, stage.images, stage.seconds, error, swept))
    return trials


def _blank(seed: int) -> list[Trial]:
    return run_scene(seed, textured=False, methods=(OURS,))


def run_scenes(seeds: Iterable[int], textured: bool, workers: int) -> Iterator[list[Trial]]:
    """`run_scene` for each seed, in processes; scenes without texture by our search only."""
    with ProcessPoolExecutor(workers) as pool:
        yield from pool.map(run_scene if textured else _blank, seeds, chunksize=1 if textured else 20)


@dataclass(frozen=True)
class Figures:
    """A method over all scenes: images and seconds (median, 90 %), then shares; see `figures_of`."""

    images: tuple[float, float]
    seconds: tuple[float, float]
    within_half: float
    within_one: float
    found: float
    gross: float
    swept: float


def figures_of(trials: list[Trial]) -> Figures:
    """Figures of one method's trials; errors count in depths of focus, `gross` = found, but more than 3 off."""
    images = np.array([trial.images for trial in trials])
    seconds = np.array([trial.seconds for trial in trials])
    errors = np.array([np.inf if trial.error is None else abs(trial.error) for trial in trials])
    return Figures(
        (float(np.median(images)), float(np.quantile(images, 0.9))),
        (float(np.median(seconds)), float(np.quantile(seconds, 0.9))),
        float(np.mean(errors <= 0.5)),
        float(np.mean(errors <= 1)),
        float(np.mean(np.isfinite(errors))),
        float(np.mean(np.isfinite(errors) & (errors > 3))),
        float(np.mean([bool(trial.swept) for trial in trials])),
    )
