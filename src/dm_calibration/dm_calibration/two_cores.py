"""Two halves of a job at once, for the few jobs that are long enough to share: a map of a million pixels takes one
millisecond, and waking a thread some 30 microseconds.

NumPy lets go of Python's lock inside its loops, so that threads do run side by side. The halves are always the same
two, on one core too: sums of floating-point numbers must not depend on the machine.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

T = TypeVar("T")

#: Pixels below which waking a thread costs more than it brings.
WORTH_PIXELS = 2**18


@lru_cache(maxsize=1)
def _helper(_process: int) -> ThreadPoolExecutor:
    """The other thread; a forked process does not inherit it and needs its own."""
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix="second-half")


def both(first: Callable[[], T], second: Callable[[], T], pixels: int) -> tuple[T, T]:
    """Run two halves of a job, side by side when the map has enough pixels, and return both results.

    When the other thread is late, because the machine is busy or another job has it, the second half is done here.
    """
    if pixels < WORTH_PIXELS or (os.cpu_count() or 1) < 2:
        return first(), second()
    other = _helper(os.getpid()).submit(second)
    try:
        mine = first()
    except BaseException:
        if not other.cancel():
            other.exception()  # it works on the caller's arrays
        raise
    return mine, second() if other.cancel() else other.result()
