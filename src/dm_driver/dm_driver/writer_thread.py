"""The one thread that owns the drive electronics.

It writes one step of the current move after the other, paced so that the slew rate holds, and abandons a move at once
for a newer one. After a lost link it tries to reconnect once a second, then writes the last shape again and continues a
move to the safe shape. If another driver had the unit meanwhile, it begins where that one ended.
"""

import logging
import threading
import time
from collections.abc import Callable

from dm_common import Floats
from dm_driver.electronics.base import DriveElectronics, ElectronicsError
from dm_driver.last_shape import LastShape
from dm_driver.move_queue import MoveQueue
from dm_driver.moves import Counters, Kind, Move, Outcome, WriterState
from dm_driver.output.wiring import OutputStage
from dm_driver.safety_limiter import SafetyLimiter, Shape, Watchdog

RECONNECT_PERIOD_S = 1.0
CHECK_PERIOD_S = 0.25
#: A link counts as up if it still is this long after it opened, s: a busy EDAC40 accepts a second TCP client only to
#: close it, and a datagram's "port unreachable" takes a moment to return.
CONFIRM_S = 0.05


class WriterThread:
    """Keeps the link and writes what the queue holds; `dm_driver.actuator_writer` puts moves there.

    Args:
        electronics: the unit; opened, used and closed by this object's thread only.
        output: how a shape becomes codes.
        limiter: judges every write.
        safe_shape: (N,) legal signals: written first when enabled, and ramped to by `disable` and the watchdog.
        listener: called in the writer's thread with the new state after every change; the flag is False for a
            write in the middle of a move, True for everything else. Must return soon.
        watchdog_s: without a command for this long the mirror goes to `safe_shape`; 0 = never.
        stamp_ns: the clock that `WriterState.stamp_ns` is taken from.
        last: record of what an earlier driver of this unit sent last; this one notes there what it sends.
    """

    def __init__(
        self,
        electronics: DriveElectronics,
        output: OutputStage,
        limiter: SafetyLimiter,
        safe_shape: Shape,
        listener: Callable[[WriterState, bool], None] = lambda state, edge: None,
        watchdog_s: float = 0.0,
        stamp_ns: Callable[[], int] = time.time_ns,
        last: LastShape | None = None,
    ) -> None:
        self.counters = Counters()
        self._limiter = limiter
        self._safe_shape = limiter.check_shape(safe_shape, "safe_signals")
        self._listener = listener
        self._watchdog = Watchdog(watchdog_s)
        self._electronics = electronics
        self._output = output
        self._stamp_ns = stamp_ns
        self._last = last if last is not None else LastShape(None, limiter.limits.actuators)
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
        self._queue = MoveQueue(limiter)
        self._shape: Shape | None = None  # before quantisation; ramps start here, so that rounding cannot add up
        self._applied: Shape | None = None  # what a write has left at the actuators; None before the first
        self._volts: Floats | None = None
        self._written_ns = 0
        self._sequence = self._turns_published = 0
        self._write_at = self._check_at = self._retry_at = 0.0

    def start(self) -> None:
        """Begin: open the electronics and keep the link. Nothing is written before `enable`."""
        self._thread.start()

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

    def state(self) -> WriterState:
        """The present state."""
        with self._change:
            queue = self._queue
            return WriterState(
                link_up=self._link_up,
                enabled=self._enabled,
                moving=queue.newest.kind if self._link_up and queue.newest is not None else None,
                requested=queue.requested if self._applied is not None else None,
                applied=self._applied,
                volts=self._volts,
                stamp_ns=self._written_ns,
                sequence=self._sequence,
                history_known=queue.history_known,
                degausses=queue.degausses,
                turns=queue.turns,
                turned_at=queue.turned_at,
                fault=self._fault,
            )

    # Guarded by the condition

    def _put(self, move: Move) -> None:
        self._queue.put(move)
        self._change.notify_all()

    def _begin(self, move: Move) -> None:
        assert self._shape is not None
        self._queue.begin(move, self._shape, self._applied)

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
                    queue = self._queue
                    busy = queue.current is not None and queue.current.kind is not Kind.COMMAND
                    if queue.pending is not None:
                        self._begin(queue.pending)
                        queue.pending = None
                    elif self._watchdog.expired(now) and not busy:
                        self._begin(Move(Kind.SAFE, self._safe_shape))
                    due, action = self._check_at, self._check
                    if queue.current is not None and self._write_at <= due:
                        due, action = self._write_at, self._step
                if now >= due:
                    return action
                watchdog = self._watchdog.deadline if self._watchdog.deadline > now else due
                self._change.wait(min(due, watchdog) - now)
        return None

    # In the thread

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
                self._queue.end_all(Outcome.STOPPED, self._shape)
                self._link_up = False
                self._fault = "closed"
                self._change.notify_all()

    def _connect(self) -> None:
        self._retry_at = time.monotonic() + RECONNECT_PERIOD_S
        self._last.claim()
        self._electronics.open()
        if self._rewrite_due:
            self._confirm()  # before anything is recorded as sent: a busy unit takes nothing from here
            with self._change:
                if due := self._rewrite_due and not self._stopping:  # it may have been disabled meanwhile
                    own, self._shape = self._shape, self._last.known(self._shape, self._output.scale, self._limiter)
                    if self._shape is not own and self._queue.newest is None:
                        self._put(Move(Kind.SAFE, self._safe_shape))
            if due:
                self._rewrite()
        self._confirm()
        with self._change:
            self._link_up = True
            self.counters.reconnects += self._was_up
            self._was_up = True
            self._fault = ""
            self._check_at = time.monotonic() + CHECK_PERIOD_S
            self._change.notify_all()
        self._publish(True)

    def _confirm(self) -> None:
        time.sleep(CONFIRM_S)
        self._electronics.check()

    def _rewrite(self) -> None:
        """Write the last shape (after `enable` the safe one) in one step, as the shape at the outputs is unknown."""
        with self._change:
            shape = self._shape
        assert shape is not None
        self._write(None, shape)
        if self._link_up:
            self._publish(True)

    def _step(self) -> None:
        queue = self._queue
        limits = self._limiter.limits
        with self._change:
            move, shape, previous = queue.current, queue.next_shape, self._shape
        assert move is not None and shape is not None and previous is not None
        first = not queue.under_way
        if not first and time.monotonic() - self._write_at > limits.step / limits.slew_rate:
            self.counters.overruns += 1
        if queue.turns != self._turns_published:
            self._publish(True)  # this move began at a turn, and another may follow if it is a single step
        self._write(previous, shape)
        with self._change:
            ended = queue.step_written(move, self._applied)
            if ended and move.kind is Kind.DEGAUSS:
                self._watchdog.feed(time.monotonic())
            elif ended and move.kind is Kind.SAFE and queue.pending is None:
                self._watchdog.disarm()
        self._publish(first or ended)
        if ended:
            move.finish(Outcome.REACHED)

    def _write(self, previous: Shape | None, shape: Shape) -> None:
        """Write `shape` (N,) over `previous`; None = the outputs are unknown, so that no step can be judged.

        Raises:
            Refusal: not a legal shape or step; nothing was sent.
            ElectronicsError: the unit did not take it.
        """
        self._limiter.check_write(previous, shape)
        self._record(shape)
        codes = self._output.codes(shape)
        self._electronics.write(codes, self._output.wired)
        written_ns, now = self._stamp_ns(), self._electronics.sent_at
        with self._change:
            self._shape = shape
            self._applied, self._volts = self._output.outcome(codes)
            self._written_ns = written_ns
            self._sequence += 1
            self._rewrite_due = False
            pause = self._limiter.pause_after(previous, shape) if previous is not None else 0.0
            self._write_at = now + pause
            self._change.notify_all()
        self.counters.frames += 1

    @property
    def unrecorded(self) -> str:
        """Why a driver that follows a killed one would not know what was sent last; "" = it would, or need not."""
        return self._last.trouble

    def _record(self, shape: Shape) -> None:
        try:
            self._last.note(self._output.scale.exact_codes(shape))
        except OSError as error:  # a full disk must not stop the mirror
            if not self._last.trouble:
                logging.getLogger(__name__).warning("the last shape cannot be recorded: %s", error)
            self._last.trouble = f"the last shape cannot be recorded: {error}"

    def _check(self) -> None:
        self._check_at = time.monotonic() + CHECK_PERIOD_S
        self._electronics.check()

    def _lose_link(self, reason: str) -> None:
        self._electronics.close()
        with self._change:
            lost = self._link_up
            changed = lost or reason != self._fault
            self._link_up = False
            self._fault = reason
            self._queue.history_known = False
            self._rewrite_due = self._enabled
            # A lost link ends all moves except one to the safe shape, which continues later; the move of `disable` ends
            # too, since its caller waits.
            newest = self._queue.newest
            to_safe = self._accepting and newest is not None and newest.kind is Kind.SAFE
            self._queue.end_all(Outcome.LINK_LOST, self._shape, newest if to_safe else None)
            if lost:
                self.counters.link_losses += 1
                self._retry_at = time.monotonic() + RECONNECT_PERIOD_S
            self._change.notify_all()
        if changed:
            self._publish(True)

    def _publish(self, edge: bool) -> None:
        state = self.state()
        self._turns_published = state.turns
        try:
            self._listener(state, edge)
        except Exception:
            logging.getLogger(__name__).exception("the listener of the actuator writer raised")
