"""How far 21 coefficients depend on where a map is sampled: edge-clustered and uniform points against every pixel.

The paper (section 2.2) fits 500 edge-clustered points instead of some 700 000 pixels and cites [5] for less
ringing at the edge than with uniform points. Three errors distinguish the ways of sampling:

* bias: content beyond the 21 terms leaks into them, since the terms are orthogonal over the disc but not over points;
  and the plain mean of four neighbours is the sag up to half a pixel from the point;
* noise: of a pixel, averaged over four neighbours at each point, or over all pixels;
* ringing at the rim: the deviation of the fitted terms from the best ones, that is the bias where polynomials are
  steepest.

Plain least squares over edge-clustered points counts the rim several times: it follows the surface there better than
any other way, and gives worse coefficients of the whole aperture. Weighted by the areas that they represent, the same
points give the least bias of all ways with as few samples. Every fit is linear in the map, so bias is measured on maps
without noise and noise on maps without a surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dm_calibration.optics.aperture import Aperture
from dm_calibration.optics.map_fit import MapFitter
from dm_common import Floats
from dm_common.optics.sampling import GOLDEN_ANGLE, SamplePoints, edge_clustered_points, sample_map
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS, TERMS, basis
from dm_simulation.interferometer.interferometer import InterferometerConfig
from studies.paper.regions import residual_map, squared_distance
from studies.paper.samples import Samples

#: Every STRIDE-th surface of Table 1 is studied: pokes, spheres and Zernike surfaces are among them.
STRIDE = 6
#: Number of noise maps of the study on simulated surfaces.
DRAWS = 10
#: Share of the aperture's area, outermost, that counts as the rim.
RIM_SHARE = 0.1


def uniform_points(count: int) -> SamplePoints:
    """Points of equal area (a sunflower spiral), to compare with the edge-clustered ones."""
    k = np.arange(count)
    radius, angle = np.sqrt((k + 0.5) / count), GOLDEN_ANGLE * k
    return SamplePoints(radius * np.cos(angle), radius * np.sin(angle), np.full(count, 1 / count))


def rms_of(coefficients: Floats) -> Floats:
    """(...) rms sag over the disc, piston and tilt left out, of Born & Wolf coefficients (..., 21)."""
    return np.asarray(np.linalg.norm((coefficients * TERM_RMS)[..., PISTON_TILT:], axis=-1))


@dataclass(frozen=True, eq=False)
class SamplingResult:
    """Errors of one way of sampling, m.

    Attributes:
        name: of the way.
        samples: number of points or pixels with data.
        bias: (21,) systematic error of each coefficient, rms over the surfaces.
        noise: (21,) standard deviation of each coefficient by pixel noise.
        bias_rms, noise_rms: the same as rms sag over the disc, piston and tilt left out.
        rim_ringing_rms, rim_ringing_peak: fitted less true 21 terms on the rim: rms over rim and surfaces, and
            largest absolute value.
        rim_error_rms: surface less fitted terms on the rim, including what the 21 terms cannot follow.
    """

    name: str
    samples: int
    bias: Floats
    noise: Floats
    bias_rms: float
    noise_rms: float
    rim_ringing_rms: float
    rim_ringing_peak: float
    rim_error_rms: float


@dataclass(frozen=True)
class SamplingStudy:
    """All ways of sampling on the same surfaces.

    Attributes:
        results: by name: "full map", "edge-clustered", "edge-clustered, area-weighted", "uniform".
        surfaces: number of surfaces.
        beyond_rms: rms sag beyond the true 21 terms, over the surfaces, m.
        pixel_noise: m.
        draws: number of noise maps.
    """

    results: dict[str, SamplingResult]
    surfaces: int
    beyond_rms: float
    pixel_noise: float
    draws: int


def study_sampling(
    surfaces: Floats,
    aperture: Aperture,
    pixel_noise: float,
    rng: np.random.Generator,
    *,
    truth: Floats | None = None,
    dropout: float = 0.0,
    draws: int = 20,
    count: int = 500,
) -> SamplingStudy:
    """Compare the ways of sampling on given surfaces.

    Args:
        surfaces: (S, height, width) noise-free sag, m; NaN = no data.
        pixel_noise: standard deviation of white noise per pixel, m.
        rng: draws noise and dropouts.
        truth: (S, 21) coefficients that count as true, m; None = the fit to all pixels of the noise-free surface before
            dropouts: the only bias of the full map is then that of the dropouts.
        dropout: share of pixels lost at random, 0 to below 1.
        draws: noise maps, at least 2.
        count: sampling points, at least as many as terms.

    Raises:
        ValueError: an argument out of its range, or surfaces whose data differ in place.
        InsufficientDataError: the pixels do not determine the terms.
    """
    _check(surfaces, pixel_noise, truth, dropout, draws, count)
    valid = np.isfinite(surfaces[0]) & aperture.disc(surfaces.shape[1:])
    if any((np.isfinite(surface) & aperture.disc(surface.shape) != valid).any() for surface in surfaces[1:]):
        raise ValueError("surfaces: data are missing at different pixels; give surfaces that share one mask")
    where = (aperture.centre_x_px, aperture.centre_y_px, aperture.radius_px)
    whole = MapFitter(valid, *where)
    fits = [whole.fit(np.where(valid, surface, 0.0)) for surface in surfaces]
    true = np.stack([fit.coefficients for fit in fits]) if truth is None else truth

    kept = valid & (rng.random(valid.shape) >= dropout)
    ways = _ways(kept, aperture, count)
    measured = [np.where(kept, surface, np.nan) for surface in surfaces]
    noise_maps = (np.where(kept, pixel_noise * rng.standard_normal(kept.shape), np.nan) for _ in range(draws))
    scatter: dict[str, list[Floats]] = {name: [] for name in ways}
    for noise_map in noise_maps:
        for name, (fit, _samples) in ways.items():
            scatter[name].append(fit(noise_map))

    rim = valid & (squared_distance(aperture, valid.shape) >= 1.0 - RIM_SHARE)
    row, column = np.nonzero(rim)
    rim_terms = basis(
        (column - aperture.centre_x_px) / aperture.radius_px, (aperture.centre_y_px - row) / aperture.radius_px
    )
    rim_sag = np.stack([surface[rim] for surface in surfaces])
    results = {}
    for name, (fit, samples) in ways.items():
        coefficients = np.stack([fit(surface) for surface in measured])
        error = coefficients - true
        noise = np.sqrt(np.mean(np.square(scatter[name]), axis=0))
        ringing = error @ rim_terms.T
        results[name] = SamplingResult(
            name=name,
            samples=samples,
            bias=np.sqrt(np.mean(np.square(error), axis=0)),
            noise=noise,
            bias_rms=float(np.sqrt(np.mean(np.square(rms_of(error))))),
            noise_rms=float(rms_of(noise)),
            rim_ringing_rms=_rms(ringing),
            rim_ringing_peak=float(np.abs(ringing).max()),
            rim_error_rms=_rms(rim_sag - coefficients @ rim_terms.T),
        )
    beyond = [residual_map(surface, c, aperture)[valid] for surface, c in zip(surfaces, true, strict=True)]
    return SamplingStudy(results, len(surfaces), _rms(np.stack(beyond)), pixel_noise, draws)


def _ways(kept: NDArray[np.bool_], aperture: Aperture, count: int) -> dict[str, tuple[Callable[[Floats], Floats], int]]:
    """For each way of sampling, the fit (map -> 21 coefficients) and the number of samples that it uses."""
    where = (aperture.centre_x_px, aperture.centre_y_px, aperture.radius_px)
    full = MapFitter(kept, *where)
    clustered, uniform = edge_clustered_points(count), uniform_points(count)

    def at(points: SamplePoints, weight: Floats) -> tuple[Callable[[Floats], Floats], int]:
        # Noise and surface maps lack the same pixels, so one operator serves all of them.
        seen = np.isfinite(sample_map(np.where(kept, 0.0, np.nan), *where, points))
        if seen.sum() < len(TERMS):
            raise ValueError(f"{seen.sum()} sampling points with data for {len(TERMS)} terms: lower dropout")
        root = np.sqrt(weight[seen])
        operator = np.linalg.pinv(root[:, np.newaxis] * basis(points.x[seen], points.y[seen])) * root
        return (lambda sag: operator @ sample_map(sag, *where, points)[seen]), int(seen.sum())

    return {
        "full map": ((lambda sag: full.fit(np.where(kept, sag, 0.0)).coefficients), full.valid_pixels),
        "edge-clustered": at(clustered, np.ones(count)),  # the paper's: plain least squares over the points
        "edge-clustered, area-weighted": at(clustered, clustered.weight),
        "uniform": at(uniform, uniform.weight),
    }


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _check(surfaces: Floats, pixel_noise: float, truth: Floats | None, dropout: float, draws: int, count: int) -> None:
    if surfaces.ndim != 3 or not len(surfaces):
        raise ValueError(f"surfaces has the shape {surfaces.shape}: must be (surfaces, height, width), at least one")
    if not (np.isfinite(pixel_noise) and pixel_noise >= 0.0):
        raise ValueError(f"pixel_noise = {pixel_noise:g} m: must be 0 or more")
    if truth is not None and truth.shape != (len(surfaces), len(TERMS)):
        raise ValueError(f"truth has the shape {truth.shape}: must be ({len(surfaces)}, {len(TERMS)})")
    if not 0.0 <= dropout < 1.0:
        raise ValueError(f"dropout = {dropout:g}: must be at least 0 and below 1")
    if draws < 2:
        raise ValueError(f"draws = {draws}: a standard deviation needs at least 2")
    if count < len(TERMS):
        raise ValueError(f"count = {count} sampling points for {len(TERMS)} terms: at least {len(TERMS)} are needed")


def study_samples(samples: Samples) -> SamplingStudy:
    """Set surfaces of Table 1 on a copy of the simulation and sample their noise-free maps in all ways.

    The pixel noise is the instrument's; the draws of noise follow from the simulation's seed.
    """
    bench = samples.bench.fork()
    surfaces = []
    for label in samples.labels[::STRIDE]:
        bench.apply(samples.calibration.maps.applied[samples.row(label)])
        bench.settle()
        surfaces.append(bench.true_map())
    return study_sampling(
        np.stack(surfaces),
        bench.aperture,
        InterferometerConfig().pixel_noise,
        np.random.default_rng(bench.config.seed),
        draws=DRAWS,
        count=bench.config.samples,
    )
