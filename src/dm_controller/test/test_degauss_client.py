"""The client of the driver's degauss: a run that was given up must not move the mirror later."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from dm_msgs.action import Degauss

from dm_common.ros.worker import WorkerActionServer
from dm_controller.conditioning import Run
from dm_controller.focus_actions import DegaussClient
from dm_controller.focus_types import StartDegauss
from ros_fixtures import Observer
from waiting import wait_until


@pytest.mark.parametrize("given_up", [True, False])
def test_a_run_that_waits_for_the_driver_is_called_unless_it_was_given_up(observer: Observer, given_up: bool) -> None:
    asked: list[int] = []
    ended = threading.Event()

    def serve(handle: Any) -> tuple[str, Any]:
        asked.append(handle.request.steps)
        return "succeed", Degauss.Result()

    client = DegaussClient(observer.node, lambda *_result: ended.set())
    client.start(StartDegauss(1, 10))
    assert not client.offered
    if given_up:
        client.retry(None)
    WorkerActionServer(observer.node, Degauss, "degauss", serve)
    wait_until(lambda: client.offered)
    if given_up:
        for _ in range(10):
            client.retry(None)
            ended.wait(0.1)
        assert not asked
        client.start(StartDegauss(2, 20))
    run = Run(2, 20, 0.0, 0, 0) if given_up else Run(1, 10, 0.0, 0, 0)

    def answered() -> bool:
        client.retry(run)
        return ended.is_set()

    wait_until(answered)
    assert asked == [run.steps]
