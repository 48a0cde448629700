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
        "influence function at every pixel, 75 maps, at most 0.25 s",
        "s",
        lambda f: f["influence"]["s"],
        lambda f: 0.25,
        _others("influence", {"one product": "gemm_s", "dmlib's loop": "dmlib_loop_s"}),
    ),
    Target(
        "its memory with 75 maps, at most 1.1 × that with 25",
        "MB",
        lambda f: f["influence"]["peak_mb_75_maps"],
        lambda f: 1.1 * f["influence"]["peak_mb_25_maps"],
        _others("influence", {"25 maps": "peak_mb_25_maps", "all 75 at once, more": "gemm_stack_mb"}),
    ),
    Target(
        "bounded solve, saturated, at most 0.2 ms",
        "ms",
        lambda f: f["solve"]["ms"],
        lambda f: 0.2,
        _others("solve", {"BVLS": "bvls_ms", "inside the limits": "inside_ms"}),
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
