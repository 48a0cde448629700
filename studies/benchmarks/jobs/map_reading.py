"""Reading a map file, beside the minimum: bringing its bytes into memory in the processor's order."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from dm_calibration.map_files import read_map
from dm_simulation.interferometer.zygo_files import HEADER_SIZE, encode_dat
from studies.benchmarks.sample_maps import CAMERA, maps
from studies.benchmarks.timing import Effort, medians


def write_sample(path: Path, pixels: int = CAMERA) -> None:
    """Write one map as a `.dat` file."""
    some, _mask = maps(pixels, 1, np.random.default_rng(1))
    path.write_bytes(encode_dat(some[0], 25e-6, 632.8e-9, 0))


def measure(effort: Effort, rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figure `read_dat`; times in ms. `with_sha256_ms` includes the digest that is stored with a calibration."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.dat"
        write_sample(path)
        jobs: dict[str, Callable[[], object]] = {
            "read": lambda: read_map(path).sag,
            "sha256": lambda: read_map(path).sha256,
            "fromfile": lambda: np.fromfile(path, ">i4", offset=HEADER_SIZE).byteswap(),
        }
        if "prysm" in rivals:
            from prysm.io import read_zygo_dat  # type: ignore[import-not-found]

            jobs["prysm"] = lambda: read_zygo_dat(path)["phase"]
        seconds = medians(jobs, effort.rounds)
    return {
        "read_dat": {
            "ms": 1e3 * seconds["read"],
            "with_sha256_ms": 1e3 * seconds["sha256"],
            "fromfile_ms": 1e3 * seconds["fromfile"],
            "prysm_ms": 1e3 * seconds["prysm"] if "prysm" in seconds else None,
        }
    }
