"""The moves that the actuator writer carries out, and what it reports about itself."""

import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from enum import Enum

from dm_common import Floats
from dm_driver.safety_limiter import Shape


class Kind(Enum):
    """What a move is for."""

    COMMAND = "command"
    DEGAUSS = "degauss"
    SAFE = "safe shape"


class Outcome(Enum):
    """How a move ended."""

    REACHED = "reached"
    SUPERSEDED = "superseded by a newer command"
    LINK_LOST = "abandoned: the link to the electronics was lost"
    STOPPED = "abandoned: the driver stopped"


@dataclass(eq=False)
class Move:
    """A path through legal shapes; its end can be waited for.

    Attributes:
        kind: what it is for.
        target: (N,) where it ends.
        waypoints: shapes to pass, the target last; straight lines between them. None = straight to the target.
        wipes: a degauss over the full range by enough half-swings, which wipes the hysteresis.
        steps, duration: of a degauss: its half-swings, and how long they take, s.
        begun: number of waypoints that the mirror has passed or is heading for.
        before: (N,) target of the last accepted move when this one replaced it; if that was a degauss, the shape that
            it would have turned back to; None before the first.
    """

    kind: Kind
    target: Shape
    waypoints: Iterable[Shape] | None = None
    wipes: bool = False
    steps: int = 0
    duration: float = 0.0
    begun: int = field(default=0, init=False)
    before: Shape | None = field(default=None, init=False)
    _ended: threading.Event = field(default_factory=threading.Event, init=False)
    _outcome: Outcome | None = field(default=None, init=False)

    def way(self) -> Iterator[Shape]:
        """The waypoints, counted as they are begun."""
        for waypoint in (self.target,) if self.waypoints is None else self.waypoints:
            self.begun += 1
            yield waypoint

    def wait(self, timeout_s: float | None = None) -> Outcome | None:
        """Wait for the end; None when it has not come in time."""
        self._ended.wait(timeout_s)
        return self._outcome

    def finish(self, outcome: Outcome) -> None:
        """Mark the end; only the first call counts."""
        if not self._ended.is_set():
            self._outcome = outcome
            self._ended.set()


@dataclass
class Counters:
    """Counts since the writer was made."""

    frames: int = 0
    link_losses: int = 0
    reconnects: int = 0
    overtaken: int = 0  #: corrections that were left out, since something else was asked for meanwhile
    overruns: int = 0  #: writes of a ramp that came more than one step interval late


@dataclass(frozen=True)
class WriterState:
    """One consistent state of the writer; for `requested` and the history see `MoveQueue`, which keeps them.

    Arrays are never changed after they were handed out; `requested` and `applied` are None before the first write.

    Attributes:
        link_up: the electronics are open.
        enabled: writes are allowed.
        moving: kind of the move under way; None when the mirror rests or the link is down.
        applied: (N,) what is at the actuators, after quantisation.
        volts: (N,) V at the actuators for `applied`.
        stamp_ns: when `applied` was written, in the caller's clock.
        sequence: writes since the writer was enabled.
        fault: reason why the link is down; empty when it is up.
    """

    link_up: bool
    enabled: bool
    moving: Kind | None
    requested: Shape | None
    applied: Shape | None
    volts: Floats | None
    stamp_ns: int
    sequence: int
    history_known: bool
    degausses: int
    turns: int
    turned_at: Shape | None
    fault: str
