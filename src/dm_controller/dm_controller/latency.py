"""How long a command takes until the driver has made the first write of it."""

from __future__ import annotations

import statistics
from collections import deque

import numpy as np
from dm_msgs.msg import ActuatorCommand, ActuatorState

from dm_common.messages import stamp_ns

#: Moves over which it is taken.
MOVES = 20
#: A first write later than this is of another clock, or of a report that came too late, s.
LATENCY_MAX_S = 1.0


class Latency:
    """From the stamps of commands and of the driver's reports."""

    def __init__(self) -> None:
        self._awaited: ActuatorCommand | None = None
        self._seconds: deque[float] = deque(maxlen=MOVES)

    @property
    def typical(self) -> float:
        """s, median; 0 = not known."""
        return statistics.median(self._seconds) if self._seconds else 0.0

    def sent(self, command: ActuatorCommand) -> None:
        """This command went out."""
        self._awaited = command

    def observe(self, report: ActuatorState) -> bool:
        """Take the driver's next report; returns whether the latency is known from now on."""
        command = self._awaited
        if command is None or len(report.requested) != len(command.signals):
            return False
        if not np.array_equal(np.array(report.requested), np.array(command.signals)):
            return False
        self._awaited = None
        seconds = 1e-9 * (stamp_ns(report.header.stamp) - stamp_ns(command.header.stamp))
        if not 0.0 <= seconds <= LATENCY_MAX_S:
            return False
        self._seconds.append(seconds)
        return len(self._seconds) == 1
