"""What stood at the mirror when a map was taken, from what the driver reports."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dm_common.errors import ErrorCode
from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.hysteresis.observer import Applied, HysteresisTracker

Floats = NDArray[np.float64]

#: Signals that differ less, normalised, do not count as a move: below 1 nm, as steps of holding a shape against creep.
SMALL_MOVE = 2e-4
#: Reports kept to follow another hysteresis model: hysteresis begins anew with a degauss, creep goes further back.
LOG_LENGTH = 10_000
#: States kept for maps that arrive late.
STATES_KEPT = 500


class MapNotUsableError(ValueError):
    """A map cannot be compared with the calibration; the message says why."""

    error_code = ErrorCode.MAP_REJECTED


@dataclass(frozen=True, eq=False)
class SettledState:
    """The mirror at the time of a map.

    Attributes:
        effective: (N,) effective signals; the signals where no hysteresis is followed.
        since: s, when it took this shape.
    """

    effective: Floats
    since: float


@dataclass(frozen=True, eq=False)
class _Entry:
    report: Applied
    state: HysteresisState | None
    unknown: str


class AppliedHistory:
    """The states of late, under one hysteresis model; every method may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._log: deque[Applied] = deque(maxlen=LOG_LENGTH)
        self._entries: deque[_Entry] = deque(maxlen=STATES_KEPT)
        self._tracker: HysteresisTracker | None = None
        self._heard = float("-inf")

    def follow(self, law: HysteresisModel | None, middle: float = 0.0) -> None:
        """Follow `law` from now on, and through what was heard before; None = no hysteresis."""
        with self._lock:
            self._tracker = HysteresisTracker(law, middle) if law is not None else None
            self._entries.clear()
            for report in self._log:
                self._enter(report)

    def observe(self, report: Applied, heard: float) -> None:
        """Take the driver's next report, heard at `heard` (s).

        Raises:
            ValueError: as :meth:`HysteresisTracker.observe`; what was heard before is forgotten.
        """
        with self._lock:
            self._heard = heard
            last = self._log[-1] if self._log else None
            if last is not None and _same(report, last):
                return
            self._log.append(report)
            try:
                self._enter(report)
            except ValueError:
                self._log.clear()
                self._entries.clear()
                if self._tracker is not None:
                    self._tracker = HysteresisTracker(self._tracker.law)
                raise

    def _enter(self, report: Applied) -> None:
        if self._tracker is None:
            self._entries.append(_Entry(report, None, ""))
            return
        self._tracker.observe(report)
        self._entries.append(_Entry(report, self._tracker.state, self._tracker.unknown))

    def heard_since(self, time: float) -> bool:
        """Whether the driver has reported at or after `time` (s), so that a move until then would be known."""
        with self._lock:
            return self._heard >= time

    def settled(self, time: float, still: float) -> SettledState:
        """What stood at `time` (s), if the mirror stood still from `still` (s) before to `still` after.

        Raises:
            MapNotUsableError: it did not, or that is not known, or the hysteresis of the actuators is not known.
        """
        with self._lock:
            entries = list(self._entries)
            law = self._tracker.law if self._tracker is not None else None
        times = [entry.report.time for entry in entries]
        at = next((k for k in reversed(range(len(entries))) if times[k] <= time), None)
        if at is None:
            raise MapNotUsableError("what stood at the mirror when the map was taken is not known: no report so old")
        entry = entries[at]
        signals = entry.report.signals
        if not entry.report.active:
            raise MapNotUsableError("pdm_driver was not active when the map was taken")
        if entry.report.moving:
            raise MapNotUsableError("the mirror was moving when the map was taken")
        after = next((k for k in range(at + 1, len(entries)) if _moved(entries[k], signals)), None)
        if after is not None and times[after] < time + still:
            raise MapNotUsableError(
                f"the mirror moved {times[after] - time:.3f} s after the stamp of the map: must stand still for "
                f"{still:g} s"
            )
        first = at
        while first > 0 and not _moved(entries[first - 1], signals):
            first -= 1
        if time - times[first] < still:
            raise MapNotUsableError(
                f"the mirror moved {time - times[first]:.3f} s before the stamp of the map: must stand still for "
                f"{still:g} s"
            )
        if law is None:
            return SettledState(signals, times[first])
        if entry.unknown or entry.state is None:
            raise MapNotUsableError(
                f"the history of the actuators is not known: {entry.unknown}; a degauss over the full range cures that"
            )
        return SettledState(law.effective(law.advance(entry.state, time)), times[first])


def _moved(entry: _Entry, signals: Floats) -> bool:
    """Whether the state of `entry` is another shape than `signals`, or on the way to one."""
    report = entry.report
    return report.moving or bool(np.abs(report.signals - signals).max() > SMALL_MOVE)


def _same(now: Applied, before: Applied) -> bool:
    return (
        (now.moving, now.active, now.history_known) == (before.moving, before.active, before.history_known)
        and (now.time, now.turns, now.degausses) == (before.time, before.turns, before.degausses)
        and np.array_equal(now.signals, before.signals)
    )
