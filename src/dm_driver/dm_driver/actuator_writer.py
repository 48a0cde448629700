"""The one thread that owns the drive electronics.

Commands arrive in a mailbox where the latest wins. A move is cut into steps by the safety limiter, paced so that the
slew rate holds, and left at once for a newer command. After a lost link the thread tries to reconnect once a second and
then writes the last shape again.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator

from dm_common.errors import ErrorCode, Refusal
from dm_driver.degauss import degauss_waypoints
from dm_driver.electronics.base import DriveElectronics, ElectronicsError
from dm_driver.last_shape import LastShape
from dm_driver.moves import Counters, Kind, Move, Outcome, WriterState
from dm_driver.output.output_stage import OutputStage
from dm_driver.safety_limiter import SafetyLimiter, Shape, Watchdog, largest_change

RECONNECT_PERIOD_S = 1.0
CHECK_PERIOD_S = 0.25
#: A link that opened counts as standing when it still does after this time: a busy EDAC40 accepts a second TCP client
#: only to close it, and a datagram's "port unreachable" takes a moment to return.
CONFIRM_S = 0.05
#: A degauss of at least this share of the full range wipes the memory.
FULL_CYCLE = 0.999

#: Ends of the way to the safe shape after which the mirror stands where a driver brought it.
_UNDER_CONTROL = (Outcome.REACHED, Outcome.SUPERSEDED)

Listener = Callable[[WriterState, bool], None]


class ActuatorWriter:
    """Write shapes to a drive unit, within the limits.

    Args:
        electronics: the unit; opened, used and closed by this object's thread only.
        output: how a shape becomes codes.
        limiter: judges every write.
        safe_shape: (N,) legal signals: written first when enabled, and ramped to by `disable` and the watchdog.
        listener: called in the writer's thread with the new state after every change; the flag is False for a
            write in the middle of a move, True for everything else. Must return soon.
        watchdog_s: without a command for this long the mirror goes to `safe_shape`; 0 = never.
        stamp_ns: the clock that `WriterState.stamp_ns` is taken from.
        last: what an earlier driver of this unit sent last, and where this one notes what it sends.
    """

    def __init__(
        self,
        electronics: DriveElectronics,
        output: OutputStage,
        limiter: SafetyLimiter,
        safe_shape: Shape,
        listener: Listener = lambda state, edge: None,
        watchdog_s: float = 0.0,
        stamp_ns: Callable[[], int] = time.time_ns,
        last: LastShape | None = None,
    ) -> None:
        self.counters = Counters()
        self._electronics = electronics
        self._output = output
        self._limiter = limiter
        self._safe_shape = limiter.check_shape(safe_shape, "safe_signals")
        self._listener = listener
        self._watchdog = Watchdog(watchdog_s)
        self._stamp_ns = stamp_ns
        self._last = last if last is not None else LastShape(None, limiter.limits.actuators)
        self._noting = True
        self._thread = threading.Thread(target=self._run, name="actuator_writer", daemon=True)
        # Everything below is guarded by this condition; it is notified at every change.
        self._change = threading.Condition()
        self._stopping = False
        self._enabled = False
        self._accepting = False
        self._link_up = False
        self._was_up = False
        self._fault = "not opened yet"
        self._rewrite_due = False
        self._mailbox: Move | None = None
        self._current: Move | None = None
        self._steps: Iterator[Shape] = iter(())
        self._next_shape: Shape | None = None
        self._under_way = False  # the current move has written a step
        self._shape: Shape | None = None  # before quantisation; ramps start here, so that rounding cannot add up
        self._requested: Shape | None = None
        self._written: tuple[Shape, Shape, int] | None = None  # applied, volts, stamp
        self._sequence = 0
        self._history_known = False
        self._degausses = 0
        self._turns = 0
        self._turned_at: Shape | None = None
        self._write_at = 0.0
        self._check_at = 0.0
        self._retry_at = 0.0

    # What other threads call

    def start(self) -> None:
        """Begin: open the electronics and keep the link. Nothing is written before `enable`."""
        self._thread.start()

    def wait_for_link(self, timeout_s: float) -> bool:
        """Whether the link stands, now or within `timeout_s`."""
        with self._change:
            return self._change.wait_for(lambda: self._link_up or self._stopping, timeout_s) and self._link_up

    def enable(self, timeout_s: float) -> bool:
        """Allow writes; the mirror goes to the safe shape first. Returns whether it got there within `timeout_s`.

        No unit can be read back. The way begins at what was written last, by this object or as told by `last`: that
        shape is written again, then the ramp follows. When nothing is known, there is nothing to ramp from and the safe
        shape is written in one step. Without a link this happens as soon as the link stands.
        """
        known = self._known_shape()
        move: Move | None = None
        with self._change:
            self._enabled = self._accepting = self._rewrite_due = True
            self._shape = self._requested = self._safe_shape if known is None else known
            self._sequence = self._degausses = self._turns = 0
            self._turned_at = None
            self._history_known = False
            if known is not None and largest_change(known, self._safe_shape) > 0.0:
                move = Move(Kind.SAFE, [self._safe_shape], self._safe_shape)
                self._put(move)
            self._change.notify_all()
            written = self._change.wait_for(lambda: not self._rewrite_due, timeout_s)
        if move is None or not written:
            return written
        assert known is not None
        # A command that came meanwhile is as good: the way to it is a ramp too.
        return move.wait(timeout_s + self._limiter.ramp_time(known, self._safe_shape)) in _UNDER_CONTROL

    def _known_shape(self) -> Shape | None:
        """Where the outputs stand, as far as anybody can know; None = unknown."""
        with self._change:
            if self._written is not None:
                return self._shape
        shape = self._last.load()
        if shape is None:
            return None
        try:
            return self._limiter.check_shape(shape)
        except Refusal:  # the limits have changed: no legal way begins there
            return None

    def disable(self, timeout_s: float) -> Outcome:
        """Ramp to the safe shape, then forbid writes. Commands are refused from the call on."""
        with self._change:
            self._accepting = False
            if not self._enabled:
                return Outcome.REACHED
            move = Move(Kind.SAFE, [self._safe_shape], self._safe_shape)
            if self._link_up:
                self._put(move)
            else:
                move.finish(Outcome.LINK_LOST)
        outcome = move.wait(timeout_s)
        with self._change:
            self._enabled = self._rewrite_due = False
            self._end_moves(Outcome.STOPPED)
            self._watchdog.disarm()
            self._change.notify_all()
        return outcome or Outcome.STOPPED

    def stop(self, timeout_s: float = 10.0) -> bool:
        """Close the electronics and end the thread; outputs keep their values. Call `disable` first.

        Returns False when the thread hangs in the operating system longer than `timeout_s`.
        """
        with self._change:
            self._stopping = True
            self._accepting = False
            self._change.notify_all()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def command(self, shape: Shape) -> Move:
        """Go to `shape`, which `SafetyLimiter.check_shape` has passed; a move under way is left for it.

        Raises:
            Refusal: DRIVER_INACTIVE or ELECTRONICS_UNREACHABLE.
        """
        return self._submit(Move(Kind.COMMAND, [shape], shape))

    def correct(self, shape: Shape, turns: int) -> Move | None:
        """As `command`, but only while the mirror rests after so many `turns`.

        Returns None, and does nothing, when something else was asked for since: a correction must not undo it.
        """
        with self._change:
            if self._mailbox is not None or self._current is not None or self._turns != turns:
                self.counters.overtaken += 1
                return None
            return self.command(shape)

    def degauss(self, amplitude: float, steps: int, end: Shape) -> Move:
        """Run the decaying cycle about mid range, then go to `end` (checked, as for `command`).

        Args:
            amplitude: first half-swing; 0 = the largest inside the limits.
            steps: half-swings.

        Raises:
            Refusal: OUT_OF_RANGE, DRIVER_INACTIVE or ELECTRONICS_UNREACHABLE.
        """
        limits = self._limiter.limits
        middle = 0.5 * (limits.signal_min + limits.signal_max)
        largest = 0.5 * (limits.signal_max - limits.signal_min)
        if not 0.0 <= amplitude <= largest:
            raise Refusal(ErrorCode.OUT_OF_RANGE, f"amplitude = {amplitude:g}: must be 0 to {largest:g}")
        if steps < 1:
            raise Refusal(ErrorCode.OUT_OF_RANGE, f"steps = {steps}: must be at least 1")
        waypoints = degauss_waypoints(limits.actuators, middle, amplitude or largest, steps, end)
        # A smaller cycle leaves what wider swings have written.
        wipes = (amplitude or largest) >= FULL_CYCLE * largest
        return self._submit(Move(Kind.DEGAUSS, waypoints, end, wipes))

    def ramp_time(self, target: Shape) -> float:
        """Seconds that the slew limit needs from the present shape to `target`; 0 before the first write."""
        with self._change:
            shape = self._shape if self._written is not None else None
        return self._limiter.ramp_time(shape, target) if shape is not None else 0.0

    def state(self) -> WriterState:
        """The present state."""
        with self._change:
            return self._state()

    # Guarded by the condition

    def _submit(self, move: Move) -> Move:
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

    def _put(self, move: Move) -> None:
        if self._mailbox is not None:
            self._mailbox.finish(Outcome.SUPERSEDED)
        self._mailbox = move
        self._requested = move.target
        self._change.notify_all()

    def _begin(self, move: Move) -> None:
        assert self._shape is not None
        if self._current is not None:
            self._current.finish(Outcome.SUPERSEDED)
            if self._under_way:
                self._turn()
        self._current = move
        self._requested = move.target
        self._steps = self._limiter.path(self._shape, move.waypoints)
        self._next_shape = next(self._steps)
        self._under_way = False
        if move.kind is Kind.DEGAUSS:
            self._history_known = False

    def _turn(self) -> None:
        """The way bends where the mirror now stands: hysteresis depends on these places only."""
        self._turns += 1
        self._turned_at = self._written[0] if self._written is not None else None

    def _end_moves(self, outcome: Outcome) -> None:
        for move in (self._mailbox, self._current):
            if move is not None:
                move.finish(outcome)
        self._mailbox = self._current = None
        if self._shape is not None:
            self._requested = self._shape

    def _state(self) -> WriterState:
        applied, volts, stamp_ns = self._written if self._written is not None else (None, None, 0)
        move = self._mailbox or self._current
        return WriterState(
            link_up=self._link_up,
            enabled=self._enabled,
            moving=move.kind if move is not None else None,
            requested=self._requested if self._written is not None else None,
            applied=applied,
            volts=volts,
            stamp_ns=stamp_ns,
            sequence=self._sequence,
            history_known=self._history_known,
            degausses=self._degausses,
            turns=self._turns,
            turned_at=self._turned_at,
            fault=self._fault,
        )

    def _next_action(self) -> Callable[[], None] | None:
        """Wait for something to do; None = stop."""
        with self._change:
            while not self._stopping:
                now = time.monotonic()
                if not self._link_up:
                    due, action = self._retry_at, self._connect
                elif self._rewrite_due:
                    return self._rewrite
                else:
                    busy = self._current is not None and self._current.kind is not Kind.COMMAND
                    if self._mailbox is not None:
                        self._begin(self._mailbox)
                        self._mailbox = None
                    elif self._watchdog.expired(now) and not busy:
                        self._begin(Move(Kind.SAFE, [self._safe_shape], self._safe_shape))
                    due, action = (
                        (self._write_at, self._step) if self._current is not None else (self._check_at, self._check)
                    )
                if now >= due:
                    return action
                watchdog = self._watchdog.deadline if self._watchdog.deadline > now else due
                self._change.wait(min(due, watchdog) - now)
        return None

    # The writer's thread

    def _run(self) -> None:
        try:
            while (action := self._next_action()) is not None:
                try:
                    action()
                except ElectronicsError as error:
                    self._lose_link(str(error))
                except Exception as error:  # a defect must not end the thread that holds the mirror
                    logging.getLogger(__name__).exception("the actuator writer failed; it will reconnect")
                    self._lose_link(f"internal error: {type(error).__name__}: {error}")
        finally:
            self._electronics.close()
            self._last.close()
            with self._change:
                self._end_moves(Outcome.STOPPED)
                self._link_up = False
                self._fault = "closed"
                self._change.notify_all()

    def _connect(self) -> None:
        self._retry_at = time.monotonic() + RECONNECT_PERIOD_S
        self._electronics.open()
        if self._rewrite_due:
            self._rewrite()
        time.sleep(CONFIRM_S)
        self._electronics.check()
        with self._change:
            self._link_up = True
            self.counters.reconnects += self._was_up
            self._was_up = True
            self._fault = ""
            self._check_at = time.monotonic() + CHECK_PERIOD_S
            self._change.notify_all()
        self._tell(True)

    def _rewrite(self) -> None:
        """Write the last shape (after `enable` the safe one) in one step; what stands at the outputs is unknown."""
        with self._change:
            shape = self._shape
        assert shape is not None
        self._write(None, shape)
        if self._link_up:
            self._tell(True)

    def _step(self) -> None:
        with self._change:
            move, shape, previous = self._current, self._next_shape, self._shape
        assert move is not None and shape is not None and previous is not None
        limits = self._limiter.limits
        if self._under_way and time.monotonic() - self._write_at > limits.step / limits.slew_rate:
            self.counters.overruns += 1
        first = not self._under_way
        self._write(previous, shape)
        with self._change:
            self._under_way = True
            self._next_shape = next(self._steps, None)
            ended = self._next_shape is None
            if ended:
                self._current = None
                self._turn()
                if move.kind is Kind.DEGAUSS:
                    self._history_known = move.wipes
                    self._degausses += move.wipes
                    self._watchdog.feed(time.monotonic())
                elif move.kind is Kind.SAFE and self._mailbox is None:
                    self._watchdog.disarm()
        self._tell(first or ended)
        if ended:
            move.finish(Outcome.REACHED)

    def _write(self, previous: Shape | None, shape: Shape) -> None:
        self._limiter.check_write(previous, shape)
        self._note(shape)
        codes = self._output.codes(shape)
        self._electronics.write(codes, self._output.wired)
        stamp_ns = self._stamp_ns()
        now = time.monotonic()
        applied, volts = self._output.outcome(codes)
        with self._change:
            self._shape = shape
            self._written = (applied, volts, stamp_ns)
            self._sequence += 1
            self._rewrite_due = False
            self._write_at = now + (self._limiter.pause_after(previous, shape) if previous is not None else 0.0)
            self._check_at = now + CHECK_PERIOD_S
            self._change.notify_all()
        self.counters.frames += 1

    def _note(self, shape: Shape) -> None:
        try:
            self._last.note(shape)
            self._noting = True
        except OSError as error:  # a full disk must not stop the mirror
            if self._noting:
                logging.getLogger(__name__).warning("the last shape cannot be recorded: %s", error)
            self._noting = False

    def _check(self) -> None:
        self._check_at = time.monotonic() + CHECK_PERIOD_S
        self._electronics.check()

    def _lose_link(self, why: str) -> None:
        self._electronics.close()
        with self._change:
            lost = self._link_up
            changed = lost or why != self._fault
            self._link_up = False
            self._fault = why
            self._history_known = False
            self._rewrite_due = self._enabled
            self._end_moves(Outcome.LINK_LOST)
            if lost:
                self.counters.link_losses += 1
                self._retry_at = time.monotonic() + RECONNECT_PERIOD_S
            self._change.notify_all()
        if changed:
            self._tell(True)

    def _tell(self, edge: bool) -> None:
        try:
            self._listener(self.state(), edge)
        except Exception:
            logging.getLogger(__name__).exception("the listener of the actuator writer raised")
