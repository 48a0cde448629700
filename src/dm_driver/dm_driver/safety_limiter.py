"""Checks of commands before they reach the electronics, and the division of large moves into small writes.

The legal shapes are those with every signal in range and no two neighbours further apart than allowed. Both conditions
are convex: a straight line between two legal shapes stays legal. A move is therefore a straight line cut into equal
steps, may be left for a new target at any of them, and every shape on the way is as safe as its ends.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dm_common import Bools, Floats
from dm_common.errors import ErrorCode, Refusal, beside, size_text
from dm_common.limits import SLACK, Limits
from dm_common.values import parameter, real

Shape = Floats

#: Margin of the check before the write, for the additional rounding of interpolation.
_ROUNDING = 1e-12


@dataclass(frozen=True, kw_only=True)
class DriverLimits(Limits):
    """The limits of one mirror, and of the commands for it.

    Attributes:
        actuators: number of signals N.
        frames_per_second: most writes that the electronics take, Hz; `slew_rate` is at most `step` times this.

    Raises:
        ValueError: naming the parameter that is wrong.
    """

    actuators: int
    slew_rate: float = parameter(
        real(40.0, 1e-3, 1e6, "1/s"),
        "Largest mean rate of change of a signal; over a serial line, at most limits.step per frame.",
    )
    step: float = parameter(real(0.1, 1e-4, 2.0), "Largest change of a signal in one write.")
    command_age: float = parameter(real(1.0, 1e-3, 1e9, "s"), "Commands with an older stamp are refused.")
    command_lead: float = parameter(real(0.5, 1e-3, 1e9, "s"), "Commands stamped further in the future are refused.")
    frames_per_second: float = math.inf

    def __post_init__(self) -> None:
        if not -1.0 <= self.low < self.high <= 1.0:
            raise ValueError(
                f"limits.signal_min = {self.low:g}, limits.signal_max = {self.high:g}: must be rising and in -1 to 1"
            )
        for name in ("neighbour_difference", "step", "slew_rate", "command_age", "command_lead"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"limits.{name} = {value:g}: must be finite and above 0")


class SafetyLimiter:
    """Judge commands and plan moves within `DriverLimits`. Holds no state: the caller says where the mirror is."""

    def __init__(self, limits: DriverLimits) -> None:
        self.limits = limits

    def check_shape(self, signals: ArrayLike, name: str = "signals") -> Shape:
        """Return `signals` as a legal shape (a copy, with rounding errors beyond the range cut off).

        Raises:
            Refusal: INVALID_LENGTH, NOT_FINITE, OUT_OF_RANGE or NEIGHBOUR_DIFFERENCE.
        """
        limits = self.limits
        shape = np.array(signals, dtype=np.float64)
        if shape.shape != (limits.actuators,):
            raise Refusal(
                ErrorCode.INVALID_LENGTH,
                f"{size_text(name, shape.size)}: must have {limits.actuators}, one per actuator",
            )
        low, high = limits.low, limits.high
        outside = (shape < low - SLACK) | (shape > high + SLACK)
        _refuse(ErrorCode.NOT_FINITE, name, shape, ~np.isfinite(shape), "must be a finite number")
        _refuse(ErrorCode.OUT_OF_RANGE, name, shape, outside, f"must be {low:g} to {high:g}", low, high)
        self._check_neighbours(shape, name, SLACK)
        return np.clip(shape, low, high, out=shape)

    def check_age(self, age_s: float) -> None:
        """Judge the age of a command's stamp (negative = in the future).

        Raises:
            Refusal: STALE.
        """
        most, name, place = self.limits.command_age, "limits.command_age", "old"
        if age_s < 0.0:
            most, name, place = self.limits.command_lead, "limits.command_lead", "in the future"
        if not abs(age_s) <= most:
            rule = f"must be at most {most:g} s ({name}); do the clocks agree?"
            raise Refusal(ErrorCode.STALE, f"header.stamp is {abs(age_s):.3f} s {place}: {rule}")

    def check_write(self, previous: Shape | None, shape: Shape) -> None:
        """The last check before a write: a legal shape, and no step larger than allowed.

        `previous` is what was written before; None when the outputs are unknown, so that no step can be judged.

        Raises:
            Refusal: any refusal here is a defect of the caller.
        """
        limits = self.limits
        if shape.shape != (limits.actuators,):
            self.check_shape(shape)
        outside = ~((shape >= limits.low) & (shape <= limits.high))  # also NaN
        rule = f"must be {limits.low:g} to {limits.high:g}"
        _refuse(ErrorCode.INTERNAL, "signals", shape, outside, rule)
        self._check_neighbours(shape, "signals", SLACK + _ROUNDING)
        if previous is not None:
            change = np.abs(shape - previous)
            rule = f"must be at most {limits.step:g} (limits.step)"
            _refuse(ErrorCode.INTERNAL, "step", change, ~(change <= limits.step * (1.0 + SLACK) + _ROUNDING), rule)

    def ramp(self, start: Shape, target: Shape) -> Iterator[Shape]:
        """Yield the shapes to write on the way from `start` (excluded) to `target` (included, exactly).

        Both must be legal. No signal changes by more than `limits.step` from one to the next, and every one is legal
        (see the head of this module). At least one shape is yielded, also when nothing changes.
        """
        steps = max(1, math.ceil(largest_change(start, target) / self.limits.step - SLACK))
        difference = target - start
        low, high = self.limits.low, self.limits.high
        for number in range(1, steps):
            # The last bit of an interpolated value may lie beyond the range.
            yield np.clip(start + difference * (number / steps), low, high)
        yield target

    def path(self, start: Shape, waypoints: Iterable[Shape]) -> Iterator[Shape]:
        """Yield the shapes to write on the way from `start` through all `waypoints` (legal up to rounding)."""
        for waypoint in waypoints:
            target = np.clip(waypoint, self.limits.low, self.limits.high)
            yield from self.ramp(start, target)
            start = target

    def pause_after(self, previous: Shape, shape: Shape) -> float:
        """Seconds that must pass after writing `shape` over `previous` before the next write."""
        return largest_change(previous, shape) / self.limits.slew_rate

    def ramp_time(self, start: Shape, target: Shape) -> float:
        """Seconds from the first to the last write of a move."""
        change = largest_change(start, target)
        steps = max(1, math.ceil(change / self.limits.step - SLACK))
        # Even a short step takes one frame of the line.
        return (steps - 1) * max(change / steps / self.limits.slew_rate, 1.0 / self.limits.frames_per_second)

    def _check_neighbours(self, shape: Shape, name: str, slack: float) -> None:
        limits = self.limits
        difference = limits.differences(shape)
        too_far = difference > limits.neighbour_difference + slack
        if not too_far.any():
            return
        at_fault = np.zeros(limits.actuators, dtype=np.bool_)
        at_fault[limits.pairs[too_far]] = True
        worst = int(difference.argmax())
        a, b = limits.pairs[worst]
        others = int(too_far.sum()) - 1
        raise Refusal(
            ErrorCode.NEIGHBOUR_DIFFERENCE,
            f"{name} of the neighbouring actuators {a + 1} and {b + 1} ({shape[a]:g} and {shape[b]:g}) differ by"
            f" {difference[worst]:.10g}: must be at most {limits.neighbour_difference:g} (limits.neighbour_difference)"
            + (f"; {others} more pairs likewise" if others else ""),
            at_fault,
        )


class Watchdog:
    """Expires when no fresh command came for `period_s`; 0 = never. Starts disarmed."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self.deadline = math.inf

    def feed(self, now: float) -> None:
        """Note that a fresh command came at `now` (s of any steady clock)."""
        if self._period_s > 0.0:
            self.deadline = now + self._period_s

    def disarm(self) -> None:
        """Do not expire before the next command."""
        self.deadline = math.inf

    def expired(self, now: float) -> bool:
        return now >= self.deadline


def _refuse(code: ErrorCode, name: str, values: Shape, at_fault: Bools, rule: str, *limits: float) -> None:
    """Raise Refusal naming the first of the actuators `at_fault` (N,), if any, and the rule it breaks."""
    if at_fault.any():
        first, others = int(at_fault.argmax()), int(at_fault.sum()) - 1
        text = f"{name} of actuator {first + 1} = {beside('.6g', values[first], *limits)}: {rule}"
        raise Refusal(code, text + (f"; {others} more likewise" if others else ""), at_fault)


def largest_change(start: Shape, target: Shape) -> float:
    """Largest change of a signal between two shapes (N,)."""
    return float(np.abs(target - start).max())
