"""What the cross-package tests share: nodes as separate processes over real DDS."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Collection, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from dm_calibration import calibrator
from dm_calibration.hysteresis.candidate_fit import CANDIDATES
from dm_calibration.hysteresis.hysteresis_fit import fit_hysteresis
from dm_calibration.procedure import forecast
from dm_tools.demo.demo_bench import bench_config
from fault_injection.rigs.forked_node import ForkedNode, ForkedSuite
from ros_fixtures import Observer
from studies.quick_trigger import quick_trigger
from waiting import wait_until

__all__ = [
    "CommonLawsSuite",
    "NodeProcess",
    "Observer",
    "bench_figures",
    "fast_bench",
    "only_common_laws",
    "wait_until",
]


def fast_bench(folder: Path, seed: int, source: Path | None = None) -> dict[str, dict[str, Any]]:
    """Configuration of a bench with ideal actuators, which need no time to settle, and with a smaller camera.

    Its time is the machine's: each tick of a clock of its own would wake every node. What a report says is tested
    elsewhere.
    """
    config = bench_config(folder, "off", 0.0, seed, 0.0, source)
    config["virtual_bench"]["interferometer.pixels"] = 236
    config["calibration"] |= {"write_report": False, "settle_time": 0.02}
    config["interferometer"]["trigger_command"] = quick_trigger(config["virtual_bench"]["trigger.port"])
    return config


def only_common_laws(names: Collection[str] = ()) -> None:
    """Calibrations in this process try no laws of each actuator by itself, which take most of the time.

    For simulations whose actuators are alike; tests of laws try them all.

    Args:
        names: of the laws that are tried; none = all that actuators share.
    """
    laws = [law for law in CANDIDATES if (law.name in names if names else not law.own)]
    common = partial(fit_hysteresis, candidates=laws)
    calibrator.fit_hysteresis = forecast.fit_hysteresis = common


class CommonLawsSuite(ForkedSuite):
    """Its calibration node tries common laws alone."""

    prepare = MappingProxyType({"calibration": only_common_laws})


def bench_figures(node: Node, timeout_s: float = 60.0) -> dict[str, str]:
    """What `virtual_bench` next tells of itself on `/diagnostics`; somebody else serves `node`."""
    received: list[DiagnosticArray] = []
    node.create_subscription(DiagnosticArray, "/diagnostics", received.append, 10)

    def figures() -> dict[str, str] | None:
        for array in reversed(received):
            for status in array.status:
                if status.name == "virtual_bench":
                    return {item.key: item.value for item in status.values}
        return None

    found: dict[str, str] = wait_until(figures, timeout_s, "the bench's diagnostics")
    return found


class NodeProcess:
    """One node of the suite in its own process, its output in a file."""

    def __init__(
        self,
        package: str,
        executable: str,
        parameters: Mapping[str, Any],
        folder: Path,
        domain: int,
        arguments: tuple[str, ...] = (),
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.log = folder / f"{executable}.log"
        parameter_file = folder / f"{executable}.yaml"
        parameter_file.write_text(yaml.safe_dump({"/**": {"ros__parameters": dict(parameters)}}))
        module = f"{package}.{executable}_node"
        self.log.touch()
        command = [*arguments, "--ros-args", "--params-file", str(parameter_file)]
        self.process = ForkedNode(module, command, self.log, {"ROS_DOMAIN_ID": str(domain)})

    @property
    def output(self) -> str:
        return self.log.read_text(errors="replace")

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def stop(self, number: int = signal.SIGINT, timeout_s: float = 15.0) -> int:
        """Send a signal, wait for the end, return the exit status."""
        if self.running:
            self.process.send_signal(signal.SIGCONT)
            self.process.send_signal(number)
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise AssertionError(f"the node did not end on signal {number}:\n{self.output}") from None
