"""The driver's rig with the nodes above it, each a process of its own: interferometer, calibration, controller."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import yaml
from dm_msgs.action import Calibrate, MoveFocus
from dm_msgs.msg import FocusRequest
from dm_msgs.srv import IngestFile, ListCalibrations, Measure, SetFocus

from dm_bringup.nodes import MODULES
from dm_calibration.calibration import Calibration
from dm_calibration.procedure.plan import PlanKind
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.ros import qos
from dm_common.ros.clients import ThreadedActionClient
from dm_simulation.bench import BenchConfig, FilesConfig
from dm_simulation.electronics.monitor import MonitorConfig
from dm_simulation.electronics.server import OFF, PortsConfig
from dm_simulation.interferometer.interferometer import InterferometerConfig
from fault_injection.rigs.driver_rig import SERIAL, DriverRig, RigError, end_process
from fault_injection.rigs.forked_node import Process
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig
from studies.quick_trigger import quick_trigger

NODES = ("interferometer", "calibration", "focus_controller")
#: Of the simulated interferometer.
PIXELS = 128
#: Half-swings of the controller's degauss: few, so that a conditioned move takes a second or two.
DEGAUSS_STEPS = 10
#: Longest wait for a map [s]: one takes a few tenths, and what was lost with its interferometer is waited for in vain.
MAP_S = 20.0
#: Curvature that every calibrated rig reaches [1/m].
CURVATURE = 0.02
_SERVICES = {
    IngestFile: "ingest_file",
    Measure: "measure",
    ListCalibrations: "list_calibrations",
    SetFocus: "set_focus",
}


class ProcessRig(DriverRig):
    """Use as a context manager; all nodes run and work once it is entered."""

    def __init__(self, folder: Path, domain: int, nodes: tuple[str, ...] = NODES, **changes: Any) -> None:
        super().__init__(folder, domain, **changes)
        self._nodes = nodes
        self.processes: dict[str, Process] = {}
        self.calibrations = folder / "calibrations"
        values: dict[str, dict[str, Any]] = {
            "interferometer": {
                "watch_folder": str(folder / "maps"),
                "trigger_command": quick_trigger(self.bench.endpoints["trigger_port"]),
                "trigger_output_suffix": ".dat",
                "aperture.radius": 0.011,
                "stable_time": 0.1,
            },
            "calibration": {
                "calibration_folder": str(self.calibrations),
                "load_on_start": "newest",
                "settle_time": 0.02,
                "measure_timeout": MAP_S,
                "write_report": False,
            },
            "focus_controller": {"condition.degauss_steps": DEGAUSS_STEPS},
        }
        self._files = {name: folder / f"{name}.yaml" for name in values}
        for name, file in self._files.items():
            file.write_text(yaml.safe_dump({"/**": {"ros__parameters": values[name]}}))

    def _bench_config(self, serial: str) -> BenchConfig:
        return BenchConfig(
            interferometer=InterferometerConfig(pixels=PIXELS),
            ports=PortsConfig(0, OFF, OFF, serial),
            monitor=MonitorConfig(jump=0.1, neighbour_difference=1.0),
            files=FilesConfig(folder=self.folder / "maps", format="dat"),
            trigger_port=0,
        )

    def __enter__(self) -> Self:
        super().__enter__()
        for kind, name in _SERVICES.items():
            self._clients[kind] = self.node.create_client(kind, name)
        self._actions = {
            kind: ThreadedActionClient(self.node, kind, name)
            for kind, name in ((Calibrate, "calibrate"), (MoveFocus, "move_focus"))
        }
        self.requests = self.node.create_publisher(FocusRequest, "focus_request", qos.COMMAND)
        for name in self._nodes:
            self.start_node(name)
        return self

    def __exit__(self, *exception: object) -> None:
        for name in list(self.processes):
            self.end_node(name, signal.SIGINT)
        super().__exit__(*exception)

    # The processes

    def start_node(self, name: str) -> None:
        """Start a node."""
        assert name not in self.processes
        self.processes[name] = self._start(MODULES[name], self._files[name], self.folder / f"{name}.log")

    def end_node(self, name: str, number: int) -> int:
        """End a node by a signal; its exit status."""
        return end_process(self.processes.pop(name), number, name)

    def log(self, name: str) -> str:
        """The end of a node's output."""
        return (self.folder / f"{name}.log").read_text(errors="replace")[-800:]

    # What the nodes do

    def slow_instrument(self, seconds: float) -> None:
        """From now on a map file grows over so many seconds."""
        self.bench.config = replace(self.bench.config, files=replace(self.bench.config.files, slow_write=seconds))

    def goal(self, kind: Any, goal: Any, feedback: Any = None) -> Any:
        """Send a goal to the action; the future of its result.

        Raises:
            RigError: no answer.
        """
        client = self._actions[kind]
        self.wait(client.server_is_ready, f"the action {kind.__name__}")
        accepted = client.send_goal_async(goal, feedback_callback=feedback)
        self.wait(accepted.done, "the acceptance of a goal")
        return accepted.result().get_result_async()

    def all_works(self) -> float:
        """Wait until every node of the rig does its work again; the seconds that took.

        Raises:
            RigError: one does not.
        """
        begun = time.monotonic()
        self.recover(np.zeros(37))
        if "interferometer" in self._nodes:
            self.insist(Measure, Measure.Request(timeout=20.0), "a measured map")
        if "calibration" in self._nodes:
            listed = self.insist(ListCalibrations, ListCalibrations.Request(), "the list of calibrations", 2.0)
            if bad := [remark for remark in listed.remarks if remark not in ("", "in use")]:
                raise RigError(f"a calibration file is not whole: {bad[0]}")
        if "focus_controller" in self._nodes:
            request = SetFocus.Request(request=FocusRequest(curvature=CURVATURE))
            state = self.insist(SetFocus, request, "a curvature that is carried out", 2.0).state
            self.wait(lambda: self.stands_at(state.signals), "the curvature's shape at the actuators", 10.0)
        return time.monotonic() - begun


@contextmanager
def calibrated_rig(folder: Path, domain: int) -> Iterator[ProcessRig]:
    """A rig of all nodes with a calibration in use."""
    rig = ProcessRig(folder, domain)
    CalibrationStore(rig.calibrations).save(_calibration())
    with rig:
        rig.all_works()
        yield rig


@cache
def _calibration() -> Calibration:
    """Measured on a simulation without processes: of the same seed and actuators as every rig's."""
    simulation = SimulatedBench(SimulationConfig(seed=BenchConfig.seed, pixels=PIXELS))
    return replace(simulation.calibrate(PlanKind.POKES), id="rig", mirror_serial=SERIAL, created_ns=time.time_ns())
