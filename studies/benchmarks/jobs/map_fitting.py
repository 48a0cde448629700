"""Fit of the 21 terms to every pixel, and rms values of the ten regions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dm_calibration.optics.map_fit import MapFitter
from dm_common import Floats
from dm_common.optics.sample_regions import AREA_FRACTIONS
from dm_common.optics.zernike import TERMS, basis, to_born_wolf
from studies.benchmarks.sample_maps import CAMERA, CyclicMaps, full_aperture, maps, mask_of
from studies.benchmarks.timing import Effort, medians
from studies.paper.regions import ConcentricRegions, residual_map, squared_distance

Fit = Callable[[Floats], Floats]

#: Number of maps used in turn: together larger than the last-level cache of most processors.
MAPS = 16


def measure(effort: Effort, rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figures `zernike_fit`, `new_mask_fit` and `regions`; times in ms."""
    generator = np.random.default_rng(944)
    some, mask = maps(CAMERA, MAPS, generator)
    aperture = full_aperture(CAMERA)
    centre, radius = aperture.centre_x_px, aperture.radius_px
    fitter = MapFitter(mask, centre, centre, radius)
    fits: dict[str, Fit] = {"fit": lambda sag: fitter.fit(sag).coefficients, "lstsq": _numpy_fit(mask)}
    fits |= {name: make(mask, rivals[name]) for name, make in _RIVALS.items() if name in rivals}

    cycle, read, other = CyclicMaps(some), CyclicMaps(some, MAPS // 2), CyclicMaps(some)
    jobs: dict[str, Callable[[], object]] = {
        "fit": lambda: fits["fit"](cycle()),
        "read": lambda: _read(read()),
    }
    jobs |= {name: partial(_fit_next, fit, other) for name, fit in fits.items() if name != "fit"}
    slow = {name: effort.slow_rounds for name in fits if name != "fit"}
    seconds = medians(jobs, effort.rounds, slow)
    # Timed on its own: the maps of the others would push this one out of the cache.
    in_cache = medians({"fit": lambda: fits["fit"](some[0])}, effort.rounds)["fit"]
    in_cache_read = medians({"read": lambda: _read(some[0])}, effort.rounds)["read"]
    exact = fits["lstsq"](some[0])
    differences = {name: float(np.abs(fit(some[0]) - exact).max() / np.abs(exact).max()) for name, fit in fits.items()}
    figures: dict[str, Any] = {
        "pixels": fitter.valid_pixels,
        "ms": 1e3 * seconds["fit"],
        "memory_read_ms": 1e3 * seconds["read"],
        "in_cache_ms": 1e3 * in_cache,
        "in_cache_read_ms": 1e3 * in_cache_read,
        "max_rel_diff": differences["fit"],
    }
    for name in ("lstsq", *_RIVALS):
        figures[f"{name}_ms"] = 1e3 * seconds[name] if name in seconds else None
        figures[f"{name}_max_rel_diff"] = differences.get(name)
    return {
        "zernike_fit": figures,
        "new_mask_fit": _new_mask(effort, generator),
        "regions": _regions(effort, fitter, some),
    }


def _fit_next(fit: Fit, cycle: CyclicMaps) -> Floats:
    return fit(cycle())


def _read(sag: Floats) -> float:
    """Read every byte once, at the full speed of the linear algebra library."""
    return float(np.vdot(sag, sag))


def _new_mask(effort: Effort, generator: np.random.Generator) -> dict[str, Any]:
    """A map whose dropouts were never seen before: mask and fit together."""
    centre, radius = (CAMERA - 1) / 2, CAMERA / 2
    base, _mask = maps(CAMERA, 1, generator)
    several = [np.where(mask_of(CAMERA, generator), base[0], np.nan) for _ in range(MAPS // 2)]
    cycle = CyclicMaps(several)

    def fit() -> Floats:
        sag = cycle()
        return MapFitter(np.isfinite(sag), centre, centre, radius).fit(sag).coefficients

    return {"ms": 1e3 * medians({"fit": fit}, effort.rounds)["fit"]}


def _regions(effort: Effort, fitter: MapFitter, some: list[Floats]) -> dict[str, Any]:
    residuals = [residual_map(sag, fitter.fit(sag).coefficients, fitter.aperture) for sag in some[:4]]
    shape, aperture = residuals[0].shape, fitter.aperture
    regions = ConcentricRegions(shape, aperture)
    discs = [squared_distance(aperture, shape) <= fraction for fraction in AREA_FRACTIONS]
    ours, theirs = CyclicMaps(residuals), CyclicMaps(residuals)

    def ten_passes() -> Floats:
        residual = theirs()
        inside = (residual[disc & np.isfinite(residual)] for disc in discs)
        return np.array([np.sqrt(np.mean(values**2)) for values in inside])

    seconds = medians(
        {"one": lambda: regions.rms(ours()), "ten": ten_passes}, effort.rounds, {"ten": effort.slow_rounds}
    )
    return {"ms": 1e3 * seconds["one"], "ten_passes_ms": 1e3 * seconds["ten"]}


# --- the same with other programs; what depends on the mask alone is prepared beforehand, as far as they allow it


def _unit_grid() -> tuple[Floats, Floats]:
    axis = (np.arange(CAMERA) - (CAMERA - 1) / 2) / (CAMERA / 2)
    x, y = np.meshgrid(axis, -axis)
    return x, y


def _numpy_fit(mask: NDArray[np.bool_]) -> Fit:
    x, y = _unit_grid()
    modes = basis(x[mask], y[mask])
    return lambda sag: np.asarray(np.linalg.lstsq(modes, sag[mask], rcond=None)[0], dtype=float)


def _prysm_fit(mask: NDArray[np.bool_], polynomials: Any) -> Fit:
    """prysm's lstsq: it gathers the valid pixels of its modes anew for every map."""
    x, y = _unit_grid()
    orders = [(term.n, -term.m if term.kind == "sin" else term.m) for term in TERMS]
    modes = np.array(list(polynomials.zernike_nm_sequence(orders, np.hypot(x, y), np.arctan2(y, x), norm=False)))
    return lambda sag: np.asarray(polynomials.lstsq(modes, sag))


def _hcipy_fit(mask: NDArray[np.bool_], hcipy: Any) -> Fit:
    x, y = _unit_grid()
    grid = hcipy.CartesianGrid(hcipy.UnstructuredCoords([x[mask], y[mask]]))
    modes = hcipy.make_zernike_basis(len(TERMS), 2.0 + 1e-9, grid)
    return lambda sag: to_born_wolf(modes.coefficients_for(sag[mask]), "noll")


def _zernike_fit(mask: NDArray[np.bool_], zernike: Any) -> Fit:
    """RZern of the package zernike: normal equations over the pixels of the unit disc."""
    terms = zernike.RZern(5)
    terms.make_cart_grid(*_unit_grid())
    return lambda sag: to_born_wolf(terms.fit_cart_grid(sag)[0], "noll")


_RIVALS: dict[str, Callable[[NDArray[np.bool_], Any], Fit]] = {
    "prysm": _prysm_fit,
    "hcipy": _hcipy_fit,
    "zernike": _zernike_fit,
}
