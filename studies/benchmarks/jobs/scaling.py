"""How time and memory grow with the number of actuators and with the pixels of a map."""

from __future__ import annotations

import time
import tracemalloc
from types import ModuleType
from typing import Any

import numpy as np

from dm_calibration.influence.regression import Design, least_squares
from dm_calibration.optics.map_fit import MapFitter
from studies.benchmarks.jobs.bounded_solve import problem, targets
from studies.benchmarks.sample_maps import full_aperture, mask_of, surface
from studies.benchmarks.timing import Effort, medians

#: Full hexagons; 3 997 is the one closest to 4 000.
ACTUATORS = (37, 127, 469, 1027, 3997)
#: Largest mirror for which saturated commands and the regression are measured: beyond it they take minutes.
FITTED_ACTUATORS = 1027
PIXELS = (256, 512, 944, 2048, 4096)
#: Values fitted per map: 21 coefficients and 500 points.
RESPONSES = 521


def measure(effort: Effort, _rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figure `scaling`: one entry per size, and the slopes of the log-log plot."""
    actuators = [_actuators(count, effort) for count in (ACTUATORS[:2] if effort.quick else ACTUATORS)]
    pixels = [_pixels(side, effort) for side in (PIXELS[:3] if effort.quick else PIXELS)]
    return {"scaling": [*actuators, *pixels], "slopes": _slopes(actuators, pixels)}


def _actuators(count: int, effort: Effort) -> dict[str, Any]:
    generator = np.random.default_rng(count)
    tracemalloc.start()
    started = time.perf_counter()
    task = problem(count)
    seconds, peak = time.perf_counter() - started, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    entry: dict[str, Any] = {"actuators": count, "prepare_ms": 1e3 * seconds, "memory_mb": peak / 1e6}
    wanted = targets(task, (0.3e-6, 0.5e-6), 1, generator)[0]
    rounds = effort.rounds if count < 500 else 5
    entry["solve_inside_ms"] = 1e3 * medians({"x": lambda: task.programme.solve(wanted)}, rounds)["x"]
    if count > FITTED_ACTUATORS:
        return entry
    deep = targets(task, (3e-6, 3e-6), 1, generator)[0]
    entry["solve_saturated_ms"] = 1e3 * medians({"x": lambda: task.programme.solve(deep)}, min(rounds, 15))["x"]
    design = np.column_stack([np.ones(2 * count + 1), generator.uniform(-1, 1, (2 * count + 1, count))])
    responses = generator.normal(size=(len(design), RESPONSES))
    whole = Design(design, 1, np.ones(count, dtype=bool))
    entry["fit_ms"] = 1e3 * medians({"x": lambda: least_squares(whole, responses)}, 9 if count < 500 else 2)["x"]
    return entry


def _pixels(side: int, effort: Effort) -> dict[str, Any]:
    generator = np.random.default_rng(side)
    mask, aperture = mask_of(side, generator), full_aperture(side)
    sag = np.where(mask, surface(side, generator), np.nan)
    circle = (aperture.centre_x_px, aperture.centre_y_px, aperture.radius_px)
    tracemalloc.start()
    fitter = MapFitter(mask, *circle)
    fitter.fit(sag)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    jobs = {"fit": lambda: fitter.fit(sag), "new": lambda: MapFitter(mask, *circle).fit(sag)}
    seconds = medians(jobs, effort.rounds if side < 1000 else 9)
    return {
        "pixels": side,
        "map_fit_ms": 1e3 * seconds["fit"],
        "new_mask_fit_ms": 1e3 * seconds["new"],
        "memory_mb": peak / 1e6,
        "map_mb": sag.nbytes / 1e6,
    }


def _slopes(actuators: list[dict[str, Any]], pixels: list[dict[str, Any]]) -> dict[str, float]:
    """Exponents of growth: in the number of actuators, and in the number of pixels of the whole map."""
    slopes = {}
    for name in ("solve_inside_ms", "solve_saturated_ms", "fit_ms", "memory_mb"):
        slopes[f"actuators_{name}"] = _slope([(e["actuators"], e[name]) for e in actuators if name in e])
    for name in ("map_fit_ms", "new_mask_fit_ms", "memory_mb"):
        slopes[f"pixels_{name}"] = _slope([(e["pixels"] ** 2, e[name]) for e in pixels])
    return slopes


def _slope(points: list[tuple[float, float]]) -> float:
    size, value = np.log(np.array(points)).T
    return float(np.polyfit(size, value, 1)[0])
