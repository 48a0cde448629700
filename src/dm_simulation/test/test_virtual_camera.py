"""The virtual camera: sharp where geometry says, limited by diffraction, blurred by print-through, repeatable."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dm_simulation.camera import CameraConfig, SceneCamera
from dm_simulation.interferometer.interferometer import Interferometer, InterferometerConfig
from dm_simulation.mirror.plate import Plate, PlateConfig
from dm_simulation.virtual_bench_node import VirtualBenchNode

PUPIL = 0.022
DISTANCES = (6.0, 15.0, 0.0)
CONFIG = CameraConfig(rate=30.0, distances=DISTANCES, rest_distance=10.0)


def make(config: CameraConfig = CONFIG, seed: int = 3) -> SceneCamera:
    return SceneCamera(config, PUPIL, np.random.default_rng(seed), np.random.default_rng(seed + 1))


def sphere(curvature: float, order: int = 6) -> NDArray[np.float64]:
    """c (x^2 + y^2) / 2 in Chebyshev products: x^2 = (T_0 + T_2) / 2."""
    coefficients = np.zeros((order + 1, order + 1))
    quarter = curvature / 2 * (PUPIL / 2) ** 2 / 2
    coefficients[0, 0], coefficients[0, 2], coefficients[2, 0] = 2 * quarter, quarter, quarter
    return coefficients


def focusing(distance: float) -> float:
    """Mirror power 2 c = 1/distance - 1/rest distance."""
    return ((1 / distance if distance else 0.0) - 1 / CONFIG.rest_distance) / 2


def detail(image: NDArray[np.uint8], number: int) -> float:
    """Mean square of the differences along the middle of one object."""
    width = image.shape[1] // len(DISTANCES)
    strip = image[:, number * width + width // 4 : (number + 1) * width - width // 4].astype(float)
    return float(np.mean(np.diff(strip, axis=0) ** 2) + np.mean(np.diff(strip, axis=1) ** 2))


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(DISTANCES)))
def test_each_object_is_sharpest_at_its_own_distance(number: int) -> None:
    camera = make()
    best = focusing(DISTANCES[number])
    curvatures = best + 0.001 * np.arange(-4, 5)
    seen = [detail(camera.expose(sphere(curvature)), number) for curvature in curvatures]
    assert int(np.argmax(seen)) == 4


def test_the_wavefront_vanishes_in_focus() -> None:
    camera = make()
    for number, distance in enumerate(DISTANCES):
        wavefront = camera.wavefronts(sphere(focusing(distance)))[number]
        assert np.abs(wavefront).max() < 1e-12


def test_objects_can_be_moved_and_their_number_stays() -> None:
    camera = make()
    blurred = camera.expose(sphere(focusing(5.0)))
    camera.place((5.0, 15.0, 0.0))
    assert detail(camera.expose(sphere(focusing(5.0))), 0) > 2 * detail(blurred, 0)
    with pytest.raises(ValueError, match="must stay 3 distances"):
        camera.place((5.0,))
    node: Any = SimpleNamespace(bench=SimpleNamespace(camera=camera))
    VirtualBenchNode._check_change(node, {"camera.distances": [5.0, 15.0, 1.0]})
    with pytest.raises(ValueError, match="must stay 3 distances"):
        VirtualBenchNode._check_change(node, {"camera.distances": [5.0]})


def test_an_object_that_is_moved_during_an_exposure_is_moved_in_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = make()
    render = camera._render

    def moved_meanwhile(surface: NDArray[np.float64]) -> NDArray[np.float32]:
        image = render(surface)
        camera.place((5.0, 15.0, 0.0))
        return image

    with monkeypatch.context() as during:
        during.setattr(camera, "_render", moved_meanwhile)
        blurred = camera.expose(sphere(focusing(5.0)))
    assert detail(camera.expose(sphere(focusing(5.0))), 0) > 2 * detail(blurred, 0)


def test_a_relay_squares_the_reach() -> None:
    camera = make(replace(CONFIG, relay_magnification=2.0))
    assert np.abs(camera.wavefronts(sphere(focusing(6.0) / 4))[0]).max() < 1e-12


def test_a_quarter_wave_of_defocus_is_where_the_image_begins_to_suffer() -> None:
    """Rayleigh: at lambda / 4 the Strehl ratio is 8 / pi^2; far beyond it the detail is gone."""
    camera = make(replace(CONFIG, photons=1e9))
    best, quarter = focusing(15.0), CONFIG.wavelength / (4 * (PUPIL / 2) ** 2)
    sharp, tolerable, blurred = (detail(camera.expose(sphere(best + waves * quarter)), 1) for waves in (0.0, 1.0, 10.0))
    assert 0.6 * sharp < tolerable < sharp
    assert blurred < 0.1 * sharp


def test_print_through_blurs_too() -> None:
    """The whole surface counts, not its curvature alone."""
    camera = make(replace(CONFIG, photons=1e9))
    surface = sphere(focusing(15.0))
    bumps = surface.copy()
    bumps[4, 4] = 100e-9
    assert detail(camera.expose(bumps), 1) < 0.9 * detail(camera.expose(surface), 1)


def test_light_is_kept_whatever_the_focus() -> None:
    """Of one object that fills the picture; what crosses the edges of the picture is little."""
    camera = make(replace(CONFIG, distances=(10.0,), photons=1e9))
    means = [camera.expose(sphere(curvature)).mean() for curvature in (-0.04, 0.0, 0.04)]
    np.testing.assert_allclose(means, means[1], rtol=0.05)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_images() -> None:
    surface = sphere(0.01)
    np.testing.assert_array_equal(make().expose(surface), make().expose(surface))
    assert (make().expose(surface) != make(seed=8).expose(surface)).any()


def test_noise_is_new_in_every_image_of_a_surface_at_rest() -> None:
    camera = make()
    first, second = (camera.expose(sphere(0.01)).astype(float) for _ in range(2))
    difference = np.std(first - second) / np.sqrt(2)
    assert difference == pytest.approx(100 / np.sqrt(CONFIG.photons), rel=0.2)


def test_pixels_too_coarse_for_the_diffraction_are_refused() -> None:
    with pytest.raises(ValueError, match=r"camera\.pixel_pitch"):
        make(replace(CONFIG, pixel_pitch=10e-6))


def test_a_scene_without_objects_is_refused() -> None:
    with pytest.raises(ValueError, match=r"camera\.distances"):
        make(replace(CONFIG, distances=()))


def test_the_surface_handed_to_it_is_what_the_interferometer_sees() -> None:
    quiet = InterferometerConfig(
        pixels=64, pixel_noise=0.0, low_order_noise=0.0, piston_spread=0.0, tilt_spread=0.0, specks=0, blobs=0
    )
    instrument = Interferometer(quiet, Plate(PlateConfig(order=14)), np.random.default_rng(1), np.random.default_rng(2))
    displacement = 1e-6 * np.random.default_rng(3).standard_normal(37)
    centres = (2 * np.arange(64) + 1) / 64 - 1
    surface = instrument.surface(displacement)
    wanted = np.polynomial.chebyshev.chebgrid2d(centres[::-1], centres, surface)  # row 0 = top
    measured = instrument.measure(displacement)
    inside = np.isfinite(measured)
    np.testing.assert_allclose(measured[inside], wanted[inside], atol=1e-12)
