"""Timing that is robust against other load on the machine: the jobs that are compared take turns."""

from __future__ import annotations

import gc
import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy


@dataclass(frozen=True)
class Effort:
    """How much to measure.

    Attributes:
        rounds: turns of a job of about a millisecond; slower ones get fewer.
        quick: small sizes only, for a first impression and for tests.
    """

    rounds: int = 60
    quick: bool = False

    @property
    def slow_rounds(self) -> int:
        """Turns of a job that takes from a tenth of a second to a second."""
        return max(self.rounds // 12, 2)


def medians(
    jobs: Mapping[str, Callable[[], object]], rounds: int, fewer: Mapping[str, int] | None = None
) -> dict[str, float]:
    """Median time of every job, s.

    Every job runs once unmeasured. Then they take turns, so that a busy moment of the machine affects all of them: a
    ratio of two medians is more reliable than either.

    Args:
        rounds: number of turns.
        fewer: names of slow jobs and their number of turns, spread over the run.

    Raises:
        ValueError: no rounds.
    """
    if rounds < 1:
        raise ValueError(f"rounds = {rounds}: must be at least 1")
    turns = {name: min((fewer or {}).get(name, rounds), rounds) for name in jobs}
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for job in jobs.values():
        job()
    gc.collect()
    collecting = gc.isenabled()
    gc.disable()
    try:
        for number in range(rounds):
            for name, job in jobs.items():
                if number * turns[name] // rounds == (number + 1) * turns[name] // rounds:
                    continue
                started = time.perf_counter()
                job()
                seconds[name].append(time.perf_counter() - started)
    finally:
        if collecting:
            gc.enable()
    return {name: float(np.median(values)) for name, values in seconds.items()}


def machine() -> dict[str, Any]:
    """Facts on which timings depend, without the names of the machine."""
    model = "unknown"
    information = Path("/proc/cpuinfo")
    if information.is_file():
        names = [line for line in information.read_text().splitlines() if line.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "load_average": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "blas_threads": os.environ.get("OPENBLAS_NUM_THREADS", "all"),
    }
