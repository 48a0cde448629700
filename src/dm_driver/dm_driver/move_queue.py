"""The move under way, the newest one waiting behind it, and the turning points that hysteresis depends on."""

from collections.abc import Iterator

from dm_driver.moves import Kind, Move, Outcome
from dm_driver.safety_limiter import SafetyLimiter, Shape


class MoveQueue:
    """Decides which shape comes next. It has no lock of its own: the writer's guards it.

    Attributes:
        pending: the newest move, waiting for the writer; a newer one replaces it.
        current: the move under way.
        next_shape: (N,) the next step of `current`.
        under_way: whether `current` has written a step.
        requested: (N,) target of the last accepted move.
        history_known: every write since a completed degauss over the full range went through.
        degausses: number of such degausses since the writer was enabled.
        turns: number of moves that ended or were abandoned for another since the writer was enabled.
        turned_at: (N,) what was applied at the last of these turns; None before the first.
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
        """Start afresh: nothing is known of what was written before."""
        self.history_known = False
        self.degausses = self.turns = 0
        self.turned_at: Shape | None = None

    @property
    def newest(self) -> Move | None:
        """The move that decides where the mirror goes; None when it rests."""
        return self.pending or self.current

    def put(self, move: Move) -> None:
        """Make `move` the next one."""
        newest = self.newest
        # The mirror never held the end of a degauss that is abandoned.
        move.before = newest.before if newest is not None and newest.kind is Kind.DEGAUSS else self.requested
        if self.pending is not None:
            self.pending.finish(Outcome.SUPERSEDED)
        self.pending, self.requested = move, move.target

    def begin(self, move: Move, shape: Shape, applied: Shape | None) -> None:
        """Abandon the current move for `move`.

        Args:
            shape: (N,) that was written last, before quantisation.
            applied: (N,) what is at the actuators; None before the first write.
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
        """End all moves but `keep`, which begins again from the present place: `shape` (N,), as written last."""
        for move in (self.pending, self.current):
            if move is not None and move is not keep:
                move.finish(outcome)
        self.pending, self.current = keep, None
        if shape is not None:
            self.requested = shape

    def _turn(self, applied: Shape | None) -> None:
        """Note a turning point where the mirror now is: hysteresis depends on these only."""
        self.turns += 1
        self.turned_at = applied
