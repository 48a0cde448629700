"""The client of the driver's degauss: a run that no driver took must not move the mirror later."""

from __future__ import annotations

import threading
from typing import Any

from dm_msgs.action import Degauss

from dm_common.ros.worker import WorkerActionServer
from dm_controller.focus_actions import DegaussClient
from dm_controller.focus_types import StartDegauss
from ros_fixtures import Observer
from waiting import wait_until


def test_a_run_that_no_driver_was_there_for_is_not_made_up_for_later(observer: Observer) -> None:
    served: list[int] = []
    results: list[Any] = []
    ended = threading.Event()

    def serve(handle: Any) -> tuple[str, Any]:
        served.append(handle.request.steps)
        return "succeed", Degauss.Result(duration=0.5)

    def end(*result: Any) -> None:
        results.append(result)
        ended.set()

    client = DegaussClient(observer.node, end)
    client.start(StartDegauss(1, 10))
    assert not client.offered
    WorkerActionServer(observer.node, Degauss, "degauss", serve)
    wait_until(lambda: client.offered)
    assert not ended.wait(1.0)
    client.start(StartDegauss(2, 20))
    assert ended.wait(10.0)
    assert served == [20] and results == [(2, 0.5, None)]
