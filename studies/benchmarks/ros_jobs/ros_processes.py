"""Processes of one job of the benchmark, on a ROS domain of their own, and their client."""

from __future__ import annotations

import contextlib
import gc
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dm_bringup.suite import save_config, stop_processes
from dm_common.ros.domains import own_domain
from dm_common.ros.executor import make_executor


class ProcessHarness:
    """Processes under test and a client node, which this thread serves.

    Attributes:
        node: the client.
        folder: for files, removed in the end.
    """

    def __init__(self, domain: int, folder: Path) -> None:
        self.folder = folder
        own = {"ROS_DOMAIN_ID": str(domain), "ROS_HOME": str(self.folder), "OPENBLAS_NUM_THREADS": "1"}
        self._environment = {**os.environ, **own}
        self._processes: dict[subprocess.Popen[bytes], Path] = {}
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node("benchmark", context=self._context)
        self._executor: Executor = make_executor(self.node)

    def start(
        self, module: str, *arguments: str, namespace: str, parameters: dict[str, Any] | None = None
    ) -> subprocess.Popen[bytes]:
        """Start `python -m module` in a namespace."""
        log = self.folder / f"{namespace}-{module.rpartition('.')[2]}.log"
        command = [sys.executable, "-m", module, *arguments, "--ros-args", "-r", f"__ns:=/{namespace}"]
        if parameters:
            path = log.with_suffix(".yaml")
            save_config({"*": parameters}, path)
            command += ["--params-file", str(path)]
        with log.open("wb") as output:
            process = subprocess.Popen(
                command, stdout=output, stderr=subprocess.STDOUT, env=self._environment, start_new_session=True
            )
        self._processes[process] = log
        return process

    def serve(self, seconds: float, until: Callable[[], Any] = lambda: False) -> bool:
        """Serve the client for `seconds`, or until a condition is true; returns whether it is."""
        end = time.monotonic() + seconds
        while not until():
            remaining = end - time.monotonic()
            if remaining <= 0.0:
                return bool(until())
            self._executor.spin_once(timeout_sec=remaining)
        return True

    def wait_for(self, what: str, condition: Callable[[], Any], seconds: float = 60.0) -> None:
        """Serve the client until `condition()`.

        Raises:
            RuntimeError: not in time, or a process has ended; with the end of its log.
        """
        end = time.monotonic() + seconds
        while not self.serve(0.1, condition):
            for process, log in self._processes.items():
                if process.poll() is not None:
                    words = log.read_text(errors="replace").splitlines()[-8:]
                    raise RuntimeError("\n".join([f"{log.stem} ended with status {process.returncode}", *words]))
            if time.monotonic() > end:
                raise RuntimeError(f"{what}: not within {seconds:g} s")

    def close(self) -> None:
        """Stop all processes and leave the ROS graph."""
        stop_processes(self._processes)
        self._executor.shutdown(2.0)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)


@contextlib.contextmanager
def process_harness() -> Iterator[ProcessHarness]:
    """A harness on a ROS domain and in a folder of its own."""
    with own_domain() as domain, tempfile.TemporaryDirectory(prefix="dm-bench-") as folder:
        harness = ProcessHarness(domain, Path(folder))
        # A full garbage collection through everything that other jobs have imported would stall the client.
        gc.collect()
        gc.freeze()
        try:
            yield harness
        finally:
            gc.unfreeze()
            harness.close()
