"""Follows the hysteresis state of the actuators through the signals that the driver reports as applied.

Only reports change the state; planning never does. So commands that were refused, lost, cut short or sent by another
client cannot make it wrong.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dm_common.hysteresis.creep_record import CreepRecord, held_unseen, rested
from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.mirror import Applied, counts_anew

#: Reports kept for a law that is identified later (a calibration run makes some hundred), estimates for late maps.
LOG_LENGTH, ESTIMATES_KEPT = 5_000, 500
#: While the mirror moves, two reports are closer than this, s: no shape is held for long between them.
REPORTS_APART_S = 0.5


class HysteresisTracker:
    """The hysteresis state of one mirror under one law, from reports in the order sent.

    Moves are straight between turning points, and hysteresis depends on these only: reports may be lost as long as at
    most one turn happens between two that arrive. A degauss over the full range begins a new history.

    Attributes:
        law: the law that is followed.
        state: the best guess; None before the first report.
        unknown: the reason why the state is a guess only; "" = it is known.
        last: the last report; a later one that merely repeats it may replace it.
    """

    def __init__(self, law: HysteresisModel, middle: float = 0.0, record: CreepRecord | None = None) -> None:
        self.law, self._middle, self._record = law, middle, record
        self.state: HysteresisState | None = None
        self.unknown = "the driver has not reported yet"
        self.last: Applied | None = None
        self._set_off: HysteresisState | None = None  # the state when the move under way began
        self._seen = -np.inf  # s, time up to which the outputs are known

    def observe(self, report: Applied) -> None:
        """Take the next report.

        Raises:
            ValueError: another number of actuators than before, or signals that are not finite.
        """
        if not np.isfinite(report.signals).all():
            raise ValueError("applied: holds values that are not finite")
        last, self.last = self.last, report
        if self.state is not None and len(report.signals) != len(self.state.signals):
            raise ValueError(f"applied: {len(report.signals)} signals, before there were {len(self.state.signals)}")
        if last is None or self.state is None:
            record, time = self._record, report.time
            if record is not None and time < record.time <= report.heard:
                time = record.time  # the record is of this same shape, which was written before and is still held
            self.state = rested(self.law, report.signals, time, self._middle, record)
            self.unknown = "the mirror moved before this node followed it"
            return
        if last.linked:
            self._seen = max(last.heard, self.state.time)
        if last.time < self.law.crept_at <= report.time and self.law.crept.shape == report.signals.shape:
            # The figure of a calibration is relative to the creep that it found: that replaces the creep followed here.
            state = self.law.advance(self.state, self.law.crept_at)
            crept = np.repeat(self.law.crept[:, None], len(self.law.creep_time), axis=1)
            self.state, self._set_off = replace(state, crept=crept, crept_sigma=0.0 * state.crept_sigma), None
        if report.time < last.time or max(report.time, report.heard) < self.state.time:
            # Hysteresis does not depend on time; creep pauses until the clock has caught up.
            self.state = replace(self.state, time=max(report.time, report.heard))
        if counts_anew(report, last):
            # Best guess: since the driver was last heard, the mirror has stood at the signals that it reports now.
            self.state = self.law.move(self.state, report.signals, min(self._seen, report.time))
            self.unknown = "the driver was started or activated again"
            self._follow(report, last, self._seen)
            return
        turns = report.turns - last.turns
        # Of a shape that was left again before it was reported, nobody knows how long it was held.
        at = report.signals if report.turned_at is None else report.turned_at
        left = turns > 1 or (turns == 1 and not any(np.array_equal(at, seen.signals) for seen in (report, last)))
        left &= report.time - self._seen > REPORTS_APART_S
        # Without a link it is not known whether the outputs held: the unit may have lost power.
        since = self._seen if left or (report.linked and not last.linked) else report.time
        if report.degausses > last.degausses:
            self._degaussed(report, last, since)
            return
        # A move begins with its first write, whose stamp gives the time; until then the earlier shape is held.
        unwritten = self._set_off is not None and np.array_equal(last.signals, self._set_off.signals)
        if report.moving and (not last.moving or turns or unwritten):
            self._set_off = self.law.advance(self.state, report.time)
        if not report.history_known:
            self.unknown = self.unknown or "writes were lost, or a degauss was interrupted, too short or too small"
        elif turns > 1:
            self.unknown = self.unknown or (f"{turns - 1} turns were not seen" if turns > 2 else "a turn was not seen")
        self._follow(report, last, since)

    def _follow(self, report: Applied, last: Applied, since: float) -> None:
        """Move to the signals reported, by the last turn; shapes held since `since` (s) are not known."""
        assert self.state is not None
        if report.turns > last.turns and report.turned_at is not None:
            self.state = self.law.move(self.state, report.turned_at, report.time)
        state = self.law.move(self.state, report.signals, report.time)
        self.state = replace(state, crept_sigma=held_unseen(self.law, state.crept_sigma, report.time - since))

    def _degaussed(self, report: Applied, last: Applied, since: float) -> None:
        """Begin a new history; moves since the degauss are known if there was no turn after it."""
        assert self.state is not None
        # During the swings about the middle, creep follows the middle; if none was seen, from the last report onwards.
        unseen = self.law.advance(self.state, min(self._seen, report.time))
        began, self._set_off = (self._set_off if last.moving else None) or unseen, None
        state = self.law.advance(self.law.degaussed(began, began.time, self._middle), report.time)
        # The clock may have jumped since it began.
        doubt = self.law.advance(self.state, report.time).crept_sigma
        self.state = replace(state, crept_sigma=np.maximum(state.crept_sigma, doubt))
        seen = report.turns - last.turns <= 1 and report.degausses == last.degausses + 1
        self.unknown = "" if seen and report.history_known else "moves after the degauss were not seen"
        self._follow(report, last, since)


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

    def after_degauss(
        self, law: HysteresisModel, actuators: int, begun: float, time: float, middle: float
    ) -> ActuatorEstimate:
        """After a degauss from `begun` to `time` (s), while creep follows the middle; needs no earlier state."""
        state = self.state or rested(law, np.full(actuators, middle), begun, middle)
        return ActuatorEstimate(law.advance(law.degaussed(state, begun, middle), time), "")


class Observed(NamedTuple):
    """A report and the estimate that follows from it."""

    report: Applied
    estimate: ActuatorEstimate


class HysteresisObserver:
    """Follows one mirror under the law in use. Thread-safe, except while `use` exchanges the law.

    Attributes:
        law: the law that is followed; the linear one where no hysteresis was identified.
        latest: the driver's last report; None before the first.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self.law = HysteresisModel.linear()
        self.latest: Applied | None = None
        self._middle, self._identified = 0.0, True
        self._record: CreepRecord | None = None
        self._doubtful: deque[tuple[float, float]] = deque(maxlen=LOG_LENGTH)  # time of the end, and duration, s
        self._tracker = HysteresisTracker(self.law)
        self._log: deque[Applied] = deque(maxlen=LOG_LENGTH)
        self._observed: deque[Observed] = deque(maxlen=ESTIMATES_KEPT)

    def use(self, law: HysteresisModel, middle: float, identified: bool = True) -> None:
        """Follow `law` through all reports so far; degausses end at `middle`. Not `identified`: a placeholder."""
        with self._lock:
            self._identified = identified
            same = law.same_as(self.law) and middle == self._middle
            self.law, self._middle = law, middle
            if not same:
                self.recall(self._record)

    def recall(self, record: CreepRecord | None, another: bool = False) -> None:
        """Follow all reports again, from the creep of `record`; for `another` mirror, forget the reports instead."""
        with self._lock:
            self._record = record
            if another:
                self._log.clear()
                self._doubtful.clear()
            self._tracker = HysteresisTracker(self.law, self._middle, record)
            self._observed.clear()
            for report in list(self._log):
                self._track(report)
            for doubt in self._doubtful:
                self._widen(*doubt)

    def _widen(self, until: float, elapsed: float) -> None:
        state, law = self._tracker.state, self.law
        if state is None or not until > law.crept_at:  # creep that a calibration found later is known
            return
        state = law.advance(state, max(state.time, until))
        sigma = held_unseen(law, np.zeros(len(law.creep_time)), elapsed) * np.exp((until - state.time) / law.creep_time)
        self._tracker.state = replace(state, crept_sigma=np.hypot(state.crept_sigma, sigma))

    def observe(self, report: Applied, doubtful: float = 0.0) -> None:
        """Take the driver's next report; one without signals (the driver knows none yet) only becomes the latest.

        Args:
            doubtful: s before it that the clock may have skipped; the shape counts as unobserved for that long.

        Raises:
            ValueError: another number of actuators, or values that are not finite; the observer begins anew.
        """
        with self._lock:
            self.latest = report
            if report.signals.size:
                self._take(report)
            elif self._log:  # another driver, or another activation: its counts begin anew
                held = self._log[-1]
                time = max(held.time, held.heard)
                self._take(replace(report, signals=held.signals, time=time, heard=held.heard, linked=False))
            if doubtful:
                self._doubtful.append((max(report.heard, report.time), doubtful))
                self._widen(*self._doubtful[-1])

    def _take(self, report: Applied) -> None:
        if self._log and _same(self._log[-1], report):
            self._log[-1] = self._tracker.last = report
            return
        # A law that is identified later needs the turning points, and the beginning of a move under way.
        if len(self._log) >= 2 and _between(self._log[-2], self._log[-1], report):
            self._log.pop()
        self._log.append(report)
        try:
            self._track(report)
        except ValueError as error:
            self.recall(self._record, another=True)
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
        lost = "" if latest.history_known else tracker.unknown or "writes were lost, or a degauss is under way"
        if not self.law.has_history:
            return "" if self._identified else lost
        return tracker.unknown or lost

    def estimate(self, now: float, slew_rate: float = np.inf) -> ActuatorEstimate:
        """The actuators at `now` (s, of the clock that reports are stamped with).

        A move under way is extrapolated to where it should be by now: a new command makes it turn about there.
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

    def recent(self) -> list[Observed]:
        """The latest reports in the order received, each with the estimate that follows from it."""
        with self._lock:
            return list(self._observed)


def _between(before: Applied, between: Applied, after: Applied) -> bool:
    """Whether a law needs no report of `between`, because it lies within one move or one rest."""
    anew = counts_anew(between, before) or counts_anew(after, between)
    one = not anew and _phase(before) == _phase(between) == _phase(after)
    return one and before.time <= between.time <= after.time and (between.moving or between.time == after.time)


def _same(last: Applied, report: Applied) -> bool:
    """Whether a report repeats the last one, as those of a mirror at rest do."""
    return _phase(last) == _phase(report) and last.time == report.time and np.array_equal(last.signals, report.signals)


def _phase(report: Applied) -> tuple[int, int, bool, bool, bool, bool]:
    return report.turns, report.degausses, report.history_known, report.moving, report.active, report.linked
