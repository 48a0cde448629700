"""The targets of the benchmarks: limits for the figures of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

Figures = dict[str, Any]


def figure(figures: Figures, path: str) -> float:
    """The figure at a path such as "part.of.it"; KeyError if the job was not run."""
    found: Any = figures
    for key in path.split("."):
        found = found[key]
    return found


@dataclass(frozen=True)
class Limit:
    """A number, or a multiple of the figure at `of`."""

    factor: float
    of: str = ""

    def value(self, figures: Figures) -> float:
        return self.factor * figure(figures, self.of) if self.of else self.factor


@dataclass(frozen=True)
class Target:
    """One line of the table.

    Attributes:
        job: what is done.
        unit: of all figures of the line.
        value: path of the figure.
        limit: what it must not exceed.
        beside: paths of other figures of the same run, by name.
    """

    job: str
    unit: str
    value: str
    limit: Limit
    beside: dict[str, str]

    def row(self, figures: Figures) -> dict[str, Any]:
        """The line of the table; KeyError if a figure that it needs is missing."""
        value, limit = figure(figures, self.value), self.limit.value(figures)
        return {
            "job": self.job,
            "unit": self.unit,
            "value": value,
            "limit": limit,
            "beside": {name: figure(figures, path) for name, path in self.beside.items()},
            "met": bool(value <= limit),
        }


_FITS = {
    "prysm": "zernike_fit.prysm_ms",
    "hcipy": "zernike_fit.hcipy_ms",
    "RZern": "zernike_fit.zernike_ms",
    "lstsq": "zernike_fit.lstsq_ms",
}

#: In the order of the table. A job that was not run has no line.
TARGETS: tuple[Target, ...] = (
    Target("fit of 21 terms, 944², at most 1 ms", "ms", "zernike_fit.ms", Limit(1.0), _FITS),
    Target(
        "the same, at most 3 × reading the map from memory",
        "ms",
        "zernike_fit.ms",
        Limit(3.0, "zernike_fit.memory_read_ms"),
        {"memory": "zernike_fit.memory_read_ms"},
    ),
    Target(
        "the same, difference from lstsq",
        "",
        "zernike_fit.max_rel_diff",
        Limit(1e-06),
        {"prysm": "zernike_fit.prysm_max_rel_diff", "RZern": "zernike_fit.zernike_max_rel_diff"},
    ),
    Target("fit with a new mask, at most 5 ms", "ms", "new_mask_fit.ms", Limit(5.0), _FITS),
    Target(
        "reading a .dat, at most 1.5 × fromfile and byte swap",
        "ms",
        "read_dat.ms",
        Limit(1.5, "read_dat.fromfile_ms"),
        {"fromfile": "read_dat.fromfile_ms", "prysm": "read_dat.prysm_ms", "with SHA-256": "read_dat.with_sha256_ms"},
    ),
    Target(
        "ten regional rms values, at most 5 ms", "ms", "regions.ms", Limit(5.0), {"ten passes": "regions.ten_passes_ms"}
    ),
    Target(
        "influence function of 75 maps with its figures of quality, at most 0.25 s",
        "s",
        "influence.s",
        Limit(0.25),
        {"one product, no more": "influence.gemm_s", "dmlib's loop, at every pixel": "influence.dmlib_loop_s"},
    ),
    Target(
        "memory of taking in and fitting 75 maps, at most 1.1 × that with 25",
        "MB",
        "influence.peak_mb_75_maps",
        Limit(1.1, "influence.peak_mb_25_maps"),
        {"25 maps": "influence.peak_mb_25_maps", "all 75 at once, more": "influence.stack_mb"},
    ),
    Target(
        "bounded solve, saturated, at most 0.2 ms",
        "ms",
        "solve.ms",
        Limit(0.2),
        {"BVLS": "solve.bvls_ms", "inside the limits": "solve.inside_ms"},
    ),
    Target(
        "inverse of the hysteresis model, 37 actuators, at most 0.3 ms",
        "ms",
        "inverse.ms",
        Limit(0.3),
        {"linear and clipped": "inverse.linear_ms"},
    ),
    Target(
        "curvature request to command, p50, at most 1.3 × a bare relay",
        "µs",
        "focus.p50_us",
        Limit(1.3, "relay.p50_us"),
        {"relay": "relay.p50_us"},
    ),
    Target("the same, p99", "µs", "focus.p99_us", Limit(1.3, "relay.p99_us"), {"relay": "relay.p99_us"}),
    Target(
        "the same at 100 requests a second, p50",
        "µs",
        "at_100_hz.focus.p50_us",
        Limit(1.3, "at_100_hz.relay.p50_us"),
        {"relay": "at_100_hz.relay.p50_us"},
    ),
    Target(
        "500 requests a second, age of the last answers, at most 1.5 × the first",
        "µs",
        "stream.focus.last_quarter_p50_us",
        Limit(1.5, "stream.focus.first_quarter_p50_us"),
        {"relay": "stream.relay.last_quarter_p50_us"},
    ),
    Target(
        "map file on disk to coefficients published, .dat of 944², p99 at most 20 ms",
        "ms",
        "file_to_coefficients.p99_ms",
        Limit(20.0),
        {
            "p50": "file_to_coefficients.p50_ms",
            ".datx": "file_to_coefficients.datx.p99_ms",
            "from the watched folder": "file_to_coefficients.watched.p99_ms",
        },
    ),
    Target(
        "idle suite, at most 3 % of a core",
        "%",
        "idle.percent",
        Limit(3.0),
        {"the simulation": "idle.nodes.virtual_bench"},
    ),
    Target(
        "computing of a calibration, plan FULL, at most 5 % of the bench's time",
        "s",
        "calibration.full.compute_s",
        Limit(0.05, "calibration.full.bench_s"),
        {"bench": "calibration.full.bench_s"},
    ),
    Target(
        "the same, plan HYSTERESIS",
        "s",
        "calibration.hysteresis.compute_s",
        Limit(0.05, "calibration.hysteresis.bench_s"),
        {"bench": "calibration.hysteresis.bench_s"},
    ),
)


def rows(figures: Figures) -> list[dict[str, Any]]:
    """The lines of all targets whose figures are available."""
    result = []
    for target in TARGETS:
        try:
            result.append(target.row(figures))
        except KeyError:
            continue
    return result
