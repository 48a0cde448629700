"""Fixtures of the cross-package tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from support import NodeProcess


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
