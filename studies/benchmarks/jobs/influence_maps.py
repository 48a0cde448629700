"""The influence function at every pixel from many maps: time beyond reading them, and memory."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dm_calibration.influence.streaming import InfluenceAccumulator
from dm_calibration.map_files import read_map
from studies.benchmarks.jobs.map_reading import write_sample
from studies.benchmarks.sample_maps import CAMERA, maps
from studies.benchmarks.timing import Effort, medians

Floats = NDArray[np.float64]

ACTUATORS = 37
#: Maps of the run, and the different ones among them: they are used in turn.
RUN, DIFFERENT = 75, 15
#: Actuators that move where memory is measured, the same for any number of maps.
MOVED = 19
#: Maps on which the loop of dmlib is timed; its time is proportional to their number.
LOOP_MAPS = 5


def measure(effort: Effort, _rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figure `influence`; times in s, peak memory of a whole process in MB."""
    generator = np.random.default_rng(75)
    some, _mask = maps(CAMERA, DIFFERENT, generator)
    design = _design(RUN, generator)
    stack = np.concatenate([np.stack(some).reshape(DIFFERENT, -1)] * (RUN // DIFFERENT))

    def streamed() -> Floats:
        accumulator = InfluenceAccumulator(design, some[0].shape)
        for number in range(RUN):
            accumulator.add(some[number % DIFFERENT])
        return accumulator.result()

    def one_product() -> Floats:
        return np.linalg.pinv(design) @ stack

    rounds = 3 if effort.quick else 7
    seconds = medians(
        {"streamed": streamed, "gemm": one_product, "loop": lambda: _dmlib_loop(design, stack[:LOOP_MAPS])},
        rounds,
        {"loop": 1 if effort.quick else 3},
    )
    found, expected = streamed().reshape(ACTUATORS, -1), one_product()
    difference = np.nanmax(np.abs(found - expected)) / np.nanmax(np.abs(expected))
    return {
        "influence": {
            "maps": RUN,
            "pixels": CAMERA**2,
            "s": seconds["streamed"],
            "gemm_s": seconds["gemm"],
            "dmlib_loop_s": seconds["loop"] * RUN / LOOP_MAPS,
            "max_rel_diff": float(difference),
            "peak_mb_25_maps": peak_memory(25),
            "peak_mb_75_maps": peak_memory(75),
            "gemm_stack_mb": stack.nbytes / 1e6,
        }
    }


def _design(count: int, generator: np.random.Generator, moved: int = ACTUATORS) -> Floats:
    return generator.uniform(-1.0, 1.0, (count, moved))


def _dmlib_loop(design: Floats, phases: Floats) -> Floats:
    """Sums of the normal equations map by map, after `calibrate` of dmlib's calibration.py (J. Antonello, GPL-3).

    Only the method: (V, N) gets the outer product of every map and its commands, one at a time.
    """
    commands = np.zeros((design.shape[1], design.shape[1]))
    products = np.zeros((phases.shape[1], design.shape[1]))
    for row, phase in zip(design, phases, strict=False):
        commands += np.dot(row[:, None], row[None, :])
        products += np.dot(phase[:, None], row[None, :])
    return products


def peak_memory(count: int, pixels: int = CAMERA) -> float:
    """Peak resident memory in MB of a process that reads `count` map files and accumulates them.

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
    """Read a file again and again as the maps of a run, and print this process's peak memory in MB."""
    count, path = int(sys.argv[1]), Path(sys.argv[2])
    # As many unknowns whatever the number of maps, or memory could not be compared; 25 maps tell 19 actuators apart.
    design = _design(count, np.random.default_rng(count), MOVED)
    accumulator = InfluenceAccumulator(design, read_map(path).sag.shape)
    for _ in range(count):
        accumulator.add(read_map(path).sag)
    accumulator.result()
    # Not `ru_maxrss`: that begins with the memory of the process that started this one.
    status = Path("/proc/self/status").read_text()
    peak = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    print(float(peak.split()[1]) * 1024 / 1e6)


if __name__ == "__main__":
    main()
