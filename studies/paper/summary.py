"""The run's numbers for the JSON file; lengths in nm with the unit in the name."""

from __future__ import annotations

from typing import Any

import numpy as np

from dm_common.optics.sample_regions import AREA_FRACTIONS
from studies.paper import reported
from studies.paper.control import Series, share_within
from studies.paper.page.content_coefficients import MARKS
from studies.paper.readings import ReadRegression
from studies.paper.regions import RegionStatistics
from studies.paper.regressions import LEVEL, TAKEN
from studies.paper.results import BenchResults, Results
from studies.paper.sampling_study import SamplingStudy

NM = 1e9


def figures_of(results: Results) -> dict[str, Any]:
    """All figures: those of the standard bench on top, those of ideal actuators under `ideal`."""
    config = results.options.bench
    return {
        "seed": config.seed,
        "plant": config.law,
        "hysteresis": config.hysteresis,
        "creep_per_decade": config.creep,
        "pixels": config.pixels,
        "reading": TAKEN.value,
        **_bench(results.standard),
        "ideal": _bench(results.ideal),
        "table3_other_seeds": _over_seeds(results),
        "table3_other_laws": {
            law: {model: _by_surface(errors) for model, errors in models.items()}
            for law, models in results.over_laws.items()
        },
        "sampling": _sampling(results.sampling),
        "control_other_laws": {
            law: {reading: _series(series) for reading, series in by_reading.items()}
            for law, by_reading in results.law_spheres.items()
        },
        "paper": {
            "table2": {model: row._asdict() for model, row in reported.TABLE_2.items()},
            "table3": {
                name: {model: pair._asdict() for model, pair in pairs.items()}
                for name, pairs in reported.TABLE_3.items()
            },
        },
    }


def _bench(bench: BenchResults) -> dict[str, Any]:
    samples, regressions = bench.samples, bench.regressions
    weighting = samples.weighting
    return {
        "table2": _table_2(regressions.taken),
        "table2_readings": {reading.value: _table_2(models) for reading, models in regressions.by_reading.items()},
        "table3": _table_3(regressions.taken),
        "table3_readings": {reading.value: _table_3(models) for reading, models in regressions.by_reading.items()},
        "shuffled_significant": regressions.shuffled_below(LEVEL),
        "regions": _regions(samples.actuator_surfaces) | {"zernike": _regions(samples.zernike_surfaces)},
        "regions_readings": {name: _regions(panel) for name, panel in samples.readings.items()},
        "linearity": {
            group: {"rate_nm": line.rate * NM, "departure_pct": 100.0 * line.departure, "r2": line.r2}
            for group, line in samples.linearity.items()
        },
        "weights_cancel_max_abs": samples.weights_cancel,
        "weights": {
            "epsilon_nm2": weighting.epsilon * NM**2,
            "chosen": weighting.weights.tolist(),
            "at_median": samples.median_weights.tolist(),
            "held_out_nm": float(weighting.score.min()) * NM,
            "held_out_unweighted_nm": weighting.score_unweighted * NM,
        },
        "control": _control(bench),
        "aspheres": {
            method: [
                {
                    "curvature": shot.target.curvature,
                    "conic_constant": shot.target.conic_constant,
                    "added_zernike": bool(shot.target.zernike),
                    "max_zernike_nm": shot.max_zernike * NM,
                    "rms_nm": shot.rms * NM,
                }
                for shot in series.shots
            ]
            for method, series in bench.aspheres.items()
        },
        "branch_spread_nm": bench.branch_spread * NM,
        "map_noise_nm": bench.samples.noise * NM,
        "fitting_limit_nm": bench.limit_rms * NM,
    }


