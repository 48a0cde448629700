"""CPU time of the nodes while there are no requests."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from types import ModuleType
from typing import Any

from dm_bringup.suite import Suite
from dm_client import STARTING_S, DeformableMirrorClient
from dm_common.ros.domains import own_domain
from dm_tools.demo.demo_bench import bench_config
from studies.benchmarks.timing import Effort

#: Time until the starts are over, and time measured, s.
START_S, MEASURED_S = 6.0, 20.0


def measure(effort: Effort, _rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figure `idle`: per cent of one core, of each node, and in sum of those that run on a real bench.

    The mirror is in its safe shape and no file arrives; the simulation's process is not part of the sum.

    Raises:
        RuntimeError: a node has ended.
    """
    with tempfile.TemporaryDirectory(prefix="dm-idle-") as folder, own_domain() as domain:
        config = bench_config(Path(folder), "prandtl_ishlinskii", 0.01, 1, 0.0)
        with Suite(config, Path(folder) / "logs", domain) as suite:
            with DeformableMirrorClient(domain=domain, timeout_s=STARTING_S) as client:
                client.wait_until_active(60.0)
            time.sleep(START_S)
            suite.check()
            seconds = 5.0 if effort.quick else MEASURED_S
            before, began = {name: _cpu_s(pid) for name, pid in suite.pids.items()}, time.monotonic()
            time.sleep(seconds)
            lasted = time.monotonic() - began
            share = {name: 100.0 * (_cpu_s(pid) - before[name]) / lasted for name, pid in suite.pids.items()}
            suite.check()
    return {"idle": {"percent": sum(share.values()) - share["virtual_bench"], "nodes": share, "seconds": lasted}}


def _cpu_s(pid: int) -> float:
    """CPU time of a process with all its threads, s (proc(5))."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
