"""A node's end: made safe on signals, and nothing of it left in the graph."""

from __future__ import annotations

import gc
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from dm_msgs.action import MoveFocus
from dm_msgs.srv import Flatten
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from dm_common.ros.worker import WorkerActionServer, WorkerService
from ros_fixtures import Observer
from waiting import wait_until

NODE_SCRIPT = """
import sys, time
from dm_common.ros.executor import run_node
from rclpy.node import Node

class Careful(Node):
    def __init__(self):
        super().__init__("careful")
        print("ready", flush=True)
    def make_safe(self):
        time.sleep(0.5)
        print("safe", flush=True)

sys.exit(run_node(Careful))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_node_is_made_safe_on_signals_even_when_hit_twice(domain: int, tmp_path: Path, number: int) -> None:
    script = tmp_path / "careful.py"
    script.write_text(NODE_SCRIPT)
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.3)
    process.send_signal(number)
    time.sleep(0.2)
    process.send_signal(number)
    output, errors = process.communicate(timeout=15)
    assert output == "safe\n"
    assert "Traceback" not in errors
    assert process.returncode == 0


def test_a_signal_that_comes_before_the_node_is_made_ends_it_in_order(domain: int, tmp_path: Path) -> None:
    """As `dm_bringup.suite` starts it: the signal waits until then."""
    script = tmp_path / "careful.py"
    script.write_text(NODE_SCRIPT)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=300) == ("", "")
    assert process.returncode == 0


@pytest.mark.parametrize("options", [["--params-file", "mixed.yaml"], ["--log-level", "loud"], ["--no-such"]])
def test_options_that_ros_cannot_read_leave_no_traceback(domain: int, tmp_path: Path, options: list[str]) -> None:
    (tmp_path / "careful.py").write_text(NODE_SCRIPT)
    (tmp_path / "mixed.yaml").write_text("careful: {ros__parameters: {places: [0, 0.5]}}\n")
    command = [sys.executable, "careful.py", "--ros-args", *options]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 1 and ended.stdout == ""
    assert "Traceback" not in ended.stderr and options[-1] in ended.stderr.splitlines()[-1]


ENDING_SCRIPT = """
import sys, time
from dm_common.ros.executor import run_node
from dm_common.ros.lifecycle import ManagedNode
from dm_common.ros.parameters import AUTOSTART
from dm_common.ros.worker import WorkerActionServer
from dm_msgs.action import MoveFocus
from std_msgs.msg import String

class Ending(ManagedNode):
    def __init__(self):
        super().__init__("ending", (AUTOSTART,))
        WorkerActionServer(self, MoveFocus, "move", self.run)
        self.create_subscription(String, "text", self.fail, 10)
    def fail(self, message):
        raise KeyError("a defect")
    def deactivate(self):
        raise KeyError("another defect")
    def run(self, goal):
        while not goal.is_cancel_requested:
            time.sleep(0.01)
        time.sleep(0.3)
        return "canceled", MoveFocus.Result(message="ended")

sys.exit(run_node(Ending))
"""


def test_defects_of_a_node_that_ends_keep_no_result_back(observer: Observer, tmp_path: Path) -> None:
    script = tmp_path / "ending.py"
    script.write_text(ENDING_SCRIPT)
    texts = observer.node.create_publisher(String, "text", 10)
    with subprocess.Popen([sys.executable, str(script)], stderr=subprocess.PIPE, text=True) as process:
        _, result = observer.send_goal(MoveFocus, "move", MoveFocus.Goal())
        process.send_signal(signal.SIGINT)
        while process.poll() is None and not result.done():
            texts.publish(String(data="text"))
            time.sleep(0.02)
        errors = process.communicate(timeout=15)[1]
    wait_until(result.done)
    assert result.result().result.message.endswith("ended")
    assert process.returncode == 0 and "'a defect'" in errors and "'another defect'" in errors


@pytest.fixture
def watcher(domain: int) -> Iterator[Node]:
    """A participant of its own, which sees of others what DDS tells it."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    node = Node("watcher", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


@pytest.mark.parametrize("kind", ["service", "action server", "action client", "all, used"])
def test_nothing_of_a_client_stays_in_the_graph(kind: str, domain: int, watcher: Node) -> None:
    def served(_goal: Any) -> tuple[str, Any]:
        return "succeed", MoveFocus.Result()

    # Circles of references must not decide how long a node is seen.
    gc.collect()
    gc.disable()
    try:
        with Observer(domain) as observer:
            if kind in ("service", "all, used"):
                WorkerService(observer.node, Flatten, "flatten", lambda _request, response: response)
            if kind in ("action server", "all, used"):
                WorkerActionServer(observer.node, MoveFocus, "move", served)
            if kind == "action client":
                ActionClient(observer.node, MoveFocus, "move")
            if kind == "all, used":
                observer.call(Flatten, "flatten")
                observer.run_goal(MoveFocus, "move", MoveFocus.Goal())
            wait_until(lambda: "observer" in watcher.get_node_names())
        wait_until(lambda: "observer" not in watcher.get_node_names(), 60, "the node is still in the graph")
    finally:
        gc.enable()
