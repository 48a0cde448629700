"""The results of a run so far, as the sum of its events.

Everything that happens in a run is an event. A live run takes its events one by one and stores each on disk
(:mod:`dm_calibration.procedure.run_journal`); an interrupted run is restored from the stored events. Both use
:meth:`Outcome.take`, so they cannot differ.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dm_calibration.influence.maps import MapSet, StepKind
from dm_calibration.influence.regression import TooFewMapsError
from dm_common.measurement import Measurement, Setup


@dataclass(frozen=True)
class Segment:
    """A known history of the actuators begins, with the degauss at the start or the resumption of a run.

    Attributes:
        number: 0 for the first.
        stamp_ns: wall time, ns since the epoch.
    """

    number: int
    stamp_ns: int = 0


@dataclass(frozen=True)
class MapTaken:
    """A map was measured."""

    record: Measurement


@dataclass(frozen=True)
class Unseen:
    """A command without a map, kept because it belongs to the history of the actuators."""

    record: Measurement


def without_map(record: Measurement, **changes: Any) -> Unseen:
    """A command without a map: `record` without the results of its map, and with `changes`."""
    nothing = np.full_like(record.coefficients, np.nan)
    unseen = replace(record, coefficients=nothing, sigma=nothing, sag=np.full_like(record.sag, np.nan), nominal=None)
    unseen = replace(unseen, residual_rms=np.nan, valid_fraction=0.0, file="", sha256="", moved_ns=0)
    return Unseen(replace(unseen, **changes))


@dataclass(frozen=True)
class Dropped:
    """A map of `step` could not be taken; `whole`: the step is given up."""

    step: int
    reason: str
    whole: bool = False


@dataclass(frozen=True)
class Solved:
    """The signals of a shape were solved with an influence function: the shape, and a remark if it was reduced."""

    target: str
    remark: str = ""


@dataclass(frozen=True)
class Doubted:
    """All maps but the first `kept` are in doubt, for `reason`; their steps are to be measured again."""

    kept: int
    reason: str


Event = Setup | Segment | MapTaken | Unseen | Dropped | Solved | Doubted


@dataclass
class Outcome:
    """The results of a run so far.

    Attributes:
        setup: properties that all maps share; None before the first map.
        dropped: "label: reason" of each map or state that could not be measured.
        remarks: deviations of the measurements from the request.
    """

    records: list[Measurement] = field(default_factory=list)
    setup: Setup | None = None
    dropped: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    targets: list[str] = field(default_factory=list)
    segment: int = 0
    # Each drop, and the number of records before it.
    _drops: list[tuple[int, Dropped]] = field(default_factory=list)
    # Number of events since the last map: drops, and commands without a map.
    _failing: int = 0
    _unseen: int = 0

    def take(self, event: Event) -> None:
        """Add `event`."""
        match event:
            case Setup():
                self.setup = event
            case Segment():
                self._begin(event.number)
            case MapTaken():
                self.records.append(event.record)
                self._failing = self._unseen = 0
            case Unseen():
                self.records.append(event.record)
                self._unseen += 1
            case Dropped():
                self.dropped.append(event.reason)
                self._failing += 1
                self._drops.append((len(self.records), event))
            case Solved():
                if event.target not in self.targets:  # solved again after an interruption
                    self.targets.append(event.target)
                    self.remarks += [event.remark] if event.remark else []
            case Doubted():
                self._doubt(event)

    @property
    def measured(self) -> int:
        """Number of maps; `records` may hold commands without one as well."""
        return sum(record.has_map for record in self.records)

    @property
    def radius_known(self) -> bool:
        """Whether all maps contain their aperture radius."""
        return all(record.radius > 0.0 for record in self.records)

    def tried(self, step: int) -> int:
        """Number of maps of the state `step` that were taken or given up."""
        given_up = sum(1_000_000 if drop.whole else 1 for _before, drop in self._drops if drop.step == step)
        return sum(record.step == step for record in self.records) + given_up

    def maps(self) -> MapSet:
        """All maps measured.

        Raises:
            TooFewMapsError: there is none.
        """
        if not self.records:
            raise TooFewMapsError("no map was measured; " + "; ".join(self.dropped[:3]))
        return MapSet.of(self.records)

    def maps_before_solving(self, kind: StepKind) -> MapSet:
        """The maps before the first solved shape of a kind, so that an interruption does not change the model."""
        maps = self.maps()
        solved = np.array([one == kind for one in maps.kind])
        if kind is StepKind.SURFACE:
            solved &= np.isfinite(maps.nominal).any(axis=1)
        return maps.select(~np.logical_or.accumulate(solved))

    def _begin(self, number: int) -> None:
        """Begin a segment. The last failures are forgotten and tried again: the run may have ended because of them."""
        if number and self._failing:
            del self.dropped[-self._failing :], self._drops[-self._failing :]
        if number and self._unseen:
            del self.records[-self._unseen :]
        self.segment, self._failing, self._unseen = number, 0, 0

    def _doubt(self, event: Doubted) -> None:
        doubtful = self.records[event.kept :]
        self.dropped += [f"{record.label}: {event.reason}" for record in doubtful if record.has_map]
        # Maps that failed meanwhile may have failed for the same reason.
        failed = [drop for before, drop in self._drops if before >= event.kept and not drop.whole]
        for drop in failed:
            self.dropped.remove(drop.reason)
        self._drops = [each for each in self._drops if each[0] < event.kept or each[1].whole]
        del self.records[event.kept :]
        self._failing = self._unseen = 0
