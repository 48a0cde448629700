"""Edge-clustered and uniform sampling points against the full map."""

from __future__ import annotations

import numpy as np
import pytest

from dm_calibration.optics.aperture import Aperture
from dm_common.optics.zernike import basis
from studies.paper.sampling_study import SamplingStudy, study_sampling

NM = 1e-9
SIZE = 472
APERTURE = Aperture((SIZE - 1) / 2, (SIZE - 1) / 2, SIZE / 2)


def coordinates() -> tuple[np.ndarray, np.ndarray]:
    row, column = np.mgrid[:SIZE, :SIZE]
    return (column - APERTURE.centre_x_px) / APERTURE.radius_px, (APERTURE.centre_y_px - row) / APERTURE.radius_px


def bumpy_surfaces(count: int, seed: int) -> np.ndarray:
    """Surfaces of bumps an actuator spacing wide: content beyond 21 terms, up to and over the rim."""
    random = np.random.default_rng(seed)
    x, y = coordinates()
    places = random.uniform(-1.1, 1.1, (count, 8, 2))
    bumps = np.exp(-((x - places[..., 0, None, None]) ** 2 + (y - places[..., 1, None, None]) ** 2) / (2 * 0.22**2))
    sag = 500 * NM * np.einsum("sb,sbhw->shw", random.choice([-1.0, 1.0], (count, 8)), bumps)
    return np.where(APERTURE.disc((SIZE, SIZE)), sag, np.nan)


@pytest.fixture(scope="module")
def study() -> SamplingStudy:
    return study_sampling(bumpy_surfaces(4, 1), APERTURE, 1 * NM, np.random.default_rng(2), dropout=1e-3, draws=30)


@pytest.mark.slow
def test_every_pixel_beats_points_and_area_weights_beat_none(study: SamplingStudy) -> None:
    bias = {name: result.bias_rms for name, result in study.results.items()}
    assert study.beyond_rms > 10 * NM
    assert bias["full map"] < 0.1 * bias["edge-clustered, area-weighted"]
    assert bias["edge-clustered, area-weighted"] < bias["uniform"]
    assert bias["edge-clustered, area-weighted"] < 0.3 * bias["edge-clustered"]


def test_edge_clustered_points_follow_the_rim_at_the_cost_of_the_rest(study: SamplingStudy) -> None:
    clustered, uniform = study.results["edge-clustered"], study.results["uniform"]
    assert clustered.rim_error_rms < uniform.rim_error_rms
    assert clustered.bias_rms > uniform.bias_rms
    for result in study.results.values():
        assert 0.0 < result.rim_ringing_rms < result.rim_ringing_peak


def test_noise_is_that_of_independent_samples(study: SamplingStudy) -> None:
    """Terms orthogonal over the disc: each of the 18 beyond tilt takes 1/n of the noise energy of n samples."""
    full, uniform = study.results["full map"], study.results["uniform"]
    assert full.noise_rms == pytest.approx(1 * NM * np.sqrt(18 / full.samples), rel=0.15)
    assert uniform.noise_rms == pytest.approx(0.5 * NM * np.sqrt(18 / uniform.samples), rel=0.15)  # mean of 4 pixels
    assert full.samples > 100 * uniform.samples


def test_surfaces_of_21_terms_have_no_bias() -> None:
    random = np.random.default_rng(5)
    truth = 100 * NM * random.standard_normal((3, 21))
    x, y = coordinates()
    surfaces = np.moveaxis(basis(x, y) @ truth.T, -1, 0)
    study = study_sampling(surfaces, APERTURE, 0.0, random, truth=truth, draws=2)
    assert study.beyond_rms < 1e-6 * NM
    assert study.results["full map"].bias_rms < 1e-6 * NM
    inside = APERTURE.disc((SIZE, SIZE))
    steepest = max(float(np.hypot(*np.gradient(surface))[inside].max()) for surface in surfaces)
    for result in study.results.values():
        # The plain mean of four neighbours is the sag in the middle of them, up to half a pixel away in x and in y.
        assert result.bias_rms < np.sqrt(0.5) * steepest
        assert (result.noise == 0.0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixel_noise": -1.0}, "pixel_noise = -1 m: must be 0 or more"),
        ({"dropout": 1.0}, "dropout = 1: must be at least 0 and below 1"),
        ({"draws": 1}, "draws = 1: a standard deviation needs at least 2"),
        ({"count": 20}, "count = 20 sampling points for 21 terms"),
        ({"truth": np.zeros((3, 21))}, r"truth has the shape \(3, 21\): must be \(2, 21\)"),
        ({"surfaces": np.zeros((SIZE, SIZE))}, r"must be \(surfaces, height, width\)"),
    ],
)
def test_bad_arguments_are_refused(changes: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {"surfaces": bumpy_surfaces(2, 3), "pixel_noise": NM, **changes}
    surfaces, noise = arguments.pop("surfaces"), arguments.pop("pixel_noise")
    with pytest.raises(ValueError, match=message):
        study_sampling(surfaces, APERTURE, noise, np.random.default_rng(1), **arguments)  # type: ignore[arg-type]


def test_surfaces_with_different_masks_are_refused() -> None:
    surfaces = bumpy_surfaces(2, 3)
    surfaces[1, 200, 200] = np.nan
    with pytest.raises(ValueError, match="give surfaces that share one mask"):
        study_sampling(surfaces, APERTURE, NM, np.random.default_rng(1))
