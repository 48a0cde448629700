"""Which images show the focus that was asked for: those exposed after the move had ended and settled."""

from __future__ import annotations

import math


class SettledGate:
    """Ties images to a move through their time stamps. All times in s of one clock.

    Args:
        settle_time: wait after the last write to the electronics [s].
        stamp_lead: by how much the exposure began before the image's stamp [s]; 0 = stamps mark its beginning.

    Attributes:
        settled_at: when the shape of the last move stands; inf = not known yet.
    """

    def __init__(self, settle_time: float, stamp_lead: float = 0.0) -> None:
        self._settle_time = settle_time
        self._stamp_lead = stamp_lead
        self._sent_at = math.inf
        self._stands_at = math.inf
        self.settled_at = math.inf

    def sent(self, stamp: float, duration: float = 0.0) -> None:
        """A command left at `stamp`; its shape is predicted to stand `duration` later."""
        self._sent_at = stamp
        self._stands_at = stamp + duration
        self.settled_at = math.inf

    def written(self, stamp: float, moving: bool, reached: bool) -> None:
        """The driver reports its last write at `stamp`; `reached`: what stands is already what the command asked for.

        A report older than the command counts only when nothing had to move.
        """
        if math.isinf(self.settled_at) and not moving and (stamp >= self._sent_at or reached):
            self.settled_at = max(stamp, self._stands_at) + self._settle_time

    def open_for(self, stamp: float) -> bool:
        """Whether an image with this stamp was exposed after the shape stood."""
        return stamp - self._stamp_lead >= self.settled_at
