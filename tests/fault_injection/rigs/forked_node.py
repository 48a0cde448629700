"""Nodes as processes forked off one that has imported them already.

A fresh interpreter takes most of a second of processor time to import ROS, numerics and a node. Tests start hundreds of
nodes, so they are forked off a server that has imported them all once. Nothing of ROS is initialised there; from
`main()` of the node on all is as with `python -m`.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import wait
from pathlib import Path
from types import MappingProxyType
from typing import Any

from dm_bringup.nodes import MODULES
from dm_bringup.suite import Suite

_CONTEXT = multiprocessing.get_context("forkserver")
#: Packages whose messages nodes speak. Each node loads their libraries when it is made, and the generator of interfaces
#: with its parser of grammars.
_SPOKEN = (
    *("action_msgs", "builtin_interfaces", "diagnostic_msgs", "dm_msgs", "lifecycle_msgs", "rcl_interfaces"),
    *("sensor_msgs", "service_msgs", "std_msgs", "std_srvs", "type_description_interfaces", "unique_identifier_msgs"),
)
_LIBRARIES = [f"{package}.{package}_s__rosidl_typesupport_c" for package in _SPOKEN]
_GENERATOR = ["rosidl_generator_py", "service_msgs.msg", "type_description_interfaces.msg"]
_CONTEXT.set_forkserver_preload([__name__, *MODULES.values(), *_GENERATOR, *_LIBRARIES])


class ForkedNode:
    """A node's process, to be handled as a :class:`subprocess.Popen`.

    Args:
        module: of the node, as `python -m` takes it.
        arguments: of its command line.
        log: file that its output is added to.
        environment: variables beside those of this process.
        prepare: called there before the node begins; None = nothing is.
    """

    def __init__(
        self,
        module: str,
        arguments: Sequence[str],
        log: Path,
        environment: Mapping[str, str] | None = None,
        prepare: Callable[[], None] | None = None,
    ) -> None:
        self.args = ["python", "-m", module, *arguments]
        own = {**os.environ, **(environment or {})}
        job = (module, [module, *arguments], str(log), own, str(Path.cwd()), prepare)
        # A daemon ends with this process, whatever becomes of a test.
        self._process = _CONTEXT.Process(target=_run, args=job, daemon=True)
        self._process.start()
        assert self._process.pid is not None
        self.pid: int = self._process.pid

    def poll(self) -> int | None:
        """The exit status, below 0 the signal that ended it; None = it runs."""
        return self._process.exitcode

    @property
    def returncode(self) -> int | None:
        """As :meth:`poll`."""
        return self.poll()

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end; the exit status.

        Raises:
            subprocess.TimeoutExpired: it goes on.
        """
        wait([self._process.sentinel], timeout)
        status = self.poll()
        if status is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return status

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        try:
            os.kill(self.pid, number)
        except ProcessLookupError:
            pass

    def kill(self) -> None:
        """End it without warning."""
        self.send_signal(signal.SIGKILL)


#: What nodes run as.
Process = subprocess.Popen[bytes] | ForkedNode


class ForkedSuite(Suite):
    """The nodes named in a configuration, forked off the server.

    Attributes:
        prepare: functions that are called in the process of a node before it begins, by the node's name.
    """

    prepare: Mapping[str, Callable[[], None]] = MappingProxyType({})

    def _process(self, name: str, arguments: list[str]) -> Any:
        return ForkedNode(MODULES[name], arguments, self.log(name), self._environment, self.prepare.get(name))


def _end_with_the_tests() -> None:
    """End this process when the one that asked for it has gone: killed, it could not end its daemons."""
    tests = multiprocessing.parent_process()
    assert tests is not None
    tests.join()
    os.kill(os.getpid(), signal.SIGKILL)


def _run(
    module: str,
    arguments: list[str],
    log: str,
    environment: dict[str, str],
    folder: str,
    prepare: Callable[[], None] | None,
) -> None:
    """What the forked process does."""
    gc.freeze()  # what the server has imported is no garbage, and shared until somebody looks
    threading.Thread(target=_end_with_the_tests, daemon=True).start()
    os.setsid()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    with open(log, "ab", buffering=0) as output:  # noqa: PTH123
        for number in (1, 2):
            os.dup2(output.fileno(), number)
    sys.argv = arguments
    if prepare is not None:
        prepare()
    try:
        status = importlib.import_module(module).main()
    finally:
        atexit._run_exitfuncs()
    sys.exit(status)
