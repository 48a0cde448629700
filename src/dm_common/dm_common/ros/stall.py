"""Ends a node whose middleware is deadlocked, so that its supervisor can restart it.

Fast DDS 2.14 occasionally deadlocks when a client leaves: the thread that removes the client holds the participant's
mutex and waits for the thread of timed events, which needs that mutex to assert the node's liveliness
(eProsima/Fast-DDS#6502). The process stays alive, but neither receives nor sends anything any more.
"""

import math
import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from rclpy.logging import get_logger

#: The threads of this process, and the prefix of the names of those for timed events.
TASKS, NAME = Path("/proc/self/task"), "dds.ev."
#: Pause between two checks, s (wall time), and the number of checks in a row without a new wake-up of such a thread,
#: once seen to wake, that shows a deadlock. These threads wake for each lease and at least for every announcement: each
#: second with config/fastdds.xml of dm_bringup, every three without it. Checks are counted rather than time, so that a
#: stopped process or a machine that slept continues where it was.
CHECK_S, CHECKS = 3.0, 15
#: Time allowed for the ramp to the safe shape, s; the kernel then kills the process, which could never end by itself.
END_S = 15


def watch() -> None:
    """Watch this process from a thread of its own."""
    threading.Thread(target=_watch, args=(CHECK_S, end), name="stall", daemon=True).start()


def wakes(tasks: Path = TASKS) -> dict[str, int]:
    """{thread: number of its voluntary waits} of the threads for timed events; {} with another middleware."""
    found: dict[str, int] = {}
    for task in tasks.iterdir() if tasks.is_dir() else ():
        with suppress(OSError, StopIteration):  # it has just ended
            if (task / "comm").read_text().startswith(NAME):
                lines = (task / "status").read_text().splitlines()
                found[task.name] = int(next(line for line in lines if line.startswith("voluntary")).split()[1])
    return found


def _watch(pause: float, on_deadlock: Callable[[], None], tasks: Path = TASKS) -> None:
    seen: dict[str, tuple[int, float]] = {}  # number of its waits, and checks without a new one
    while now := wakes(tasks):
        for thread, count in now.items():
            before, checks = seen.get(thread, (count, -math.inf))
            seen[thread] = (count, checks + 1 if count == before else 0)
        if any(seen[thread][1] >= CHECKS for thread in now):
            on_deadlock()
            return
        time.sleep(pause)


def end() -> None:
    """End this process in as orderly a way as possible: the loop ends, the mirror is made safe."""
    signal.alarm(END_S)  # by the kernel, and first: the stuck thread may hold Python's lock, or that of the log
    get_logger("dm_common.ros").error(
        "the middleware Fast DDS hangs (eProsima/Fast-DDS#6502): this node ends; start it again"
    )
    os.kill(os.getpid(), signal.SIGTERM)
