"""CPU time of the fits of a calibration, beside the time that a real bench needs for its moves and maps."""

from __future__ import annotations

import time
from types import ModuleType
from typing import Any

from numpy.typing import NDArray

from dm_calibration.procedure.plan import PlanKind, PlanOptions
from dm_common import Floats
from studies.benchmarks.timing import Effort
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig


class TimedBench(SimulatedBench):
    """A simulation that times its own work apart from the calibration's: a real bench has no such work.

    Attributes:
        own_s: CPU time spent on simulating, s.
    """

    own_s = 0.0

    def take_map(self) -> Floats:
        began = time.process_time()
        try:
            return super().take_map()
        finally:
            self.own_s += time.process_time() - began

    def apply(self, signals: NDArray[Any]) -> Floats:
        began = time.process_time()
        try:
            return super().apply(signals)
        finally:
            self.own_s += time.process_time() - began

    def degauss(self) -> None:
        began = time.process_time()
        try:
            super().degauss()
        finally:
            self.own_s += time.process_time() - began


def measure(effort: Effort, _rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figure `calibration`: per plan CPU time of all fits (s), time on a bench (s), and their ratio.

    Bench time is that of ramps, settling and exposure, half a second for each of the last two. Reading the files is not
    included: see `file_to_coefficients`. A quick run takes small maps and only the plan FULL.
    """
    config = SimulationConfig(law="preisach", seed=5, pixels=236 if effort.quick else 944)
    plans = {"full": (PlanKind.FULL, None), "hysteresis": (PlanKind.HYSTERESIS, PlanOptions())}
    if effort.quick:
        del plans["hysteresis"]
    return {"calibration": {name: _plan(config, *plan) for name, plan in plans.items()}}


def _plan(config: SimulationConfig, kind: PlanKind, options: PlanOptions | None) -> dict[str, float]:
    bench = TimedBench(config)
    began = time.process_time()
    bench.calibrate(kind, options)
    compute = time.process_time() - began - bench.own_s
    return {"maps": bench.maps, "compute_s": compute, "bench_s": bench.time, "share": compute / bench.time}
