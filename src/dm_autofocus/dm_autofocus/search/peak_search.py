"""Search of the sharpest focus: a state machine that is fed sharpness and says where to measure next.

It is independent of cameras, mirrors and time. Its user goes to `step.curvature`, takes an image there if
`step.measured` says so, and calls `feed`.

Coarse to fine [23, 25]: a sweep over the whole range finds the hill, sweeps over two steps of the one before climb it,
a parabola through the best points of the last gives its top. A sweep that sees the hill rise beyond its own end is
repeated around that end.

If moves are not trusted (`approach` above 0), every sweep, and the final move to the top, first goes to the same
turning point below. Passing a turning point again erases all smaller loops from the hysteresis, so that all sweeps
rise on the same branch. Otherwise the hill that a long sweep saw would not be where a short one expects it.
"""

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from dm_common import Bools
from dm_common.values import parameter, real, whole

#: Least height of the top of a hill above the median of its sweep, in standard deviations of the noise.
SIGNIFICANCE = 6.0
#: Least height of the mean of the next sweep above that median, in standard errors.
CONFIRMATION = 3.0
#: Fewest points with which noise can be distinguished from a hill.
NOISE_POINTS = 11
#: Most sweeps that are repeated around their own end, per search.
MOST_SHIFTS = 8
#: Share of the range that is given up each time the mirror refuses its end, and most such refusals.
RETREAT = 0.03
MOST_REFUSALS = 12


class Phase(IntEnum):
    """Phases, with the same numbers as in dm_msgs/AutofocusState."""

    IDLE = 0
    COARSE = 1
    FINE = 2
    TRACK = 3
    STACK = 4


@dataclass(frozen=True)
class Step:
    """Where to go [1/m]; `measured` False: only pass through, no image is needed."""

    curvature: float
    measured: bool = True


@dataclass(frozen=True)
class SearchConfig:
    """How to search.

    Attributes:
        low, high: range of curvatures [1/m], low < high.
        tolerance: depth of focus [1/m], above 0; no step is finer.
        coarse_points: positions of the first sweep, at least 4.
        fine_points, approach, least_contrast: see the parameters; an approach of 0: the mirror reaches the curvatures
            it is sent to from either direction.
    """

    low: float
    high: float
    tolerance: float
    coarse_points: int = 11
    fine_points: int = parameter(whole(7, 5, 1000), "Positions of each later sweep.")
    approach: float = parameter(
        real(1.0, 0.0, 1.0, "1/m"),
        "If the mirror's hysteresis is not known, or moves may err by two depths of focus, every sweep begins this far "
        "below its first position, but not below the range: the whole range puts all sweeps on one hysteresis branch, "
        "less is quicker.",
    )
    least_contrast: float = parameter(
        real(0.05, 0.0, 0.99), "Relative change of sharpness over the range below which there is nothing to focus on."
    )

    @property
    def steps(self) -> int:
        """Number of measured positions of a search that shifts no sweep; each shift adds one sweep."""
        spacing = (self.high - self.low) / (self.coarse_points - 1)
        sweeps = math.ceil(math.log(spacing / self.tolerance, (self.fine_points - 1) / 2) - 1e-9)
        return self.coarse_points + max(sweeps, 1) * self.fine_points

    def check_left(self) -> None:
        """Raise ValueError where hardly anything of the range is left."""
        if self.high - self.low < 2 * self.tolerance:
            raise ValueError(
                f"range = {self.low:+.4f} to {self.high:+.4f} 1/m: must span {2 * self.tolerance:g} 1/m or more"
            )


@dataclass(frozen=True)
class Peak:
    """Where the image is sharpest.

    Attributes:
        curvature: [1/m].
        sharpness: the largest seen in the last sweep.
        at_limit: the top lies at an end of the range: a sharper focus may lie beyond.
        error: standard error of the curvature [1/m]; NaN = not known.
    """

    curvature: float
    sharpness: float
    at_limit: bool
    error: float = math.nan


class Search:
    """Base class of a search, from beginning to end.

    Attributes:
        step: where to measure next; after the end, the curvature to stay at.
        config: as given, with the range reduced by what was refused.
        phase: COARSE, or FINE once a place is being confirmed.
        done: nothing more is to be fed.
        peak: what was found; None during the search, and at its end if there was nothing to see.
        measured: positions measured so far.
    """

    step: Step

    def __init__(self, config: SearchConfig) -> None:
        self.config = config
        self.phase = Phase.COARSE
        self.done = False
        self.peak: Peak | None = None
        self.measured = 0
        self._refusals = 0

    def _draw_in(self, first: float = -math.inf, last: float = math.inf) -> tuple[float, float]:
        """Shrink the range to exclude `step`, which the mirror refused; returns its part from `first` to `last` [1/m].

        Raises:
            ValueError: hardly anything of it is left.
        """
        config, here = self.config, self.step.curvature
        retreat = RETREAT * (config.high - config.low)
        if here < (config.low + config.high) / 2:
            self.config = replace(config, low=here + retreat)
        else:
            self.config = replace(config, high=here - retreat)
        left = replace(self.config, low=max(first, self.config.low), high=min(last, self.config.high))
        left.check_left()
        return left.low, left.high


