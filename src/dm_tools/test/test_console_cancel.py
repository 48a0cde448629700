"""Cancelling from the console while a goal is only about to begin: on the way to its node, or its node is not there."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from dm_msgs.action import Calibrate
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dm_common.errors import Refusal
from dm_common.ros.domains import own_domain
from dm_common.ros.executor import BackgroundExecutor
from dm_common.ros.worker import WorkerActionServer
from dm_tools.console.console_node import ConsoleNode

pytestmark = pytest.mark.processes

LONGEST_S = 60.0


def until_cancelled(goal_handle: ServerGoalHandle) -> tuple[str, Any]:
    deadline = time.monotonic() + LONGEST_S
    while time.monotonic() < deadline:
        if goal_handle.is_cancel_requested:
            return "canceled", Calibrate.Result(error_code=1, message="canceled by the node")
        time.sleep(0.01)
    return "succeed", Calibrate.Result()


@pytest.fixture
def bench() -> Iterator[tuple[ConsoleNode, Node]]:
    """The console's side, and a node of the action `calibrate` that nobody serves yet."""
    with own_domain() as domain:
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        node = Node("played_calibration", context=context)
        WorkerActionServer(node, Calibrate, "calibrate", until_cancelled)
        side = ConsoleNode(domain=domain)
        yield side, node
        side.close()
        context.try_shutdown()


def test_a_goal_that_is_not_accepted_yet_is_cancelled_as_soon_as_it_is(bench: tuple[ConsoleNode, Node]) -> None:
    side, node = bench

    async def scene() -> BackgroundExecutor:
        run = asyncio.create_task(side.run("calibrate", Calibrate.Goal(), lambda _feedback: None))
        while not side._connection.clients["calibrate"]._pending_goal_requests:
            await asyncio.sleep(0.01)
        await side.cancel("calibrate")
        served = BackgroundExecutor(node)  # only now does the node take the goal
        with pytest.raises(Refusal, match="canceled by the node"):
            await run
        return served

    asyncio.run(asyncio.wait_for(scene(), LONGEST_S)).destroy_node()


def test_a_goal_whose_answer_was_lost_is_seen_and_can_be_cancelled(
    bench: tuple[ConsoleNode, Node], monkeypatch: pytest.MonkeyPatch
) -> None:
    side, node = bench

    async def scene() -> BackgroundExecutor:
        # By then the node must have been found, and its answer not have come.
        monkeypatch.setattr(side._connection, "_timeout_s", 3.0)
        with pytest.raises(Refusal, match="no answer to the goal"):
            await side.run("calibrate", Calibrate.Goal(), lambda _feedback: None)
        monkeypatch.undo()
        served = BackgroundExecutor(node)
        while side.external_action != "calibrate":
            await asyncio.sleep(0.01)
        await side.cancel("calibrate")
        while side.external_action:
            await asyncio.sleep(0.01)
        return served

    asyncio.run(asyncio.wait_for(scene(), LONGEST_S)).destroy_node()


def test_a_goal_that_is_not_sent_yet_never_begins(
    bench: tuple[ConsoleNode, Node], monkeypatch: pytest.MonkeyPatch
) -> None:
    side, node = bench
    served = BackgroundExecutor(node)
    found = threading.Event()
    monkeypatch.setattr(side._connection.clients["calibrate"], "server_is_ready", found.is_set)

    async def scene() -> None:
        run = asyncio.create_task(side.run("calibrate", Calibrate.Goal(), lambda _feedback: None))
        await asyncio.sleep(0.0)  # it looks for the node
        await side.cancel("calibrate")
        found.set()
        with pytest.raises(Refusal, match="cancelled before it began"):
            await run

    asyncio.run(asyncio.wait_for(scene(), LONGEST_S))
    assert side.watched["calibrate"].goals == 0
    served.destroy_node()