def _table_2(models: dict[str, ReadRegression]) -> dict[str, Any]:
    result = {}
    for model in reported.MODELS:
        row = models[model].table2
        result[model] = {
            "adj_r2": row.adjusted_r2,
            "f": row.f_statistic,
            "p": row.p_value,
            "n": row.n,
            "k": row.k,
            "held_out_rms_nm": row.leave_one_out_rms * NM,
            "in_sample_rms_nm": row.in_sample_rms * NM,
            "test_rms_nm": row.test_rms * NM,
        }
    return result


def _table_3(models: dict[str, ReadRegression]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for model in reported.MODELS:
        for row in models[model].table3:
            result.setdefault(row.surface, {})[model] = {
                "err_nm": row.error * NM,
                "rel_err_pct": 100.0 * row.relative_error,
                "actual_nm": row.actual * NM,
                "predicted_nm": row.predicted * NM,
                "lower_nm": row.lower * NM,
                "upper_nm": row.upper * NM,
            }
    return result


def _regions(panel: RegionStatistics) -> dict[str, Any]:
    return {
        "area_pct": [100.0 * share for share in AREA_FRACTIONS],
        "mean_nm": (panel.mean * NM).tolist(),
        "variance_nm2": (panel.variance * NM**2).tolist(),
    }


def _control(bench: BenchResults) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for (method, reading), series in bench.spheres.items():
        result.setdefault(method, {})[reading] = _series(series)
    return result


def _series(series: Series) -> dict[str, Any]:
    return {
        "curvature": [shot.target.curvature for shot in series.shots],
        "max_zernike_nm": (series.max_zernike * NM).tolist(),
        "rms_nm": [shot.rms * NM for shot in series.shots],
        "p50_nm": float(np.median(series.max_zernike)) * NM,
        "p90_nm": float(np.quantile(series.max_zernike, 0.9)) * NM,
        "true_max_zernike_nm": (series.true_max_zernike * NM).tolist(),
        "true_p50_nm": float(np.median(series.true_max_zernike)) * NM,
        "true_p90_nm": float(np.quantile(series.true_max_zernike, 0.9)) * NM,
        "within": _within(series.true_max_zernike),
        "within_on_map": _within(series.max_zernike),
        "orders": {
            str(order): {
                "p50_nm": float(np.median(errors)) * NM,
                "max_nm": float(errors.max()) * NM,
                "within": _within(errors),
            }
            for order, errors in enumerate(series.order_errors.T, start=2)
        },
        "maps": float(np.mean([shot.maps for shot in series.shots])),
    }


def _within(errors: np.ndarray) -> dict[str, float]:
    return {f"lambda/{parts}": share_within(errors, parts) for parts in MARKS}


def _sampling(study: SamplingStudy) -> dict[str, Any]:
    return {
        "surfaces": study.surfaces,
        "beyond_terms_rms_nm": study.beyond_rms * NM,
        "pixel_noise_nm": study.pixel_noise * NM,
        "ways": {
            name: {
                "samples": way.samples,
                "bias_rms_nm": way.bias_rms * NM,
                "noise_rms_nm": way.noise_rms * NM,
                "rim_ringing_rms_nm": way.rim_ringing_rms * NM,
                "rim_ringing_peak_nm": way.rim_ringing_peak * NM,
                "rim_error_rms_nm": way.rim_error_rms * NM,
                "bias_nm": (way.bias * NM).tolist(),
                "noise_nm": (way.noise * NM).tolist(),
            }
            for name, way in study.results.items()
        },
    }


def _over_seeds(results: Results) -> dict[str, Any]:
    return {
        "seeds": list(results.seeds),
        "median_rel_err_pct": {
            model: _by_surface(np.median(errors, axis=0)) for model, errors in results.over_seeds.items()
        },
        "worst_rel_err_pct": {
            model: _by_surface(np.max(errors, axis=0)) for model, errors in results.over_seeds.items()
        },
    }


def _by_surface(errors: np.ndarray) -> dict[str, float]:
    return {name: 100.0 * float(error) for name, error in zip(reported.TEST_SURFACES, errors, strict=True)}