class PeakSearch(Search):
    """A search by sweeps, to be fed sharpness."""

    def __init__(self, config: SearchConfig) -> None:
        super().__init__(config)
        self._positions: np.ndarray
        self._shifts = 0
        self._coarse = np.empty(0)  # what the first sweep saw, until the next has confirmed it
        self._begin(config.low, config.high, config.coarse_points)

    def feed(self, sharpness: float | None) -> None:
        """Report the sharpness at `step`; None when it was not to be measured.

        Raises:
            ValueError: no finite number where one is needed.
        """
        if not self.step.measured:
            if self.phase is Phase.FINE and self.peak is not None:
                self.step = Step(self.peak.curvature)
                self.done = True
            else:
                self.step = Step(float(self._positions[0]))
            return
        if sharpness is None or not math.isfinite(sharpness):
            raise ValueError(f"sharpness = {sharpness}: must be a finite number")
        self._seen.append(sharpness)
        self.measured += 1
        if len(self._seen) < len(self._positions):
            self.step = Step(float(self._positions[len(self._seen)]))
        else:
            self._judge(np.array(self._seen))

    def refuse(self) -> None:
        """Report that the mirror cannot take `step`: the range ends before it. At most MOST_REFUSALS times.

        Raises:
            ValueError: refused too often, or hardly anything of the range is left.
        """
        self._refusals += 1
        config = self.config
        seen = len(self._seen)
        if self._refusals > MOST_REFUSALS:
            raise ValueError(f"range = {config.low:+.4f} to {config.high:+.4f} 1/m: the mirror refuses too much of it")
        if self.step.measured and self.phase is Phase.COARSE and seen >= 4:
            self.config = replace(config, high=float(self._positions[seen - 1]))
            self._positions = self._positions[:seen]
            self._judge(np.array(self._seen))
            return
        low, high = self._draw_in(float(self._positions[0]), float(self._positions[-1]))
        self.peak = None
        self._begin(low, high, len(self._positions))

    def _begin(self, low: float, high: float, points: int) -> None:
        self._positions = np.linspace(low, high, points)
        self._seen: list[float] = []
        self._run_up = max(low - self.config.approach, self.config.low)
        self.step = Step(low) if self.config.approach == 0 else Step(self._run_up, measured=False)

    def _judge(self, seen: np.ndarray) -> None:
        """A sweep is complete: end, or narrow down."""
        best = int(seen.argmax())
        spacing = float(self._positions[1] - self._positions[0])
        if self.phase is Phase.COARSE:
            hill = bool(is_hill(seen, self.config.least_contrast))
            self._coarse = seen
        else:
            hill = _is_seen_again(self._coarse, seen)
            self._coarse = np.empty(0)
        if not hill:
            self.step = Step(float(self._positions[-1]))
            self.done = True
        elif self.phase is Phase.FINE and self._rises_beyond(best) and self._shifts < MOST_SHIFTS:
            self._shifts += 1
            self._around(float(self._positions[best]), float(np.ptp(self._positions)) / 2)
        elif self.phase is Phase.FINE and spacing <= self.config.tolerance:
            top = _vertex(self._positions, seen)
            near_end = min(top - self.config.low, self.config.high - top) < spacing / 2
            self.peak = Peak(top, float(seen[best]), near_end)
            self.done = self.config.approach == 0
            self.step = Step(top) if self.done else Step(self._run_up, measured=False)
        else:
            self.phase = Phase.FINE
            self._around(float(self._positions[best]), spacing)

    def _rises_beyond(self, best: int) -> bool:
        """Whether the largest value is at an end of the sweep that is not an end of the range."""
        first, last = self._positions[0], self._positions[-1]
        return (best == 0 and first > self.config.low) or (best == len(self._positions) - 1 and last < self.config.high)

    def _around(self, centre: float, reach: float) -> None:
        low, high = max(centre - reach, self.config.low), min(centre + reach, self.config.high)
        self._begin(low, high, self.config.fine_points)


def is_hill(seen: NDArray, least_contrast: float) -> Bools:
    """Whether sweeps rise by the least contrast, and by more than noise does.

    The noise is estimated from the second differences: those of a hill are small, or large at a few points only, which
    the median ignores. The top of n points of white noise is about two standard deviations above their median. With
    fewer than NOISE_POINTS points a hill may cover most of them, so only the contrast counts.

    Args:
        seen: sharpness along a sweep, (N, ...).
        least_contrast: of the largest over the smallest, relative to the largest.

    Returns:
        For each sweep, (...).
    """
    top = seen.max(0)
    contrasting = np.ptp(seen, axis=0) > least_contrast * np.abs(top)
    if len(seen) < NOISE_POINTS:
        return contrasting
    return contrasting & (top - np.median(seen, axis=0) > SIGNIFICANCE * _noise(seen))


def _is_seen_again(coarse: np.ndarray, fine: np.ndarray) -> bool:
    """Whether the sweep around the top of a hill is higher than most of the sweep that saw it.

    With about ten points the noise is sometimes underestimated by far: of 1000 sweeps over nothing, five to eight pass
    for a hill, and hardly one of these does so a second time.
    """
    if len(coarse) < NOISE_POINTS:
        return True
    above = float(fine.mean()) - float(np.median(coarse))
    return bool(above > CONFIRMATION * _noise(coarse, fine) / math.sqrt(len(fine)))


def _noise(*sweeps: NDArray) -> NDArray:
    """Standard deviation of white noise on sweeps (N, ...) over smooth hills, (...)."""
    bends = np.concatenate([np.abs(np.diff(sweep, 2, axis=0)) for sweep in sweeps])
    return np.median(bends, axis=0) / (0.6745 * math.sqrt(6))


def _vertex(positions: np.ndarray, values: np.ndarray) -> float:
    """Top of the parabola through the five points around the largest value, inside them; that value's place if none."""
    best = int(values.argmax())
    first = min(max(best - 2, 0), len(values) - 5)
    x = positions[first : first + 5] - positions[best]
    scale = float(np.ptp(x))
    square, slope, _constant = np.polyfit(x / scale, values[first : first + 5], 2)
    if square >= 0:
        return float(positions[best])
    return float(positions[best] + np.clip(-slope / (2 * square) * scale, x[0], x[-1]))
