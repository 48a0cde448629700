"""Fixtures of the cross-package tests."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from dm_calibration.hysteresis.candidate_fit import CANDIDATES
from dm_calibration.hysteresis.hysteresis_fit import fit_hysteresis
from support import NodeProcess


@pytest.fixture(scope="session", autouse=True)
def _own_ros_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Nodes keep nothing in the home of who runs the tests, and find nothing there."""
    os.environ["ROS_HOME"] = str(tmp_path_factory.mktemp("ros_home"))
    yield
    del os.environ["ROS_HOME"]


@pytest.fixture(scope="module")
def common_laws() -> Iterator[None]:
    """Calibrations in this process try no laws of each actuator by itself, which take half the time.

    For simulations whose actuators are alike; tests of laws try them all.
    """
    common = partial(fit_hysteresis, candidates=[candidate for candidate in CANDIDATES if not candidate.own])
    with pytest.MonkeyPatch.context() as patch:
        for module in ("calibrator", "procedure.forecast"):
            patch.setattr(f"dm_calibration.{module}.fit_hysteresis", common)
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
