"""Limits of the signals of a mirror: the range of each, and the difference between neighbours."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dm_common import Bools, Floats

#: Violations up to this count as rounding; it is far below a DAC step (1.5e-5, in normalised signals).
SLACK = 1e-9
#: Signals closer to a limit than this count as standing at it.
AT_LIMIT = 1e-6
#: Fewest half-swings of a degauss that wipes out hysteresis. After n of them, up to 1 / (2 n) of the first one remains;
#: with more than a tenth left, the mirror is not in the demagnetised state that is assumed after a degauss.
DEGAUSS_STEPS_MIN = 5
#: Most half-swings of a degauss: with more, the last ones would be smaller than a step of the electronics.
DEGAUSS_STEPS_MAX = 10000


def same_signals(one: Sequence[float] | Floats, other: Floats) -> bool:
    """Whether two commands (N,) are equal up to rounding."""
    return len(one) == len(other) and float(np.abs(np.asarray(one) - other).max(initial=0.0)) <= SLACK


@dataclass(frozen=True)
class Limits:
    """Limits of the signals of one mirror; signals are normalised.

    Attributes:
        low, high: range of every signal.
        pairs: (P, 2) 0-based indices of neighbouring actuators; may be empty.
        neighbour_difference: largest allowed difference between the two of a pair.

    Raises:
        ValueError: an empty range, or a difference that is not positive.
    """

    low: float = -1.0
    high: float = 1.0
    pairs: NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 2), dtype=np.intp))
    neighbour_difference: float = 2.0

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(f"signal range {self.low:g} to {self.high:g}: the lower limit must be below the upper")
        if not self.neighbour_difference > 0:
            raise ValueError(f"neighbour_difference = {self.neighbour_difference:g}: must be positive")

    @property
    def middle(self) -> float:
        """Mid range."""
        return 0.5 * (self.low + self.high)

    @property
    def half_range(self) -> float:
        """From mid range to either end."""
        return 0.5 * (self.high - self.low)

    @cached_property
    def neighbours_can_bind(self) -> bool:
        """Whether neighbours can differ by more than their limit inside the range."""
        return len(self.pairs) > 0 and self.neighbour_difference < self.high - self.low

    def differences(self, signals: Floats) -> Floats:
        """(P,) absolute difference between the two neighbours of each pair."""
        return np.asarray(np.abs(signals[self.pairs[:, 0]] - signals[self.pairs[:, 1]]))

    def allow(self, signals: Floats) -> bool:
        """Whether `signals` (N,) satisfy all limits, up to rounding."""
        inside = signals.min() >= self.low - SLACK and signals.max() <= self.high + SLACK
        return bool(inside) and self.allow_neighbours(signals)

    def allow_neighbours(self, signals: Floats) -> bool:
        if not self.neighbours_can_bind:
            return True
        return bool(self.differences(signals).max() <= self.neighbour_difference + SLACK)

    def at_limit(self, signals: Floats) -> Bools:
        """(N,) which actuators are at a limit."""
        result = (signals <= self.low + AT_LIMIT) | (signals >= self.high - AT_LIMIT)
        if self.neighbours_can_bind:
            differences = self.differences(signals)
            result[self.pairs[differences >= self.neighbour_difference - AT_LIMIT].ravel()] = True
        return result

    def scaled(self, signals: Floats) -> tuple[Floats, float]:
        """`signals` (N,) scaled about their mean so that they keep every limit, and the factor (1 = unchanged).

        A common signal lifts the plate without bending it, so scaling about the mean keeps the shape and changes its
        size.
        """
        mean = float(np.clip(signals.mean(), self.low, self.high))
        departure = signals - signals.mean()
        largest = (values.max(initial=0.0) for values in (departure, -departure, self.differences(signals)))
        allowed = (self.high - mean, mean - self.low, self.neighbour_difference)
        factor = min([1.0, *(most / size for size, most in zip(largest, allowed, strict=True) if size > most)])
        if factor == 1.0:
            return np.clip(signals, self.low, self.high), 1.0
        # Rounding must not leave a value slightly above a limit that the driver checks exactly.
        return np.clip(mean + factor * (1.0 - 1e-12) * departure, self.low, self.high), factor
