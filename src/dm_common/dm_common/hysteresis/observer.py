"""Where the actuators stand and what their hysteresis holds, followed through what the driver reports as applied.

Planning never changes it: reports do. So a command that was refused, lost, cut short or sent by somebody else leaves no
wrong state behind.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dm_common.hysteresis.creep_record import CreepRecord
from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.hysteresis.tracker import Applied, HysteresisTracker

Floats = NDArray[np.float64]

#: Reports kept for a law that is identified later: a calibration run makes some hundred.
LOG_LENGTH = 5_000
#: Estimates kept for maps that arrive late.
ESTIMATES_KEPT = 500
#: What to do about an unknown history.
CURE = "a degauss over the full range (service degauss) makes it known"


class ActuatorEstimate(NamedTuple):
    """The actuators at one moment.

    Attributes:
        state: None before the first report.
        unknown: the reason why the state is a guess only; "" = it is known.
    """

    state: HysteresisState | None
    unknown: str

    @property
    def known(self) -> bool:
        """Whether the state can be trusted."""
        return not self.unknown

    def after_degauss(self, law: HysteresisModel, actuators: int, time: float, middle: float) -> ActuatorEstimate:
        """The actuators after a degauss that ends at `time` (s)."""
        if self.state is None:
            return ActuatorEstimate(law.demagnetised(actuators, time, middle), "")
        return ActuatorEstimate(law.degaussed(self.state, time, middle), "")


class Observed(NamedTuple):
    """A report and the estimate that follows from it."""

    report: Applied
    estimate: ActuatorEstimate


class HysteresisObserver:
    """Follows one mirror under the law in use. May be asked from any thread.

    Attributes:
        law: that is followed; without an identified hysteresis the linear one.
        latest: the driver's last report; None before the first.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self.law = HysteresisModel.linear()
        self.latest: Applied | None = None
        self._middle = 0.0
        self._record: CreepRecord | None = None
        self._tracker = HysteresisTracker(self.law)
        self._log: deque[Applied] = deque(maxlen=LOG_LENGTH)
        self._observed: deque[Observed] = deque(maxlen=ESTIMATES_KEPT)

    def use(self, law: HysteresisModel, middle: float) -> None:
        """Follow another law, through all that was reported so far; a degauss ends at `middle`."""
        with self._lock:
            same = law.same_as(self.law) and middle == self._middle
            self.law, self._middle = law, middle
            if same:
                return
            self._follow_anew()

    def recall(self, record: CreepRecord | None) -> None:
        """Take what the actuators had crept to before the first report from `record`."""
        with self._lock:
            self._record = record
            self._follow_anew()

    def _follow_anew(self) -> None:
        self._tracker = HysteresisTracker(self.law, self._middle, self._record)
        self._observed.clear()
        for report in list(self._log):
            self._track(report)

    def record(self, now: float) -> CreepRecord | None:
        """What the actuators have crept to by `now` (s); None without an identified creep, and before a report."""
        with self._lock:
            law, state = self.law, self._tracker.state
        if state is None or not law.creep_rate:
            return None
        state = law.advance(state, now)
        doubt = state.doubt if state.doubt.size else np.zeros(len(law.creep_time))
        return CreepRecord(state.time, law.creep_time, state.crept, doubt)

    def observe(self, report: Applied) -> None:
        """Take the driver's next report. One without signals, of a driver that knows none yet, is kept as the latest.

        Raises:
            ValueError: another number of actuators, or numbers that are none; the observer begins anew.
        """
        with self._lock:
            self.latest = report
            if not report.signals.size:
                return
            if self._log and _same(self._log[-1], report):
                return
            # What a later law must know: where the way bent, and how a move under way began.
            if len(self._log) >= 2 and _between(self._log[-2], self._log[-1], report):
                self._log.pop()
            self._log.append(report)
            try:
                self._track(report)
            except ValueError as error:
                self._log.clear()
                self._observed.clear()
                self._tracker = HysteresisTracker(self.law, self._middle, self._record)
                self._tracker.unknown = f"actuator_state: {error}"
                raise

    def _track(self, report: Applied) -> None:
        self._tracker.observe(report)
        self._observed.append(Observed(report, ActuatorEstimate(self._tracker.state, self._unknown(report))))

    @property
    def unknown(self) -> str:
        """The reason why the history is not known; "" = it is."""
        with self._lock:
            return self._unknown(self.latest)

    @property
    def state(self) -> HysteresisState | None:
        """As of the last report; None before it."""
        return self._tracker.state

    def _unknown(self, latest: Applied | None) -> str:
        tracker = self._tracker
        if tracker.state is None or latest is None:
            return tracker.unknown
        if not self.law.remembers:
            return ""
        lost = "" if latest.history_known else "writes were lost, or a degauss is under way"
        return tracker.unknown or lost

    def estimate(self, now: float, slew_rate: float = np.inf) -> ActuatorEstimate:
        """The actuators at `now` (s, of the clock that reports are stamped with).

        A move under way is followed to where it should be by now: a new command makes it turn about there.
        """
        with self._lock:
            state, unknown, last = self._tracker.state, self._unknown(self.latest), self.latest
        if last is None or state is None:
            return ActuatorEstimate(None, unknown)
        if last.moving and not unknown and last.requested is not None and last.requested.shape == state.signals.shape:
            gap = last.requested - state.signals
            largest = float(np.abs(gap).max())
            share = min(1.0, max(0.0, now - state.time) * slew_rate / largest) if largest > 0.0 else 0.0
            state = self.law.move(state, state.signals + share * gap, now)
        return ActuatorEstimate(state, unknown)

    def at(self, time: float) -> ActuatorEstimate | None:
        """As of the last report at or before `time` (s), if that is recent enough to be kept."""
        return next((seen.estimate for seen in reversed(self.recent()) if seen.report.time <= time), None)

    def recent(self) -> list[Observed]:
        """The latest reports, in the order they came, with what follows from each."""
        with self._lock:
            return list(self._observed)


def _between(before: Applied, between: Applied, after: Applied) -> bool:
    """Whether a law needs no report of `between`: the same move, or the same rest, goes on."""
    if not _phase(before) == _phase(between) == _phase(after):
        return False
    return before.time <= between.time <= after.time and (between.moving or between.time == after.time)


def _same(last: Applied, report: Applied) -> bool:
    """Whether a report repeats the last one, as those of a mirror at rest do."""
    return _phase(last) == _phase(report) and last.time == report.time and np.array_equal(last.signals, report.signals)


def _phase(report: Applied) -> tuple[int, int, bool, bool, bool]:
    return report.turns, report.degausses, report.history_known, report.moving, report.active
