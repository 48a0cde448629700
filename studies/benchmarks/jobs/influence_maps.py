"""The influence function from the maps of a run: time without reading the maps, and memory."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.influence.fit import fit_influence
from dm_calibration.influence.maps import MapSet, StepKind
from dm_common import Floats
from dm_common.measurement import Measurement
from dm_common.optics.sampling import edge_clustered_points
from dm_common.optics.zernike import TERMS, basis
from studies.benchmarks.jobs.map_reading import write_sample
from studies.benchmarks.sample_maps import CAMERA, maps
from studies.benchmarks.timing import Effort, medians

ACTUATORS = 37
#: Maps of the run; dmlib's loop is timed on LOOP_MAPS of them, as its time is proportional to their number.
RUN, LOOP_MAPS = 75, 5
#: Noise of a coefficient and of a sample, m.
NOISE = 1e-9


def measure(effort: Effort, _rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figure `influence`; times in s, peak memory of a whole process in MB.

    The product fits coefficients and samples of the maps, with outliers, cross-validation and figures of quality; the
    others regress the same numbers, or every pixel of the maps, and do nothing else.
    """
    generator = np.random.default_rng(75)
    run, responses = _run(RUN, generator)
    some, _mask = maps(CAMERA, LOOP_MAPS, generator)
    pixels = np.stack(some).reshape(LOOP_MAPS, -1)
    rounds = 3 if effort.quick else 7
    seconds = medians(
        {
            "fit": lambda: fit_influence(run),
            "gemm": lambda: np.linalg.pinv(run.applied) @ responses,
            "loop": lambda: _dmlib_loop(run.applied, pixels),
        },
        rounds,
        {"loop": 1 if effort.quick else 3},
    )
    return {
        "influence": {
            "maps": RUN,
            "s": seconds["fit"],
            "gemm_s": seconds["gemm"],
            "dmlib_loop_s": seconds["loop"] * RUN / LOOP_MAPS,
            "peak_mb_25_maps": peak_memory(25),
            "peak_mb_75_maps": peak_memory(75),
            "stack_mb": 8e-6 * RUN * CAMERA**2,
        }
    }


def _run(count: int, generator: np.random.Generator) -> tuple[MapSet, Floats]:
    """Maps of random commands, and their coefficients and samples side by side (M, K + P)."""
    points = edge_clustered_points()
    signals = generator.uniform(-1.0, 1.0, (count, ACTUATORS))
    signals[::25] = 0.0
    influence = 1e-6 * generator.standard_normal((ACTUATORS, len(TERMS)))
    coefficients = signals @ influence + NOISE * generator.standard_normal((count, len(TERMS)))
    sag = coefficients @ basis(points.x, points.y).T + NOISE * generator.standard_normal((count, len(points)))
    run = MapSet.of(
        [
            Measurement(
                points=points,
                sag=sag[k],
                coefficients=coefficients[k],
                sigma=np.full(len(TERMS), NOISE),
                stamp_ns=k * 10**9,
                residual_rms=NOISE,
                valid_fraction=1.0,
                label=f"map {k}",
                kind=StepKind.SURFACE if signals[k].any() else StepKind.REFERENCE,
                step=k,
                signals=signals[k],
                applied=signals[k],
            )
            for k in range(count)
        ]
    )
    return run, np.hstack((coefficients, sag))


def _dmlib_loop(design: Floats, phases: Floats) -> Floats:
    """Sums of the normal equations map by map, after `calibrate` of dmlib's calibration.py (J. Antonello, GPL-3).

    The method only: the outer product of every map and its commands is added to (V, N), one map at a time.
    """
    commands = np.zeros((design.shape[1], design.shape[1]))
    products = np.zeros((phases.shape[1], design.shape[1]))
    for row, phase in zip(design, phases, strict=False):
        commands += np.dot(row[:, None], row[None, :])
        products += np.dot(phase[:, None], row[None, :])
    return products


def peak_memory(count: int, pixels: int = CAMERA) -> float:
    """Peak resident memory in MB of a process that takes in `count` map files and fits the influence function.

    Raises:
        RuntimeError: the process failed, with its last line.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.dat"
        write_sample(path, pixels)
        command = [sys.executable, "-m", __name__, str(count), str(path)]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"measuring memory failed: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    return float(done.stdout)


def main() -> None:
    """Read a file repeatedly as the maps of a run, and print this process's peak memory in MB."""
    count, path = int(sys.argv[1]), Path(sys.argv[2])
    ingest, settings = Ingest(), IngestSettings()
    kept = [ingest.read(path, settings)[1] for _ in range(count)]  # as a run keeps them
    # The fit is always that of the longest run, so that memory depends on the number of maps read alone.
    fit_influence(_run(RUN, np.random.default_rng(count))[0])
    # Not `ru_maxrss`: it starts at the memory of the process that started this one.
    status = Path("/proc/self/status").read_text()
    peak = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    del kept  # not before the peak is known
    print(float(peak.split()[1]) * 1024 / 1e6)


if __name__ == "__main__":
    main()
