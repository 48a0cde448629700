"""Time of a bench that runs faster (or slower) than the wall clock."""

from __future__ import annotations

import time


class FastClock:
    """Starts at the Unix time of its making and runs at `speed` times the wall clock."""

    def __init__(self, speed: float) -> None:
        self.speed = speed
        self._start_ns = time.time_ns()
        self._origin_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """Time in ns since the Unix epoch."""
        return self._start_ns + round(self.speed * (time.monotonic_ns() - self._origin_ns))
