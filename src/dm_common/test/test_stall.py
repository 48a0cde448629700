"""A node whose middleware stands still ends."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dm_common.ros import stall

#: The threads for timed events are made to look as if they slept for ever; the way out of the middleware hangs.
STUCK = """
import sys, time
from dm_common.ros import executor, stall
from rclpy.node import Node

class Careful(Node):
    def __init__(self):
        super().__init__("careful")
        print("ready", flush=True)
    def make_safe(self):
        print("safe", flush=True)

looks = iter(range(8))
stall.CHECK_S, stall.END_S, stall.wakes = 0.02, 1, lambda _tasks: {"1": next(looks, 7)}
executor.rclpy.try_shutdown = lambda: time.sleep(100.0)
sys.exit(executor.run_node(Careful))
"""


def test_a_stuck_node_is_made_safe_and_ends_whatever_hangs(domain: int, tmp_path: Path) -> None:
    script = tmp_path / "stuck.py"
    script.write_text(STUCK)
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=30)
    assert done.stdout == "ready\nsafe\n", done.stderr
    assert done.returncode == -signal.SIGALRM and "the middleware Fast DDS hangs" in done.stdout + done.stderr


def test_threads_that_wake_do_not_count_as_stuck(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def task(number: int, name: str, slept: int) -> None:
        (tmp_path / str(number)).mkdir(exist_ok=True)
        (tmp_path / str(number) / "comm").write_text(f"{name}\n")
        (tmp_path / str(number) / "status").write_text(f"Name:\t{name}\nvoluntary_ctxt_switches:\t{slept}\n")

    task(1, "python", 3)
    assert stall.wakes(tmp_path) == {}
    task(2, "dds.ev.0", 8)
    task(3, "dds.ev.1", 8)
    assert stall.wakes(tmp_path) == {"2": 8, "3": 8}
    checks, ended, real = [0], list[int](), stall.wakes

    def wakes(_tasks: Path) -> dict[str, int]:
        checks[0] += 1
        return {"2": checks[0], "3": min(checks[0], 20)}

    monkeypatch.setattr(stall, "wakes", wakes)
    stall._watch(0.0, lambda: ended.append(checks[0]), tmp_path)
    assert ended == [20 + stall.CHECKS]
    assert not real(tmp_path / "none"), "no such system"
    # A count that never changes tells nothing.
    counts = iter([{"2": 5}] * 100 + [{}])
    monkeypatch.setattr(stall, "wakes", lambda _tasks: next(counts))
    stall._watch(0.0, lambda: ended.append(0), tmp_path)
    assert len(ended) == 1


def test_a_node_that_lives_wakes_up(domain: int, tmp_path: Path) -> None:
    script = tmp_path / "living.py"
    script.write_text(
        "import sys, time, rclpy\n"
        "from dm_common.ros import stall\n"
        "rclpy.init()\n"
        "node = rclpy.create_node('living')\n"
        "before = stall.wakes()\n"
        "time.sleep(stall.CHECK_S)\n"
        "assert before and all(count > before[thread] for thread, count in stall.wakes().items())\n"
    )
    began = time.monotonic()
    subprocess.run([sys.executable, str(script)], check=True, timeout=30)
    assert time.monotonic() - began > stall.CHECK_S
