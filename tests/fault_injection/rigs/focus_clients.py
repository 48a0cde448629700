"""Many clients of one focus controller at once, a thread and a client each. Run as a process.

    python -m fault_injection.rigs.focus_clients CLIENTS ROUNDS SEED

Of every ten clients eight call `set_focus`, one `flatten`, one sends goals of `move_focus` and cancels some. Prints a
line of JSON: requests asked, answered and refused, answers that belong to another request, and the curvatures asked.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from random import Random
from typing import Any

import rclpy
from dm_msgs.action import MoveFocus
from dm_msgs.msg import ErrorCode, FocusRequest
from dm_msgs.srv import Flatten, SetFocus
from rclpy.node import Node

from dm_common.ros import qos
from dm_common.ros.clients import ServiceCallError, ThreadedActionClient, call
from dm_common.ros.executor import BackgroundExecutor

REACH = 0.02
#: Longest wait for one answer, s: far above what a hundred clients need on a busy machine.
ANSWER_S = 30.0


class Clients:
    """The threads and what became of their requests."""

    def __init__(self, node: Node, count: int, rounds: int, seed: int) -> None:
        self.counts: Counter[str] = Counter()
        self.curvatures: list[float] = []
        self._lock = threading.Lock()
        self._rounds = rounds
        self._threads = []
        self.ready: list[Callable[[], bool]] = []
        for number in range(count):
            random = Random(f"{seed}/{number}")
            client, work = self._client(node, number)
            self._threads.append(threading.Thread(target=work, args=(client, random)))

    def _client(self, node: Node, number: int) -> tuple[Any, Callable[[Any, Random], None]]:
        if number % 10 == 9:
            action = ThreadedActionClient(
                node,
                MoveFocus,
                "move_focus",
                goal_service_qos_profile=qos.SERVICE,
                result_service_qos_profile=qos.SERVICE,
            )
            self.ready.append(action.server_is_ready)
            return action, self._move
        kind, name, work = (
            (Flatten, "flatten", self._flatten) if number % 10 == 8 else (SetFocus, "set_focus", self._focus)
        )
        # Every client's reader gets the answers to all of them.
        client = node.create_client(kind, name, qos_profile=qos.SERVICE)
        self.ready.append(client.service_is_ready)
        return client, work

    def run(self) -> None:
        """All at once, until all have done their rounds."""
        for thread in self._threads:
            thread.start()
        for thread in self._threads:
            thread.join()

    def _count(self, state: Any, curvature: float) -> None:
        with self._lock:
            self.counts["answered"] += 1
            self.counts["refused"] += state.error_code != ErrorCode.OK
            self.counts["wrong"] += state.curvature != curvature
            self.counts["wordless"] += state.error_code != ErrorCode.OK and not state.message

    def _count_request(self, curvature: float | None = None) -> None:
        with self._lock:
            self.counts["asked"] += 1
            if curvature is not None:
                self.curvatures.append(curvature)

    def _focus(self, client: Any, random: Random) -> None:
        for _ in range(self._rounds):
            curvature = random.uniform(-REACH, REACH)
            self._count_request(curvature)
            try:
                answer = call(client, SetFocus.Request(request=FocusRequest(curvature=curvature)), ANSWER_S)
            except ServiceCallError:
                continue
            self._count(answer.state, curvature)

    def _flatten(self, client: Any, _random: Random) -> None:
        for _ in range(self._rounds):
            self._count_request()
            try:
                answer = call(client, Flatten.Request(), ANSWER_S)
            except ServiceCallError:
                continue
            self._count(answer.state, 0.0)

    def _move(self, client: Any, random: Random) -> None:
        for _ in range(self._rounds):
            curvature = random.uniform(-REACH, REACH)
            self._count_request()
            accepted = client.send_goal_async(MoveFocus.Goal(request=FocusRequest(curvature=curvature)))
            if not _wait(accepted):
                continue
            result = accepted.result().get_result_async()
            if random.random() < 0.3:
                time.sleep(random.uniform(0.0, 0.05))
                accepted.result().cancel_goal_async()
            if _wait(result):
                outcome = result.result().result
                with self._lock:
                    self.counts["answered"] += 1
                    self.counts["refused"] += outcome.error_code != ErrorCode.OK
                    self.counts["wordless"] += not outcome.message


def _wait(future: Any) -> bool:
    done = threading.Event()
    future.add_done_callback(lambda _future: done.set())
    return done.wait(ANSWER_S)


def main() -> int:
    """Exit status 0 with figures; 1 when the controller did not appear."""
    count, rounds, seed = (int(argument) for argument in sys.argv[1:4])
    rclpy.init()
    node = Node(f"clients_{seed}", enable_rosout=False, start_parameter_services=False)
    clients = Clients(node, count, rounds, seed)
    background = BackgroundExecutor(node)
    deadline = time.monotonic() + 2 * ANSWER_S
    while not all(ready() for ready in clients.ready):
        if time.monotonic() > deadline:
            print("no focus controller", file=sys.stderr)
            return 1
        time.sleep(0.05)
    clients.run()
    figures = {name: clients.counts[name] for name in ("asked", "answered", "refused", "wrong", "wordless")}
    print(json.dumps(figures | {"curvatures": clients.curvatures}))
    background.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
