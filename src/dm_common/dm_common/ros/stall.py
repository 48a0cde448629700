"""Ends a node whose middleware stands still, so that whoever started it starts it again.

Fast DDS 2.14 locks itself up once in a while when a client leaves: the thread that takes the client out holds the
participant's mutex and waits for the thread of timed events, which wants that mutex to say that the node lives
(eProsima/Fast-DDS#6502). The process lives on, but hears nothing and is not heard, for ever.
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

#: The threads of this process, and how those for timed events are named.
TASKS, NAME = Path("/proc/self/task"), "dds.ev."
#: Wall time between two looks, s, and how many in a row must see such a thread where it was, after it has been seen to
#: wake. They wake up for each lease and at least at every announcement: each second by config/fastdds.xml of
#: dm_bringup, every three without it. Looks are counted, and not the time: a process that was stopped, or a machine
#: that slept, goes on where it was.
LOOK_S, LOOKS = 3.0, 15
#: Time for the way to the safe shape, s; what takes longer is cut off, for nothing after it comes to an end.
END_S = 15


def watch() -> None:
    """Watch this process from a thread of its own."""
    threading.Thread(target=_watch, args=(LOOK_S, end), name="stall", daemon=True).start()


def wakes(tasks: Path = TASKS) -> dict[str, int]:
    """{thread: how often it has gone to sleep}, of the threads for timed events; {} with another middleware."""
    found: dict[str, int] = {}
    for task in tasks.iterdir() if tasks.is_dir() else ():
        with suppress(OSError, StopIteration):  # it has just ended
            if (task / "comm").read_text().startswith(NAME):
                lines = (task / "status").read_text().splitlines()
                found[task.name] = int(next(line for line in lines if line.startswith("voluntary")).split()[1])
    return found


def _watch(pause: float, stand_still: Callable[[], None], tasks: Path = TASKS) -> None:
    seen: dict[str, tuple[int, float]] = {}  # times it slept, and looks that found no more
    while now := wakes(tasks):
        for thread, count in now.items():
            before, looks = seen.get(thread, (count, -math.inf))
            seen[thread] = (count, looks + 1 if count == before else 0)
        if any(seen[thread][1] >= LOOKS for thread in now):
            stand_still()
            return
        time.sleep(pause)


def end() -> None:
    """End this process in order as far as that goes: the loop ends, the mirror is made safe."""
    signal.alarm(END_S)  # of the system, and first: what is stuck may hold Python's lock, or that of the log
    get_logger("dm_common.ros").error(
        "the middleware stands still (eProsima/Fast-DDS#6502): this node ends, and is to be started again"
    )
    os.kill(os.getpid(), signal.SIGTERM)
