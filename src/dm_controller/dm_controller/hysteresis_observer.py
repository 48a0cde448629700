"""Where the mirror stands and what its actuators remember, from the driver's reports alone.

Planning never changes it: what the driver reports as applied does. So a command that was refused, lost, cut short or
sent by somebody else leaves no wrong memory behind.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

import numpy as np
from dm_msgs.msg import ActuatorState

from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.hysteresis.tracker import Applied, HysteresisTracker
from dm_common.messages import stamp_ns
from dm_controller.planning.planner import Planner

#: Reports kept for a law that is identified later: a calibration run makes some hundred.
LOG_LENGTH = 5_000
CURE = "a degauss over the full range (service degauss) makes it known"


@dataclass(frozen=True, eq=False)
class Look:
    """The mirror at one moment.

    Attributes:
        state: None before the first report.
        unknown: why the state is a guess only, in words; "" = it is known.
    """

    state: HysteresisState | None
    unknown: str

    @property
    def known(self) -> bool:
        return not self.unknown


class HysteresisObserver:
    """Feeds a :class:`HysteresisTracker`. May be asked from any thread.

    Attributes:
        law: that is followed; without an identified memory the linear one.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.law = HysteresisModel.linear()
        self._middle = 0.0
        self._tracker = HysteresisTracker(self.law)
        self._last: ActuatorState | None = None
        self._log: deque[Applied] = deque(maxlen=LOG_LENGTH)

    def use(self, law: HysteresisModel, middle: float) -> None:
        """Follow another law, through all that was reported since this node started."""
        with self._lock:
            same = same_model(law, self.law) and middle == self._middle
            self.law, self._middle = law, middle
            if same:
                return
            self._tracker = HysteresisTracker(law, middle)
            for report in list(self._log):
                self._track(report)

    def observe(self, message: ActuatorState) -> None:
        """Take the driver's next report."""
        with self._lock:
            self._last = message
            self._observe(message)

    @property
    def degausses(self) -> int:
        """Full-range degausses that the driver counts, as far as followed."""
        last = self._last
        return int(last.degausses) if last is not None else 0

    @property
    def unknown(self) -> str:
        """Why the history is not known, in words; "" = it is."""
        with self._lock:
            return self._unknown()

    def look(self, now: float, slew_rate: float = np.inf) -> Look:
        """The mirror at `now` (s, ROS time).

        A move under way is followed to where it should be by now: a new command makes it turn about there.
        """
        with self._lock:
            state, unknown, last = self._tracker.state, self._unknown(), self._last
        if last is None or state is None:
            return Look(None, unknown)
        if last.moving and not unknown and len(last.requested) == len(state.signals):
            gap = np.array(last.requested, dtype=np.float64) - state.signals
            largest = float(np.abs(gap).max())
            share = min(1.0, max(0.0, now - state.time) * slew_rate / largest) if largest > 0.0 else 0.0
            state = self.law.move(state, state.signals + share * gap, now)
        return Look(state, unknown)

    def prepare(self, loop: Planner | None) -> None:
        """Have the next plan of `loop` from where the mirror now stands prepared; nothing while it moves."""
        last, state = self._last, self._tracker.state
        if loop is not None and state is not None and last is not None and not last.moving and loop.law is self.law:
            loop.prepare(state)

    def _unknown(self) -> str:
        if self._tracker.state is None or self._last is None:
            return self._tracker.unknown
        if not self._last.history_known:
            return self._tracker.unknown or "writes were lost, or a degauss is under way"
        return self._tracker.unknown if self.law.remembers else ""

    def _observe(self, message: ActuatorState) -> None:
        if not message.applied:
            return
        turned_at = np.array(message.turned_at, dtype=np.float64)
        report = Applied(
            time=1e-9 * stamp_ns(message.header.stamp),
            signals=np.array(message.applied, dtype=np.float64),
            turns=message.turns,
            turned_at=turned_at if turned_at.shape == (len(message.applied),) else None,
            degausses=message.degausses,
            history_known=message.history_known,
            moving=message.moving,
        )
        self._keep(report)
        self._track(report)

    def _keep(self, report: Applied) -> None:
        """Keep what a later law must know: where the way bent, and how a move under way began."""
        log = self._log
        if len(log) >= 2 and _between(log[-2], log[-1], report):
            log.pop()
        log.append(report)

    def _track(self, report: Applied) -> None:
        try:
            self._tracker.observe(report)
        except ValueError as error:
            # Another mirror behind the same name, or numbers that are none: begin anew with the next report.
            self._log.clear()
            self._tracker = HysteresisTracker(self.law, self._middle)
            self._tracker.unknown = f"actuator_state: {error}"


def same_model(one: HysteresisModel, other: HysteresisModel) -> bool:
    """Whether two laws are the same, number for number."""
    names = ("play_radius", "play_weight", "duhem_slope", "duhem_weight", "creep_rate", "creep_time", "creep_spectrum")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


def _between(before: Applied, between: Applied, after: Applied) -> bool:
    """Whether a law needs no report of `between`: the same move, or the same rest, goes on."""
    same = (before.turns, before.degausses, before.history_known, before.moving) == (
        between.turns, between.degausses, between.history_known, between.moving
    ) == (after.turns, after.degausses, after.history_known, after.moving)  # fmt: skip
    return same and before.time <= between.time <= after.time and (between.moving or between.time == after.time)


def after_degauss(law: HysteresisModel, look: Look, actuators: int, time: float, middle: float) -> Look:
    """The mirror after a degauss that ends at `time` (s)."""
    if look.state is None:
        return Look(law.demagnetised(actuators, time, middle), "")
    return Look(law.degaussed(look.state, time, middle), "")
