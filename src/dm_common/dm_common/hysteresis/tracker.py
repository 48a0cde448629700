"""The hysteresis state of one mirror, followed through what the driver reports as applied."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dm_common.hysteresis.creep_record import CreepRecord
from dm_common.hysteresis.model import HysteresisModel, HysteresisState

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Applied:
    """What a driver reports; fields as in dm_msgs/ActuatorState.

    Attributes:
        time: s, stamp of the last write.
        signals: (N,) applied.
        turns, turned_at: how often the way has bent since activation, and (N,) where it did last; None = never.
        degausses: over the full range, since activation.
        history_known: no write was lost since the last of them.
        moving: on the way to another shape.
        requested: (N,) what it moves to; None = not known.
        active: the electronics follow.
    """

    time: float
    signals: Floats
    turns: int
    turned_at: Floats | None
    degausses: int
    history_known: bool
    moving: bool = False
    requested: Floats | None = None
    active: bool = True


class HysteresisTracker:
    """The hysteresis state of one mirror under one law, from reports in the order sent.

    A move is straight between turns, and hysteresis depends on the turns only: reports may be lost as long as no two
    turns happen between two that arrive. A degauss over the full range begins a new history.

    Attributes:
        law: the law that is followed.
        state: the best guess; None before the first report.
        unknown: the reason why the state is a guess only; "" = it is known.
    """

    def __init__(self, law: HysteresisModel, middle: float = 0.0, record: CreepRecord | None = None) -> None:
        self.law, self._record = law, record
        self.state: HysteresisState | None = None
        self.unknown = "the driver has not reported yet"
        self._middle = middle
        self._last: Applied | None = None
        self._set_off: HysteresisState | None = None  # the state when the move under way began

    @property
    def known(self) -> bool:
        """Whether the state can be trusted."""
        return not self.unknown

    def observe(self, report: Applied) -> None:
        """Take the next report.

        Raises:
            ValueError: another number of actuators than before, or signals that are not finite.
        """
        if not np.isfinite(report.signals).all():
            raise ValueError("applied: holds values that are not finite")
        last, self._last = self._last, report
        if self.state is not None and len(report.signals) != len(self.state.signals):
            raise ValueError(f"applied: {len(report.signals)} signals, before there were {len(self.state.signals)}")
        if last is None or self.state is None:
            self._guess(report, "it moved before this node followed it")
            return
        law = self.law
        if last.time < law.crept_at <= report.time and law.crept.shape == report.signals.shape:
            # The figure of a calibration is relative to what the actuators had crept to, as it found.
            state = law.advance(self.state, law.crept_at)
            crept = np.repeat(law.crept[:, None], len(law.creep_time), axis=1)
            self.state, self._set_off = replace(state, crept=crept, doubt=np.zeros(0)), None
        if report.time < self.state.time:
            # Hysteresis knows no time; creep stands still until the clock has caught up.
            self.state = replace(self.state, time=report.time)
        if report.turns < last.turns or report.degausses < last.degausses:
            # It stood where the driver left it or came up, which this report tells, from about then on.
            self.state = self.law.move(self.state, report.signals, self.state.time)
            self._guess_keeping_creep(report, "the driver was started or activated again")
            return
        if report.degausses > last.degausses:
            self._degaussed(report, last)
            return
        if report.moving and (not last.moving or report.turns > last.turns):
            self._set_off = self.law.advance(self.state, report.time)
        if not report.history_known:
            self._guess_keeping_creep(report, "writes were lost, or a degauss was left")
            return
        if report.turns > last.turns + 1:
            self._guess_keeping_creep(report, f"{report.turns - last.turns - 1} turns were not seen")
            return
        self._follow(report, last)

    def _follow(self, report: Applied, last: Applied) -> None:
        assert self.state is not None
        if report.turns > last.turns and report.turned_at is not None:
            self.state = self.law.move(self.state, report.turned_at, report.time)
        self.state = self.law.move(self.state, report.signals, report.time)

    def _degaussed(self, report: Applied, last: Applied) -> None:
        """Begin a new history; moves since the degauss are known if there was at most one turn."""
        assert self.state is not None
        # While it swings about the middle, creep follows the middle.
        began = self._set_off or self.state
        self.state = self.law.advance(self.law.degaussed(began, began.time, self._middle), report.time)
        self._set_off = None
        # The end of the degauss is a turn itself, and one left for it may precede.
        seen = report.turns - last.turns <= 2 and report.degausses == last.degausses + 1
        self.unknown = "" if seen and report.history_known else "moves after the degauss were not seen"
        if report.turned_at is not None:
            self.state = self.law.move(self.state, report.turned_at, report.time)
        self.state = self.law.move(self.state, report.signals, report.time)

    def _guess(self, report: Applied, reason: str) -> None:
        self.state, self.unknown = self.law.rested(report.signals, report.time, self._middle, self._record), reason

    def _guess_keeping_creep(self, report: Applied, reason: str) -> None:
        """Where the mirror stands is known, on which branch is not."""
        assert self.state is not None
        self.state = self.law.move(self.state, report.signals, report.time)
        self.unknown = reason
