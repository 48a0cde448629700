"""Driver and controller on two machines: two network namespaces on this one, with a cable (veth) between them.

If these cannot be made (see :mod:`studies.network_namespaces`), the job reports why it was left out.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

from dm_bringup.nodes import MODULES
from dm_bringup.suite import save_config, stop_processes
from dm_tools.demo.demo_bench import bench_config
from studies.benchmarks.timing import Effort
from studies.network_namespaces import NotPermittedError, command_on, one_host, received_bytes, two_hosts

DRIVER_SIDE = (MODULES["virtual_bench"], MODULES["pdm_driver"])
CONTROLLER = MODULES["focus_controller"]
CLIENT = "studies.benchmarks.ros_jobs.hosts_client"
NAMESPACE = "hosts"
LONGEST_S = 200.0


def measure(effort: Effort, _rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figure `hosts`: times in us on one machine and across two; or `skipped`, the reason in words.

    Raises:
        RuntimeError: a node ended, or did not answer.
    """
    rounds = 30 if effort.quick else 300
    try:
        with two_hosts() as (left, right):
            across = _run(rounds, left, right)
            carried = received_bytes(right)
    except NotPermittedError as reason:
        return {"hosts": {"skipped": str(reason)}}
    with one_host() as host:
        alone = _run(rounds, host, host)
    return {"hosts": {"one": alone, "two": across, "cable_mb": carried / 1e6}}


def _run(rounds: int, driver_host: str, controller_host: str) -> dict[str, float]:
    """Simulation and driver on one host; controller and client on the other."""
    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory(prefix="dm-hosts-") as temporary:
        folder = Path(temporary)
        save_config(bench_config(folder, "prandtl_ishlinskii", 0.01, 1, 0.0), folder / "config.yaml")
        ros = ["--ros-args", "-r", f"__ns:=/{NAMESPACE}", "--params-file", str(folder / "config.yaml")]
        places = [(driver_host, module) for module in DRIVER_SIDE] + [(controller_host, CONTROLLER)]
        processes: list[subprocess.Popen[bytes]] = []
        try:
            for host, module in places:
                with (folder / f"{module}.log").open("wb") as output:
                    command = [*command_on(host), sys.executable, "-m", module, *ros]
                    processes.append(
                        subprocess.Popen(
                            command, stdout=output, stderr=subprocess.STDOUT, env=environment, start_new_session=True
                        )
                    )
            ask = [*command_on(controller_host), sys.executable, "-m", CLIENT, str(rounds), NAMESPACE]
            done = subprocess.run(ask, check=False, capture_output=True, text=True, env=environment, timeout=LONGEST_S)
        finally:
            stop_processes(processes)
        if done.returncode != 0:
            logs = [
                line for path in folder.glob("*.log") for line in path.read_text(errors="replace").splitlines()[-3:]
            ]
            raise RuntimeError("\n".join(["across hosts: " + done.stderr.strip()[-500:], *logs]))
        figures: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
        return figures
