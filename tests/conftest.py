"""Fixtures of the cross-package tests."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from dm_calibration import calibrator
from dm_calibration.procedure import forecast
from support import NodeProcess, only_common_laws


@pytest.fixture(scope="session", autouse=True)
def _own_ros_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Nodes keep nothing in the home of who runs the tests, and find nothing there."""
    os.environ["ROS_HOME"] = str(tmp_path_factory.mktemp("ros_home"))
    yield
    del os.environ["ROS_HOME"]


@pytest.fixture(scope="module")
def common_laws(request: pytest.FixtureRequest) -> Iterator[None]:
    """As :func:`support.only_common_laws`, while the module is tested; it may name laws as TRIED_LAWS."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (calibrator, forecast):
            patch.setattr(module, "fit_hysteresis", module.fit_hysteresis)  # put back at the end
        only_common_laws(getattr(request.module, "TRIED_LAWS", ()))
        yield


@pytest.fixture
def start(domain: int, tmp_path: Path) -> Iterator[Callable[..., NodeProcess]]:
    """start(package, executable, parameters) starts a node as a process; all are stopped after the test."""
    started: list[NodeProcess] = []

    def begin(package: str, executable: str, parameters: Mapping[str, Any], *arguments: str) -> NodeProcess:
        process = NodeProcess(package, executable, parameters, tmp_path / f"node{len(started)}", domain, arguments)
        started.append(process)
        return process

    yield begin
    for process in reversed(started):
        if process.running:
            process.stop()
