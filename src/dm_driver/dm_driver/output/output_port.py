"""One drive unit as the writer sees it: shapes go in, what then stands at the actuators comes back."""

import logging
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dm_common.errors import Refusal
from dm_driver.electronics.base import DriveElectronics
from dm_driver.last_shape import LastShape
from dm_driver.output.output_stage import OutputStage
from dm_driver.safety_limiter import SafetyLimiter, Shape

#: A link that opened counts as standing when it still does after this time: a busy EDAC40 accepts a second TCP client
#: only to close it, and a datagram's "port unreachable" takes a moment to return.
CONFIRM_S = 0.05


class Written(NamedTuple):
    """What a write has left at the actuators.

    Attributes:
        applied: (N,) signals, after quantisation.
        volts: (N,) V.
        stamp_ns: when, in the caller's clock.
        at: when, s of the steady clock.
    """

    applied: Shape
    volts: NDArray[np.float64]
    stamp_ns: int
    at: float


class OutputPort:
    """Electronics, output stage and the record of the last shape; for one thread, but for `recorded_shape`.

    Args:
        electronics: the unit.
        output: how a shape becomes codes.
        limiter: judges every write.
        stamp_ns: the clock that `Written.stamp_ns` is taken from.
        last: what an earlier driver of this unit sent last, and where this one records what it sends.
    """

    def __init__(
        self,
        electronics: DriveElectronics,
        output: OutputStage,
        limiter: SafetyLimiter,
        stamp_ns: Callable[[], int],
        last: LastShape,
    ) -> None:
        self.electronics = electronics
        self._output = output
        self._limiter = limiter
        self._stamp_ns = stamp_ns
        self._last = last
        self._recording = True

    def confirm(self) -> None:
        """Find out whether a link that was just opened stands.

        Raises:
            LinkError: it does not.
        """
        time.sleep(CONFIRM_S)
        self.electronics.check()

    def write(self, previous: Shape | None, shape: Shape) -> Written:
        """Write a shape (N,).

        Args:
            previous: (N,) what was written before; None when the outputs are unknown, so that no step can be judged.

        Raises:
            Refusal: not a legal shape or step; nothing was sent.
            ElectronicsError: the unit did not take it.
        """
        self._limiter.check_write(previous, shape)
        self._record(shape)
        codes = self._output.codes(shape)
        self.electronics.write(codes, self._output.wired)
        stamp_ns, now = self._stamp_ns(), time.monotonic()
        return Written(*self._output.outcome(codes), stamp_ns, now)

    def recorded_shape(self) -> Shape | None:
        """(N,) what an earlier driver of this unit sent last; None when unknown, or no legal shape any more."""
        shape = self._last.load()
        if shape is None:
            return None
        try:
            return self._limiter.check_shape(shape)
        except Refusal:  # the limits have changed: no legal way begins there
            return None

    def close(self) -> None:
        """Close the link and the record."""
        self.electronics.close()
        self._last.close()

    def _record(self, shape: Shape) -> None:
        try:
            self._last.note(shape)
            self._recording = True
        except OSError as error:  # a full disk must not stop the mirror
            if self._recording:
                logging.getLogger(__name__).warning("the last shape cannot be recorded: %s", error)
            self._recording = False
