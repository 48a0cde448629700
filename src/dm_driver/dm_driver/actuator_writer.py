"""Commands to the drive electronics, from any thread: enable, command, degauss, disable.

The latest command wins. A move is cut into steps by the safety limiter and written by `dm_driver.writer_thread`.
"""

import time

from dm_common.errors import ErrorCode, Refusal
from dm_driver.moves import Kind, Move, Outcome
from dm_driver.safety_limiter import Shape, largest_change
from dm_driver.writer_thread import WriterThread

#: Outcomes of the move to the safe shape after which the mirror is where a command brought it.
_UNDER_CONTROL = (Outcome.REACHED, Outcome.SUPERSEDED)


class ActuatorWriter(WriterThread):
    """Writes shapes to a drive unit, within the limits. Takes the arguments of its base class."""

    def wait_for_link(self, timeout_s: float) -> bool:
        """Whether the link is up, now or within `timeout_s`."""
        with self._change:
            return self._change.wait_for(lambda: self._link_up or self._stopping, timeout_s) and self._link_up

    def enable(self, timeout_s: float) -> bool:
        """Allow writes; the mirror goes to the safe shape first. Returns whether it got there within `timeout_s`.

        No unit can be read back. The ramp begins at the shape written last, by this object or, according to the record
        `last`, by another driver: that shape is written again, then the ramp follows. If no last shape is known, the
        safe shape is written in one step. Without a link all this happens as soon as the link is up, and a link lost
        during the ramp only delays it; an accepted command replaces it.
        """
        move: Move | None = None
        with self._change:
            known = self._last.known(self._shape, self._output.scale, self._limiter)
            start = self._safe_shape if known is None else known
            self._enabled = self._accepting = self._rewrite_due = True
            self._shape = self._queue.requested = start
            self._sequence = 0
            self._queue.forget_history()
            if largest_change(start, self._safe_shape) > 0.0:
                move = Move(Kind.SAFE, self._safe_shape)
                self._put(move)
            self._change.notify_all()
            written = self._change.wait_for(lambda: not self._rewrite_due, timeout_s)
        if move is None or not written:
            return written
        limit = time.monotonic() + timeout_s + self._limiter.ramp_time(start, self._safe_shape)
        # Without a link there is no point in waiting: the move continues once the link is back.
        while (outcome := move.wait(0.02)) is None and self._link_up and time.monotonic() < limit:
            pass
        return outcome in _UNDER_CONTROL  # a command that came meanwhile is as good: the way to it is a ramp too

    def disable(self, timeout_s: float) -> Outcome:
        """Ramp to the safe shape, then forbid writes. Commands are refused from the call on.

        A slow unit may need longer than the limits do: the ramp is given up only when no frame is taken in `timeout_s`.
        """
        with self._change:
            self._accepting = False
            if not self._enabled:
                return Outcome.REACHED
            move = Move(Kind.SAFE, self._safe_shape)
            if self._link_up:
                self._put(move)
            else:
                move.finish(Outcome.LINK_LOST)
        written = self.counters.frames
        while (outcome := move.wait(timeout_s)) is None and written != self.counters.frames:
            written = self.counters.frames
        with self._change:
            self._enabled = self._rewrite_due = False
            self._queue.end_all(Outcome.STOPPED, self._shape)
            self._watchdog.disarm()
            self._change.notify_all()
        return outcome or Outcome.STOPPED

    def command(self, shape: Shape) -> Move:
        """Move to `shape`, which `SafetyLimiter.check_shape` has passed; a move under way is abandoned for it.

        Raises:
            Refusal: DRIVER_INACTIVE or ELECTRONICS_UNREACHABLE.
        """
        return self.submit(Move(Kind.COMMAND, shape))

    def submit(self, move: Move) -> Move:
        """Begin and return `move`, a legal one such as `degauss_move` makes; the one under way is abandoned for it.

        Raises:
            Refusal: DRIVER_INACTIVE or ELECTRONICS_UNREACHABLE.
        """
        with self._change:
            if not self._accepting or self._stopping:
                raise Refusal(ErrorCode.DRIVER_INACTIVE, "the driver is not active: activate it first")
            if not self._link_up:
                raise Refusal(
                    ErrorCode.ELECTRONICS_UNREACHABLE, f"the drive electronics are unreachable: {self._fault}"
                )
            self._watchdog.feed(time.monotonic())
            self._put(move)
            return move

    def correct(self, shape: Shape, turns: int) -> Move | None:
        """As `command`, but only if the mirror rests and has made exactly this number of `turns`.

        Returns None, and does nothing, if another command came since: a correction must not undo it.
        """
        with self._change:
            if self._queue.newest is not None or self._queue.turns != turns:
                self.counters.overtaken += 1
                return None
            return self.command(shape)

    def turn_back(self, move: Move, halt: bool = False) -> Move | None:
        """Abandon `move` and return to the shape requested before it; with `halt`, stop at the present shape.

        Returns the move back; None = another command came since.
        """
        with self._change:
            target = self._shape if halt else move.before
            if self._queue.newest is not move or target is None:
                return None
            back = Move(Kind.COMMAND, target)
            self._watchdog.feed(time.monotonic())
            self._put(back)
            return back

    def ramp_time(self, target: Shape) -> float:
        """Seconds that the slew limit needs from the present shape to `target`; 0 before the first write."""
        with self._change:
            shape = self._shape if self._applied is not None else None
        return self._limiter.ramp_time(shape, target) if shape is not None else 0.0
