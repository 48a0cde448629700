"""Accuracy of the depth image over distance (`python -m studies.autofocus.stacks`): the table of docs/camera.md.

The simulated camera of the virtual bench sees objects side by side through a mirror with exactly the requested
curvature; its stacks go through the same code as those of the node.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dm_autofocus.focus_stack import ImageStack
from dm_autofocus.optics import FocusOptics, depth_of_focus
from dm_simulation.camera import CameraConfig, SceneCamera

DISTANCES = (5.5, 7.0, 10.0, 15.0, 30.0, 60.0)
REST_DISTANCE, RADIUS, RANGE = 10.0, 0.011, 0.05
#: Side of an object [px], and the margin at its edges that is left out: blurred neighbours reach into it.
SIDE, EDGE = 120, 24
CELL, LEAST_CONTRAST = 4, 0.05


@dataclass(frozen=True)
class Depth:
    """Result of a stack for one object.

    Attributes:
        distance: true [m].
        share: of its cells that have a distance.
        found: their median [m].
        errors: median and 90th percentile of the absolute errors of the focus, in depths of focus.
        relative: 90th percentile of the absolute relative errors of distance.
    """

    distance: float
    share: float
    found: float
    errors: tuple[float, float]
    relative: float


def depths(photons: float, step: float, seed: int = 0, distances: Sequence[float] = DISTANCES) -> Iterator[Depth]:
    """The objects of one scene.

    Args:
        photons: electrons per pixel.
        step: between images, in depths of focus.
        seed: of textures and noise.
        distances: of the objects [m].
    """
    width = SIDE * len(distances)
    config = CameraConfig(width=width, height=SIDE, rest_distance=REST_DISTANCE, distances=distances, photons=photons)
    camera = SceneCamera(config, 2 * RADIUS, np.random.default_rng(seed), np.random.default_rng(seed + 1))
    optics, depth_of = FocusOptics.from_rest_distance(REST_DISTANCE), depth_of_focus(RADIUS)
    stack = ImageStack(CELL)
    # (x^2 + y^2) c / 2 over the square around the pupil, in Chebyshev polynomials.
    bowl = np.array([[1.0, 0.0, 0.5], [0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]) * RADIUS**2 / 2
    for curvature in np.linspace(-RANGE, RANGE, 1 + math.ceil(2 * RANGE / (step * depth_of))):
        image = camera.expose(curvature * bowl)
        stack.add(float(curvature), image, image)
    places = stack.in_focus(LEAST_CONTRAST)
    edge, side = EDGE // CELL, SIDE // CELL
    for number, distance in enumerate(distances):
        own = places[edge:-edge, number * side + edge : (number + 1) * side - edge]
        found = own[np.isfinite(own)]
        off = np.abs(found - optics.curvature_for(1 / distance)) / depth_of
        seen = optics.distances_for(found)
        relative = float(np.quantile(np.abs(seen / distance - 1), 0.9))
        errors = float(np.median(off)), float(np.quantile(off, 0.9))
        yield Depth(distance, found.size / own.size, float(np.median(seen)), errors, relative)


def main() -> None:
    """Print the table."""
    for photons in (5000.0, 300.0):
        for step in (2.0, 4.0, 6.0):
            for depth in depths(photons, step):
                print(
                    f"{photons:6.0f} e-  step {step:g}  {depth.distance:5.1f} m: {100 * depth.share:4.0f} %  "
                    f"{depth.found:7.2f} m  {depth.errors[0]:.2f} / {depth.errors[1]:.2f} depths of focus  "
                    f"{100 * depth.relative:.1f} %"
                )


if __name__ == "__main__":
    main()
