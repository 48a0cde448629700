"""The move under way, the newest one behind it, and what the mirror's hysteresis remembers of their ends."""

from collections.abc import Iterator

from dm_driver.moves import Kind, Move, Outcome
from dm_driver.safety_limiter import SafetyLimiter, Shape


class MoveQueue:
    """Which shape comes next. It has no lock of its own: the writer's guards it.

    Attributes:
        pending: the newest move, which waits for the writer; a newer one takes its place.
        current: the move under way.
        next_shape: (N,) the next step of `current`.
        under_way: whether `current` has written a step.
        requested: (N,) where the last accepted move leads.
        history_known: every write since a completed degauss over the full range went through.
        degausses: such degausses since the writer was enabled.
        turns: moves that ended or were left for another since the writer was enabled.
        turned_at: (N,) what was applied where that happened last.
    """

    def __init__(self, limiter: SafetyLimiter) -> None:
        self._limiter = limiter
        self._steps: Iterator[Shape] = iter(())
        self.pending: Move | None = None
        self.current: Move | None = None
        self.next_shape: Shape | None = None
        self.under_way = False
        self.requested: Shape | None = None
        self.forget_history()

    def forget_history(self) -> None:
        """Begin anew: nothing is known of what was written before."""
        self.history_known = False
        self.degausses = self.turns = 0
        self.turned_at: Shape | None = None

    @property
    def newest(self) -> Move | None:
        """The move that decides where the mirror goes; None when it rests."""
        return self.pending or self.current

    def put(self, move: Move) -> None:
        """Let `move` be the next."""
        newest = self.newest
        # The mirror never held the end of a degauss that is left.
        move.before = newest.before if newest is not None and newest.kind is Kind.DEGAUSS else self.requested
        if self.pending is not None:
            self.pending.finish(Outcome.SUPERSEDED)
        self.pending, self.requested = move, move.target

    def begin(self, move: Move, shape: Shape, applied: Shape | None) -> None:
        """Leave the current move for `move`.

        Args:
            move: the next.
            shape: (N,) that was written last, before quantisation.
            applied: (N,) what stands at the actuators; None before the first write.
        """
        if self.current is not None:
            self.current.finish(Outcome.SUPERSEDED)
            if self.under_way:
                self._turn(applied)
        self.current = move
        self.requested = move.target
        self._steps = self._limiter.path(shape, move.way())
        self.next_shape = next(self._steps)
        self.under_way = False
        if move.kind is Kind.DEGAUSS:
            self.history_known = False

    def step_written(self, move: Move, applied: Shape | None) -> bool:
        """Note that a step of `move` was written; returns whether that was its last."""
        self.under_way = True
        self.next_shape = next(self._steps, None)
        if self.next_shape is not None:
            return False
        self.current = None
        self._turn(applied)
        if move.kind is Kind.DEGAUSS:
            self.history_known = move.wipes
            self.degausses += move.wipes
        return True

    def end_all(self, outcome: Outcome, shape: Shape | None, keep: Move | None = None) -> None:
        """End all moves but `keep`, which begins anew, where the mirror stands: `shape` (N,) as it was written last."""
        for move in (self.pending, self.current):
            if move is not None and move is not keep:
                move.finish(outcome)
        self.pending, self.current = keep, None
        if shape is not None:
            self.requested = shape

    def _turn(self, applied: Shape | None) -> None:
        """The way bends where the mirror now stands: hysteresis depends on these places only."""
        self.turns += 1
        self.turned_at = applied
