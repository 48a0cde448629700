"""The shape of the mirror when a map was taken, from the reports of the driver."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dm_common import Floats
from dm_common.errors import CodedError, ErrorCode
from dm_common.hysteresis.model import HysteresisModel
from dm_common.hysteresis.observer import HysteresisObserver, Observed

#: Signals, or effective signals, that differ by up to this (normalised) count as the same shape: below 1 nm of sag.
SMALL_MOVE = 2e-4
#: Reports dated after a later one by more than this, s, are of before the clock was set back; clocks differ less.
CLOCKS_DIFFER_S = 5.0


class MapNotUsableError(CodedError, ValueError):
    """A map cannot be compared with the calibration; the message says why."""

    error_code = ErrorCode.MAP_REJECTED


@dataclass(frozen=True, eq=False)
class SettledState:
    """The mirror at the time of a map.

    Attributes:
        effective: (N,) effective signals; the signals themselves if no hysteresis is followed.
        since: time at which the mirror took this shape, s.
    """

    effective: Floats
    since: float


class AppliedHistory(HysteresisObserver):
    """Recent states of the mirror under one hysteresis model; thread-safe, except for `follow`."""

    def follow(self, law: HysteresisModel | None, middle: float = 0.0) -> None:
        """Follow `law` from now on, and apply it to earlier reports as well; None = no hysteresis."""
        self.use(law or HysteresisModel.linear(), middle)

    def heard_since(self, time: float) -> bool:
        """Whether the driver has reported at or after `time` (s), so that every move before it is known."""
        with self._lock:  # a report counts once it is followed
            return self.latest is not None and self.latest.heard >= time

    def still_for(self, time: float) -> float:
        """How long the mirror has kept its present shape until `time`, s; 0 = it moves, infinite = no report yet."""
        observed = self._since_set_back()
        if not observed:
            return float("inf")
        if not self._keeps(observed[-1], observed[-1]):
            return 0.0
        return time - observed[self._since(observed, len(observed) - 1)].report.time

    def settled(self, time: float, still: float) -> SettledState:
        """The state at `time` (s), if the mirror kept its shape from `still` (s) before to `still` after.

        Corrections that hold a shape against creep do not count as moves: the signals at `time` are known, and the
        hysteresis model gives their effect.

        Raises:
            MapNotUsableError: the mirror moved, or this or the hysteresis of the actuators is not known.
        """
        law, observed = self.law, self._since_set_back()
        times = [seen.report.time for seen in observed]
        at = next((k for k in reversed(range(len(observed))) if times[k] <= time), None)
        if at is None:
            ahead = self.latest.time - self.latest.heard if self.latest is not None else 0.0
            differ = f"; the last is stamped {ahead:.0f} s after its arrival: clocks differ"
            raise MapNotUsableError(
                "the signals when the map was taken are not known: no actuator_state from that time"
                + (differ if CLOCKS_DIFFER_S < ahead < np.inf else "")
            )
        report, estimate = observed[at]
        if not report.active:
            raise MapNotUsableError("pdm_driver was not active when the map was taken")
        if not self._keeps(observed[at], observed[at]):
            raise MapNotUsableError("the mirror was moving when the map was taken")
        after = next((k for k in range(at + 1, len(observed)) if not self._keeps(observed[at], observed[k])), None)
        if after is not None and times[after] < time + still:
            raise MapNotUsableError(
                f"the mirror moved {times[after] - time:.3f} s after the stamp of the map: must stand still for "
                f"{still:g} s"
            )
        since = times[self._since(observed, at)]
        if time - since < still:
            raise MapNotUsableError(
                f"the mirror moved {time - since:.3f} s before the stamp of the map: must stand still for {still:g} s"
            )
        if estimate.state is None or (law.has_history and estimate.unknown):
            raise MapNotUsableError(
                f"the history of the actuators is not known: {estimate.unknown}; a degauss over the full range "
                "(./dm degauss) cures that"
            )
        return SettledState(law.effective(law.advance(estimate.state, time)), since)

    def _since_set_back(self) -> list[Observed]:
        """Recent states since the clock was last set back; the times of those before say nothing of a map's state."""
        observed = self.recent()
        heard = self.latest.heard if self.latest is not None else -np.inf
        after = heard if heard > -np.inf else np.inf  # time of the later reports; infinite = not known
        for k in reversed(range(len(observed))):
            if observed[k].report.time > after + CLOCKS_DIFFER_S:
                return observed[k + 1 :]
            after = min(after, observed[k].report.time)
        return observed

    def _since(self, observed: Sequence[Observed], at: int) -> int:
        """Index of the first report since which the shape of report `at` was kept."""
        first = at
        while first > 0 and self._keeps(observed[at], observed[first - 1]):
            first -= 1
        return first

    def _keeps(self, shape: Observed, seen: Observed) -> bool:
        """Whether the mirror had the shape of report `shape` at report `seen`: same signals or effective signals."""
        law, state, report = self.law, seen.estimate.state, seen.report
        ends = [report.signals]
        if report.moving:
            if report.requested is None:
                return False
            ends.append(report.requested)
        for signals in ends:
            if np.abs(signals - shape.report.signals).max() <= SMALL_MOVE:
                continue
            if state is None or shape.estimate.state is None:
                return False
            reached = law.effective(law.move(state, signals, report.time))
            if np.abs(reached - law.effective(shape.estimate.state)).max() > SMALL_MOVE:
                return False
        return True
