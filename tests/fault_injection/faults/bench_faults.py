"""Signals to the process of the virtual bench: to driver and interferometer, unit and instrument are gone.

A bench that is started again has its outputs at 0 V, as a unit that was switched on. So it is killed and interrupted in
the safe shape only: what a switched-off unit does to a mirror elsewhere is no fault that a driver could mend
(docs/safety.md). Stopped it is anywhere.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from dm_msgs.srv import Measure

from dm_client import STARTING_S, DeformableMirrorClient, DeformableMirrorError
from dm_tools.demo.demo_bench import bench_config
from fault_injection.fault import Fault, FaultRecord
from fault_injection.rigs.driver_rig import ACTUATORS, PATIENCE_S, RigError
from fault_injection.rigs.forked_node import ForkedSuite

BENCH = "virtual_bench"
SAFE_SHAPE = [-1.0] * ACTUATORS
_STOPPED_S = 1.5


class BenchRig:
    """The bench as a process that can be started again; driver and interferometer go on."""

    def __init__(self, folder: Path, domain: int) -> None:
        self._folder, self._domain = folder, domain
        self._config = bench_config(folder, "off", 0.0, 1, 0.0)
        self._config[BENCH]["interferometer.pixels"] = 512
        self._violations: list[tuple[float, int]] = []
        self.bench = self._suite(BENCH)
        self.others = self._suite("pdm_driver", "interferometer")

    def _suite(self, *nodes: str) -> ForkedSuite:
        return ForkedSuite(self._config, self._folder / nodes[0], self._domain, nodes=nodes)

    @contextmanager
    def running(self) -> Iterator[DeformableMirrorClient]:
        """All nodes, and a client of them."""
        with DeformableMirrorClient(domain=self._domain, timeout_s=STARTING_S) as self.client:
            self.client.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
            self.bench.__enter__()
            try:
                with self.others:
                    yield self.client
            finally:
                self.bench.stop()

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            if status.name == BENCH:
                values = {item.key: item.value for item in status.values}
                self._violations.append((time.monotonic(), int(values["violations"])))

    def violations(self) -> int:
        """What the bench's monitor has counted until now, since the bench was started."""
        asked = time.monotonic()
        if not self.client.wait(lambda: self._violations and self._violations[-1][0] > asked + 1.0, PATIENCE_S):
            raise RigError("the bench publishes no diagnostics")
        return self._violations[-1][1]

    def strike(self, number: int) -> None:
        """Send the bench a signal, and let it go on or start it again."""
        process = self.bench.pids[BENCH]
        os.kill(process, number)
        if number == signal.SIGSTOP:
            time.sleep(_STOPPED_S)
            os.kill(process, signal.SIGCONT)
            return
        self.bench.stop(PATIENCE_S)
        self.bench = self._suite(BENCH)
        self.bench.__enter__()

    def all_works(self, signals: list[float]) -> float:
        """Wait until the mirror takes a shape and a map is measured; the seconds that took.

        Raises:
            RigError: not within PATIENCE_S.
        """
        begun = time.monotonic()
        self._insist(lambda: self.client.set_signals(signals))
        self._insist(self.client.measure)
        return time.monotonic() - begun

    def _insist(self, ask: Callable[[], Any]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while True:
            try:
                ask()
            except DeformableMirrorError as error:
                if time.monotonic() > deadline:
                    raise RigError(str(error)) from error
                time.sleep(0.1)
            else:
                return


def _fault(name: str, words: str, measuring: bool) -> Fault:
    def run(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
        rig = BenchRig(folder, domain)
        with rig.running() as client:
            for number in (signal.SIGSTOP, signal.SIGKILL, signal.SIGINT):
                shape = [random.uniform(-0.4, 0.4)] * ACTUATORS if number == signal.SIGSTOP else SAFE_SHAPE
                rig.all_works(shape)
                if number != signal.SIGSTOP:  # the count ends with the process
                    record.limit_violations += rig.violations()
                if measuring:
                    client.node.create_client(Measure, "measure").call_async(Measure.Request(timeout=10.0))
                    time.sleep(random.uniform(0.1, 0.4))
                rig.strike(number)
                record.injected += 1
                record.recovery_s.append(rig.all_works(shape))
            record.limit_violations += rig.violations()

    return Fault(name, f"SIGSTOP, kill -9 and Ctrl-C of the virtual bench {words}", run)


FAULTS: tuple[Fault, ...] = (
    _fault("virtual_bench_idle", "while it is idle", False),
    _fault("virtual_bench_measuring", "while a map is awaited of it", True),
)
