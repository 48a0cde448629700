"""A check of every frame, independent of the driver's own limiter, by the signals that really reached the actuators."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dm_common.values import parameter, real
from dm_simulation.mirror.zernike import Array


@dataclass(frozen=True)
class MonitorConfig:
    """Limits of normalised signals, beyond which frames are counted; the extremes are recorded in any case."""

    jump: float = parameter(real(0.1, 0.0, 4.0), "Counted: change per frame above this; 0 = off.")
    neighbour_difference: float = parameter(
        real(1.0, 0.0, 4.0), "Counted: difference of neighbouring signals above this; 0 = off."
    )
    signal_min: float = parameter(real(-1.0, -10.0, 10.0), "Counted: signals below this.")
    signal_max: float = parameter(real(1.0, -10.0, 10.0), "Counted: signals above this.")
    tolerance: float = parameter(real(0.002, 0.0, 1.0), "Allowance for DAC steps.")


@dataclass
class Record:
    """Counts of frames that broke a limit, and the extremes seen."""

    frames: int = 0
    jumps: int = 0
    neighbour_violations: int = 0
    range_violations: int = 0
    largest_jump: float = 0.0
    largest_neighbour_difference: float = 0.0
    lowest_signal: float = np.inf
    highest_signal: float = -np.inf

    @property
    def violations(self) -> int:
        return self.jumps + self.neighbour_violations + self.range_violations


class Monitor:
    """Compares the signals of each frame with those before it.

    Args:
        pairs: (P, 2) neighbouring actuators.
        initial: signals (N,) before the first frame.
    """

    def __init__(self, config: MonitorConfig, pairs: NDArray[np.intp], initial: Array) -> None:
        self.config = config
        self.record = Record()
        self._pairs = pairs
        self._last = initial.copy()

    def watch(self, signals: Array) -> str:
        """Take the signals (N,) after a frame; return which limits they broke, "" if none."""
        config, record = self.config, self.record
        record.frames += 1
        jumps = np.abs(signals - self._last)
        differences = np.abs(signals[self._pairs[:, 0]] - signals[self._pairs[:, 1]])
        self._last = signals.copy()
        jump, difference = float(jumps.max()), float(differences.max(initial=0.0))
        lowest, highest = float(signals.min()), float(signals.max())
        record.largest_jump = max(record.largest_jump, jump)
        record.largest_neighbour_difference = max(record.largest_neighbour_difference, difference)
        record.lowest_signal = min(record.lowest_signal, lowest)
        record.highest_signal = max(record.highest_signal, highest)

        wrong = []
        if config.jump and jump > config.jump + config.tolerance:
            record.jumps += 1
            wrong.append(f"actuator {jumps.argmax() + 1} jumped by {jump:.4f}, limit {config.jump:g}")
        if config.neighbour_difference and difference > config.neighbour_difference + config.tolerance:
            record.neighbour_violations += 1
            first, second = self._pairs[differences.argmax()] + 1
            wrong.append(
                f"actuators {first} and {second} differ by {difference:.4f}, limit {config.neighbour_difference:g}"
            )
        if lowest < config.signal_min - config.tolerance or highest > config.signal_max + config.tolerance:
            record.range_violations += 1
            wrong.append(
                f"signals from {lowest:.4f} to {highest:.4f}, allowed {config.signal_min:g} to {config.signal_max:g}"
            )
        return "; ".join(wrong)
