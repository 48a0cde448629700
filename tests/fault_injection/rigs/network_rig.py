"""Driver and focus controller on two hosts with a bad cable between them.

Left: the electronics, `pdm_driver`, and who latches the calibration. Right: `focus_controller`, and this process, its
client. DDS looks at the interfaces once per process, so this must be the first that the process does with ROS.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path
from random import Random
from typing import Any, Self
from unittest import mock

import yaml
from dm_msgs.msg import Calibration
from rclpy.serialization import serialize_message

from dm_bringup.nodes import MODULES
from fault_injection.rigs.driver_rig import end_process
from fault_injection.rigs.focus_rig import FocusRig
from fault_injection.rigs.forked_node import Process
from fault_injection.rigs.netem import bad_network
from studies.network_namespaces import command_on, inside

#: Hosts find each other only where discovery is not kept to the loopback.
_ENVIRONMENT = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
_RIGHT_SIDE = MODULES["focus_controller"]


class NetworkRig(FocusRig):
    """Use as a context manager.

    Raises:
        NotPermittedError: this machine does not let us make hosts.
    """

    def __init__(self, folder: Path, domain: int, random: Random, **changes: Any) -> None:
        self._publisher: Process | None = None
        self._stack = contextlib.ExitStack()
        try:
            self.left, self.right, self.netem = self._stack.enter_context(bad_network(random))
            self._stack.enter_context(mock.patch.dict(os.environ, _ENVIRONMENT))
            with inside(self.left):  # the ports of the electronics are there
                super().__init__(folder, domain, **changes)
            self._stack.enter_context(inside(self.right))
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> Self:
        try:
            return super().__enter__()
        except BaseException:
            self._stack.close()
            raise

    def __exit__(self, *exception: object) -> None:
        self.mend()
        with self._stack:
            self.withdraw_calibration()
            super().__exit__(*exception)

    def mend(self) -> None:
        """The cable is as good as new."""
        self.netem.loss, self.netem.delay_s, self.netem.plugged = 0.0, 0.0, True

    def _start(self, module: str, parameters: Path, log: Path) -> Process:
        host = self.right if module == _RIGHT_SIDE else self.left
        with log.open("ab") as output:
            return subprocess.Popen(
                [*command_on(host), sys.executable, "-m", module, "--ros-args", "--params-file", str(parameters)],
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, "ROS_DOMAIN_ID": str(self.domain)},
                start_new_session=True,
            )

    def publish_calibration(self, message: Calibration) -> None:
        """Latch it on the driver's side, in place of the last."""
        self.withdraw_calibration()
        content, parameters = self.folder / "calibration.cdr", self.folder / "latched.yaml"
        content.write_bytes(serialize_message(message))
        parameters.write_text(yaml.safe_dump({"/**": {"ros__parameters": {"file": str(content)}}}))
        self._publisher = self._start("fault_injection.rigs.latched_publisher", parameters, self.folder / "latched.log")

    def withdraw_calibration(self) -> None:
        """Who latches it goes."""
        publisher, self._publisher = self._publisher, None
        if publisher is not None:
            end_process(publisher, signal.SIGINT, "the latched publisher")
