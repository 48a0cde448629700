"""The commands of a calibration run and its maps, in parts that each begin with a degauss.

A part begins where the run began or was resumed. The history of the actuators before a part is not known. The degauss
erases its hysteresis but not its creep, which fades in an unknown pattern; between two parts the mirror may also have
drifted. Further degausses within a part erase hysteresis too, but the earlier creep is then known.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from dm_calibration.hysteresis.features import EVEN, creep_states, crept, fading_features, follow, relaxation
from dm_calibration.hysteresis.responses import Responses, responses_of
from dm_calibration.influence.maps import BEFORE_FIRST_MAP_S, MapSet
from dm_common import Bools, Floats, Ints
from dm_common.hysteresis.duhem import FadingHysteresis
from dm_common.hysteresis.model import HysteresisModel

#: Scale of the fading creep of resumed parts: if few maps cannot tell it from a step of the figure, the step is fitted.
_FADING_SCALE = 0.1


@dataclass(frozen=True, eq=False)
class Run:
    """The commands and responses of one calibration run, in order, from a degauss at mid range on.

    Attributes:
        signals: (M, N) as applied.
        time: (M,) s, of the maps, rising.
        start: s, when the degauss had ended.
        moved: (M,) s, when the mirror took each shape; None = right after the map before.
        segment: (M,) number that changes where the run was resumed with a degauss; None = it was not interrupted.
        degaussed: (M,) which maps, at mid range, follow a degauss within the run; None = none.
        rest: signal of mid range, where a degauss ends.
        limits: lowest and highest signal for which a law of the run is meant; None = those in the run.

    Raises:
        ValueError: time stamps that run backwards.
    """

    signals: Floats
    time: Floats
    responses: Responses
    start: float = -BEFORE_FIRST_MAP_S
    moved: Floats | None = None
    segment: Ints | None = None
    degaussed: Bools | None = None
    rest: float = 0.0
    limits: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if (np.diff(self.time) < 0.0).any():
            row = int(np.flatnonzero(np.diff(self.time) < 0.0)[0]) + 1
            back = self.time[row - 1] - self.time[row]
            raise ValueError(f"time stamps: map {row + 1} is {back:.3f} s before the map before it; was the clock set?")

    @cached_property
    def parts(self) -> list[tuple[slice, float]]:
        """Rows of each part of the run, and when the degauss before it had ended, s."""
        resumed = [] if self.segment is None else (np.flatnonzero(np.diff(self.segment)) + 1).tolist()
        arrived = self.time if self.moved is None else self.moved
        starts = [min(self.start, float(self.time[0])), *(float(arrived[row]) - BEFORE_FIRST_MAP_S for row in resumed)]
        bounds = pairwise((0, *resumed, len(self.time)))
        return [(slice(*bound), start) for bound, start in zip(bounds, starts, strict=True)]

    def along(self, feature: Callable[[Floats], Floats]) -> Floats:
        """Values of `feature`, a function of signals that begin demagnetised, along the commands."""
        sequences = [rows for part, _ in self.parts for rows in self._sequences(part)]
        return np.concatenate([feature(self.signals[rows]) for rows in sequences])

    def fading(self, operators: FadingHysteresis) -> Floats:
        """(M, Z, N) values of Duhem operators along the commands."""
        return self.along(lambda signals: fading_features(signals, operators, self.rest))

    def _sequences(self, part: slice) -> list[slice]:
        """The rows of a part from one degauss to the next."""
        again = [] if self.degaussed is None else part.start + 1 + np.flatnonzero(self.degaussed[part][1:])
        return [slice(*bounds) for bounds in pairwise((part.start, *again, part.stop))]

    @property
    def reach(self) -> tuple[float, float]:
        """Lowest and highest signal of the actuators that moved; those without a channel may stand elsewhere."""
        moved = self.signals[:, np.ptp(self.signals, axis=0) > 0.0]
        return float(moved.min()), float(moved.max())

    @property
    def in_use(self) -> tuple[float, float]:
        """Lowest and highest signal at which a law of the run may be inverted: from its reach and the limits.

        With a tight limit between neighbours, short runs stay far from the ends, where polynomials may decrease.
        """
        low, high = self.limits or self.reach
        return min(low, self.reach[0]), max(high, self.reach[1])

    def follow(self, law: HysteresisModel) -> Floats:
        """(M, N) effective signals."""
        followed = []
        for part, start in self.parts:
            state = law.demagnetised(self.signals.shape[1], start, self.rest)
            for rows in self._sequences(part):
                time = state.time if self.moved is None else float(self.moved[rows.start])
                state = law.degaussed(state, time, self.rest)
                effective, state = follow(law, state, self.signals[rows], self.time[rows], self._moved(rows))
                followed.append(effective)
        return np.concatenate(followed)

    def creep_states(self, values: Floats) -> Floats:
        """(M, J, ...) states of the creep elements, which follow `values` (M, ...), at each map."""
        return np.concatenate(
            [creep_states(values[rows], self.time[rows], start, self._moved(rows)) for rows, start in self.parts]
        )

    def crept(self, features: Floats, weight: Floats = EVEN) -> Floats:
        """Creep of `features` (M, ...); see :func:`~dm_calibration.hysteresis.features.crept`."""
        return np.concatenate(
            [crept(features[rows], self.time[rows], start, self._moved(rows), weight) for rows, start in self.parts]
        )

    def _moved(self, rows: slice) -> Floats | None:
        return None if self.moved is None else self.moved[rows]

    @cached_property
    def figure(self) -> Floats:
        """(M, 1 + 2 parts) columns of the figure: constant, fading of old creep, drift; then step and fading of each
        resumed part.
        """
        (rows, start), *resumed = self.parts
        passed = np.diff(self.time, prepend=self.time[0])
        passed[[part.start for part, _ in self.parts]] = 0.0
        running = np.cumsum(passed)
        fading = np.zeros(len(self.time))
        fading[rows] = relaxation(self.time[rows], start)
        drift = (running + self.time[0] - start) / max(float(np.ptp(running)), 1e-9)
        columns = [np.ones(len(self.time)), fading, drift]
        for rows, start in resumed:
            step, fading = np.zeros((2, len(self.time)))
            step[rows] = 1.0
            fading[rows] = _FADING_SCALE * relaxation(self.time[rows], start)
            columns += [step, fading]
        return np.column_stack(columns)

    def gains(self, effective: Floats, keep: Bools) -> tuple[Floats, Floats]:
        """Gains (N, D) of effective signals (M, N), fitted to the rows in `keep` (M,), and all residuals (M, D), m."""
        design, values = np.hstack((self.figure, effective)), self.responses.values
        solution: Floats = np.asarray(np.linalg.lstsq(design[keep], values[keep], rcond=1e-10)[0], dtype=np.float64)
        return solution[self.figure.shape[1] :], values - design @ solution


def start_of(moved: Floats | None) -> float:
    """When the degauss before a run had ended, s since its first map, whose shape may have been held for long."""
    return -BEFORE_FIRST_MAP_S if moved is None else min(-BEFORE_FIRST_MAP_S, float(moved[0]))


def run_of(maps: MapSet) -> Run:
    """The maps of one run, in the order measured, which begins with a degauss.

    Raises:
        TooFewMapsError: no map can be used.
        ValueError: time stamps that run backwards.
    """
    time = 1e-9 * (maps.stamp_ns - maps.stamp_ns[0])
    moved = maps.moved_s()
    return Run(maps.applied, time, responses_of(maps), start_of(moved), moved, maps.segment, maps.degaussed, maps.rest)


def basis_of(columns: Floats) -> Floats:
    """Orthonormal columns that span `columns`, of which some may be 0 or linearly dependent in the given rows."""
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, size > 1e-9 * size[0]])


def without(rows: Floats, free: Floats) -> Floats:
    """`rows` (M, ...) less their projection onto the orthonormal columns `free` (M, C)."""
    return rows - np.tensordot(free, np.tensordot(free.T, rows, 1), 1)
