"""What is to be reached, as sentences about the figures of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Figures = dict[str, Any]


@dataclass(frozen=True)
class Target:
    """One line of the table.

    Attributes:
        job: what is done.
        value: of the figures, in `unit`.
        limit: what `value` must not exceed.
        unit: of both.
        beside: what else was measured in the same run: name and value in `unit`.
    """

    job: str
    unit: str
    value: Callable[[Figures], float]
    limit: Callable[[Figures], float]
    beside: Callable[[Figures], dict[str, float | None]]

    def row(self, figures: Figures) -> dict[str, Any]:
        """The line for figures that hold what it needs; KeyError otherwise."""
        value, limit = self.value(figures), self.limit(figures)
        return {
            "job": self.job,
            "unit": self.unit,
            "value": value,
            "limit": limit,
            "beside": self.beside(figures),
            "met": bool(value <= limit),
        }


def _others(part: str, names: dict[str, str]) -> Callable[[Figures], dict[str, float | None]]:
    return lambda figures: {name: figures[part][key] for name, key in names.items()}


_FITS = {"prysm": "prysm_ms", "hcipy": "hcipy_ms", "RZern": "zernike_ms", "lstsq": "lstsq_ms"}

#: In the order of the table. A job that was not run has no line.
TARGETS: tuple[Target, ...] = (
    Target(
        "fit of 21 terms, 944², at most 1 ms",
        "ms",
        lambda f: f["zernike_fit"]["ms"],
        lambda f: 1.0,
        _others("zernike_fit", _FITS),
    ),
    Target(
        "the same, at most 3 × reading the map from memory",
        "ms",
        lambda f: f["zernike_fit"]["ms"],
        lambda f: 3.0 * f["zernike_fit"]["memory_read_ms"],
        _others("zernike_fit", {"memory": "memory_read_ms"}),
    ),
    Target(
        "the same, difference from lstsq",
        "",
        lambda f: f["zernike_fit"]["max_rel_diff"],
        lambda f: 1e-6,
        _others("zernike_fit", {"prysm": "prysm_max_rel_diff", "RZern": "zernike_max_rel_diff"}),
    ),
    Target(
        "fit with a new mask, at most 5 ms",
        "ms",
        lambda f: f["new_mask_fit"]["ms"],
        lambda f: 5.0,
        _others("zernike_fit", _FITS),
    ),
    Target(
        "reading a .dat, at most 1.5 × fromfile and byte swap",
        "ms",
        lambda f: f["read_dat"]["ms"],
        lambda f: 1.5 * f["read_dat"]["fromfile_ms"],
        _others("read_dat", {"fromfile": "fromfile_ms", "prysm": "prysm_ms", "with SHA-256": "with_sha256_ms"}),
    ),
    Target(
        "ten regional rms values, at most 5 ms",
        "ms",
        lambda f: f["regions"]["ms"],
        lambda f: 5.0,
        _others("regions", {"ten passes": "ten_passes_ms"}),
    ),
    Target(
        "influence function of 75 maps with its figures of quality, at most 0.25 s",
        "s",
        lambda f: f["influence"]["s"],
        lambda f: 0.25,
        _others("influence", {"one product, no more": "gemm_s", "dmlib's loop, at every pixel": "dmlib_loop_s"}),
    ),
    Target(
        "memory of taking in and fitting 75 maps, at most 1.1 × that with 25",
        "MB",
        lambda f: f["influence"]["peak_mb_75_maps"],
        lambda f: 1.1 * f["influence"]["peak_mb_25_maps"],
        _others("influence", {"25 maps": "peak_mb_25_maps", "all 75 at once, more": "stack_mb"}),
    ),
    Target(
        "bounded solve, saturated, at most 0.2 ms",
        "ms",
        lambda f: f["solve"]["ms"],
        lambda f: 0.2,
        _others("solve", {"BVLS": "bvls_ms", "inside the limits": "inside_ms"}),
    ),
    Target(
        "inverse of the hysteresis model, 37 actuators, at most 0.3 ms",
        "ms",
        lambda f: f["inverse"]["ms"],
        lambda f: 0.3,
        _others("inverse", {"linear and clipped": "linear_ms"}),
    ),
    Target(
        "curvature request to command, p50, at most 1.3 × a bare relay",
        "µs",
        lambda f: f["focus"]["p50_us"],
        lambda f: 1.3 * f["relay"]["p50_us"],
        _others("relay", {"relay": "p50_us"}),
    ),
    Target(
        "the same, p99",
        "µs",
        lambda f: f["focus"]["p99_us"],
        lambda f: 1.3 * f["relay"]["p99_us"],
        _others("relay", {"relay": "p99_us"}),
    ),
    Target(
        "the same at 100 requests a second, p50",
        "µs",
        lambda f: f["at_100_hz"]["focus"]["p50_us"],
        lambda f: 1.3 * f["at_100_hz"]["relay"]["p50_us"],
        lambda f: {"relay": f["at_100_hz"]["relay"]["p50_us"]},
    ),
    Target(
        "500 requests a second, age of the last answers, at most 1.5 × the first",
        "µs",
        lambda f: f["stream"]["focus"]["last_quarter_p50_us"],
        lambda f: 1.5 * f["stream"]["focus"]["first_quarter_p50_us"],
        lambda f: {"relay": f["stream"]["relay"]["last_quarter_p50_us"]},
    ),
    Target(
        "map file on disk to coefficients published, .dat of 944², p99 at most 20 ms",
        "ms",
        lambda f: f["file_to_coefficients"]["p99_ms"],
        lambda f: 20.0,
        lambda f: {
            "p50": f["file_to_coefficients"]["p50_ms"],
            ".datx": f["file_to_coefficients"]["datx"]["p99_ms"],
            "from the watched folder": f["file_to_coefficients"]["watched"]["p99_ms"],
        },
    ),
    Target(
        "idle suite, at most 3 % of a core",
        "%",
        lambda f: f["idle"]["percent"],
        lambda f: 3.0,
        lambda f: {"the simulation": f["idle"]["nodes"]["virtual_bench"]},
    ),
    Target(
        "computing of a calibration, plan FULL, at most 5 % of the bench's time",
        "s",
        lambda f: f["calibration"]["full"]["compute_s"],
        lambda f: 0.05 * f["calibration"]["full"]["bench_s"],
        lambda f: {"bench": f["calibration"]["full"]["bench_s"]},
    ),
    Target(
        "the same, plan HYSTERESIS",
        "s",
        lambda f: f["calibration"]["hysteresis"]["compute_s"],
        lambda f: 0.05 * f["calibration"]["hysteresis"]["bench_s"],
        lambda f: {"bench": f["calibration"]["hysteresis"]["bench_s"]},
    ),
)


def rows(figures: Figures) -> list[dict[str, Any]]:
    """The lines of all targets whose figures are there."""
    result = []
    for target in TARGETS:
        try:
            result.append(target.row(figures))
        except KeyError:
            continue
    return result
