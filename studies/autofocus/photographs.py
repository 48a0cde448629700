"""Parts of a real photograph through the true surface of mirrors (`python -m studies.autofocus.photographs`).

Each simulated plate is calibrated by its interferometer, hysteresis and noise included. Then it moves, without
hysteresis, as the calibrated model commands; figure, print-through and errors of the model remain. The camera of the
virtual bench sees part of a photograph; distance, exposure and start are drawn at random. Errors are those of the
defocus of the true surface.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dm_autofocus.optics import FocusOptics, depth_of_focus
from dm_autofocus.search.defocus_model import DefocusModel, FocusLens
from dm_autofocus.search.defocus_search import BEYOND
from dm_autofocus.search.focus_search import FocusSearch
from dm_autofocus.search.peak_search import NOISE_POINTS, SearchConfig
from dm_autofocus.sharpness import tenengrad
from dm_common.optics.zernike import DEFOCUS, curvature_of_defocus
from dm_controller.planning.mirror_model import CalibratedMirror
from dm_controller.planning.target import FocusTarget
from dm_simulation.camera import CameraConfig, SceneCamera
from studies.autofocus.scenes import RANGE, part_of_photograph
from studies.autofocus.trials import COARSE_STEP
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig, influence_model

#: Pixels along a side of the maps, and of the camera.
PIXELS, SIDE = 118, 192
SCENES = 15


class PhotographCamera(SceneCamera):
    """Sees a part of the photograph."""

    def _scene(self, rng: np.random.Generator) -> list[NDArray[np.float32]]:
        part = part_of_photograph(self._size, rng)
        return [(part / part.mean()).astype(np.float32)]


class Plate:
    """A calibrated mirror and its true surface."""

    def __init__(self, seed: int) -> None:
        self._bench = SimulatedBench(SimulationConfig(seed=seed, law="preisach", pixels=PIXELS))
        calibration = self._bench.calibrate()
        model = influence_model(calibration.fit, calibration.aperture_radius)
        model = replace(model, actuator_x=calibration.actuator_x, actuator_y=calibration.actuator_y)
        self._mirror = CalibratedMirror(model, self._bench.limits)
        self._seed, self._radius = seed, calibration.aperture_radius

    def _displacement(self, curvature: float) -> NDArray[np.float64]:
        return self._bench.true_stroke * self._mirror.command(FocusTarget(curvature))[0]

    def search(self, number: int) -> tuple[int, float]:
        """Number of images of one search, and its error in depths of focus; inf = it found nothing."""
        rng = np.random.default_rng((20, self._seed, number))
        dioptre, photons = rng.uniform(0.005, 0.195), float(np.exp(rng.uniform(np.log(300), np.log(30000))))
        camera = CameraConfig(width=SIDE, height=SIDE, distances=(1 / dioptre,), photons=photons)
        images = PhotographCamera(camera, 2 * self._radius, rng, rng)
        depth = depth_of_focus(self._radius, camera.wavelength)
        points = max(NOISE_POINTS, 1 + math.ceil(2 * RANGE / (COARSE_STEP * depth)))
        lens = FocusLens(self._radius, camera.wavelength, camera.focal_length / camera.pixel_pitch)
        model = DefocusModel((SIDE, SIDE), lens, 2 * RANGE + BEYOND * depth)
        config = SearchConfig(-RANGE, RANGE, depth, points, approach=0.0)
        search = FocusSearch(config, model, rng.uniform(-RANGE, RANGE))
        while not search.current.done:
            surface = self._bench._interferometer.surface(self._displacement(search.current.step.curvature))
            image = images.expose(surface)
            search.feed(tenengrad(image), (image,))
        if search.current.peak is None:
            return search.measured, math.inf
        sag = self._bench._interferometer.true_sag(self._displacement(search.current.peak.curvature))
        reached = curvature_of_defocus(self._bench.measurement_of(sag).coefficients[DEFOCUS], self._radius)
        wanted = FocusOptics.from_rest_distance(camera.rest_distance).curvature_for(dioptre)
        return search.measured, abs(reached - wanted) / depth


def main() -> None:
    """Print the figures of the plates whose seeds are given."""
    found = [plate.search(number) for plate in map(Plate, map(int, sys.argv[1:])) for number in range(SCENES)]
    images, errors = np.array(found).T
    print(f"{len(found)} scenes: {np.mean(errors <= 0.5):.0%} within half a depth of focus, {np.mean(errors <= 1):.0%}")
    print(f"within one; median {np.median(errors):.2f}, largest {errors.max():.2f}")
    print(f"images: {np.median(images):.0f}, 90 %: {np.quantile(images, 0.9):.0f}")


if __name__ == "__main__":
    main()
