"""Driver and controller on two machines: two network namespaces with a cable (veth) between them, on this one.

Each side has its own interfaces, so DDS finds the other by multicast and talks to it over UDP, as between two machines;
the cable has no delay of its own. Making them takes root on Linux; elsewhere the job says why it was left out.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from dm_controller.benchmarks.timing import Effort
from dm_controller.cli.demo import bench_config
from dm_controller.suite import save_config

DRIVER_SIDE = ("dm_driver.virtual_bench_node", "dm_driver.pdm_driver_node")
CONTROLLER = "dm_controller.focus_controller_node"
CLIENT = "dm_controller.benchmarks.hosts_client"
NAMESPACE = "hosts"
LONGEST_S = 200.0


class NotPermittedError(Exception):
    """This machine does not let us make network namespaces; the message says why."""


def measure(effort: Effort, _rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figure `hosts`: times in us on one machine and across two; or `skipped`, the reason in words.

    Raises:
        RuntimeError: a node ended, or did not answer.
    """
    rounds = 30 if effort.quick else 300
    try:
        with _two_hosts() as (left, right):
            across = _run(rounds, left, right)
            carried = _received_bytes(right)
    except NotPermittedError as reason:
        return {"hosts": {"skipped": str(reason)}}
    with _one_host() as host:
        alone = _run(rounds, host, host)
    return {"hosts": {"one": alone, "two": across, "cable_mb": carried / 1e6}}


def _ip(*arguments: str) -> str:
    """Run ip(8). Raises NotPermittedError when it is missing or refuses."""
    program = shutil.which("ip")
    if program is None:
        raise NotPermittedError("there is no program `ip` (package iproute2)")
    done = subprocess.run([program, *arguments], check=False, capture_output=True, text=True)
    if done.returncode != 0:
        raise NotPermittedError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout


@contextlib.contextmanager
def _one_host() -> Iterator[str]:
    name = f"dm-{os.getpid()}-0"
    _ip("netns", "add", name)
    try:
        _ip("-n", name, "link", "set", "lo", "up", "multicast", "on")
        _ip("-n", name, "route", "add", "224.0.0.0/4", "dev", "lo")
        yield name
    finally:
        _ip("netns", "del", name)


@contextlib.contextmanager
def _two_hosts() -> Iterator[tuple[str, str]]:
    """Names of two network namespaces that reach each other."""
    names = [f"dm-{os.getpid()}-{side}" for side in (1, 2)]
    made: list[str] = []
    try:
        for name in names:
            _ip("netns", "add", name)
            made.append(name)
        _ip("link", "add", "veth0", "netns", names[0], "type", "veth", "peer", "name", "veth0", "netns", names[1])
        for number, name in enumerate(names, 1):
            _ip("-n", name, "address", "add", f"10.77.0.{number}/24", "dev", "veth0")
            _ip("-n", name, "link", "set", "lo", "up")
            _ip("-n", name, "link", "set", "veth0", "up")
            _ip("-n", name, "route", "add", "224.0.0.0/4", "dev", "veth0")
        yield names[0], names[1]
    finally:
        for name in made:
            _ip("netns", "del", name)


def _received_bytes(host: str) -> int:
    links = json.loads(_ip("-n", host, "-s", "-json", "link", "show", "veth0"))
    return int(links[0]["stats64"]["rx"]["bytes"])


def _run(rounds: int, driver_host: str, controller_host: str) -> dict[str, float]:
    """Twin and driver on one host; controller and client on the other."""
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
                    command = ["ip", "netns", "exec", host, sys.executable, "-m", module, *ros]
                    processes.append(
                        subprocess.Popen(
                            command, stdout=output, stderr=subprocess.STDOUT, env=environment, start_new_session=True
                        )
                    )
            ask = ["ip", "netns", "exec", controller_host, sys.executable, "-m", CLIENT, str(rounds), NAMESPACE]
            done = subprocess.run(ask, check=False, capture_output=True, text=True, env=environment, timeout=LONGEST_S)
        finally:
            for process in reversed(processes):
                process.send_signal(signal.SIGINT)
            for process in processes:
                try:
                    process.wait(15.0)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
        if done.returncode != 0:
            logs = [
                line for path in folder.glob("*.log") for line in path.read_text(errors="replace").splitlines()[-3:]
            ]
            raise RuntimeError("\n".join(["across hosts: " + done.stderr.strip()[-500:], *logs]))
        figures: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
        return figures
