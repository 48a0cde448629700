"""Closed loop on an interferometer: measure, compare with the target, correct, until the surface is the wanted one.

Knows no ROS. The first map judges the open-loop command; each further map judges a correction. Hysteresis makes every
correction miss by some share of itself, so the loop contracts instead of ending in one step; the share is not known
beforehand. Two things keep it from diverging:

- after each step the measured change is compared with the commanded one, and the next correction is scaled by the
  inverse of their ratio (a secant step in one number, within bounds);
- if the error grows nevertheless, corrections are halved from then on, again each time it happens.

Creep goes on while the loop measures: after a large move the surface drifts more between two early maps than a
correction misses. With the actuators' hysteresis model, corrections include the creep until the next map.

The best command seen is kept. Damped corrections lie between two legal commands, so they are legal as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dm_common import Floats
from dm_common.errors import Cancelled
from dm_common.hysteresis.creep_record import rested
from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.measurement import Bench
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS
from dm_controller.planning.mirror_model import response, target_shape
from dm_controller.planning.target import FocusTarget
from dm_controller.solvers.base import Shape, Solver, measured_shape, rms_sag

#: Bounds of the factor by which the observed response may scale a correction.
SCALE_MIN, SCALE_MAX = 0.6, 1.5
#: Noise of a measured change, m: smaller changes do not show the response, and smaller growth is no divergence.
CHANGE_MIN = 3e-9
#: Lower bound of the damping: weaker corrections would not converge, and further growth has another cause.
DAMPING_MIN = 0.1
#: The best command is written again at the end if the last error was larger by this factor. Smaller differences are
#: noise, and going back costs hysteresis.
RESTORE_RATIO = 1.5


@dataclass(frozen=True)
class LoopOptions:
    """When to stop.

    Attributes:
        tolerance: largest coefficient error beyond tilt, m, at which the loop has converged.
        max_maps: maps it may take, the one of the open-loop command included.
        correct_last: after the last map, make one more correction, which stays unmeasured; else the mirror is left with
            a command that was measured.
    """

    tolerance: float = 2e-9
    max_maps: int = 5
    correct_last: bool = False


class Creep:
    """Predicts the creep between the map just taken and the next, which is assumed to take as long as this one.

    Args:
        law: of the actuators; without creep, zero is predicted.
        state: of the actuators before the loop's first command.
        now: returns the time, s, on the clock of `state`, which must advance steadily.
    """

    def __init__(self, law: HysteresisModel, state: HysteresisState, now: Callable[[], float]) -> None:
        self._law, self._state, self._now = law, state, now
        self._last = now()

    @classmethod
    def of_rate(cls, rate: float, signals: Floats, now: Callable[[], float]) -> Creep:
        """For actuators without hysteresis that creep by `rate` per decade and have long stood at `signals` (N,)."""
        law = HysteresisModel.linear(rate)
        return cls(law, rested(law, signals, now()), now)

    def moved(self, signals: Floats) -> None:
        """Note that the plant has just gone to `signals` (N,)."""
        self._state = self._law.move(self._state, signals, self._now())

    def predicted_change(self) -> Floats:
        """(N,) predicted change of the effective signals until the next map."""
        law, now = self._law, self._now()
        self._state = law.advance(self._state, now)
        then = law.advance(self._state, 2.0 * now - self._last)
        self._last = now
        return law.effective(then) - law.effective(self._state)


@dataclass(frozen=True, eq=False)
class LoopStep:
    """One map of the loop.

    Attributes:
        map: 1, 2, ...
        signals: (N,) commanded.
        error: measured minus wanted.
        max_zernike: largest coefficient error beyond tilt, m.
        rms: sag error at the sampling points, piston and tilt removed, m.
    """

    map: int
    signals: Floats
    error: Shape
    max_zernike: float
    rms: float


@dataclass(frozen=True, eq=False)
class LoopResult:
    """How a loop ended.

    Attributes:
        best: the step with the smallest coefficient error.
        steps: all, in order.
        converged: whether the best is within the tolerance.
        signals: (N,) what the mirror is left with.
        restored: the last command was clearly worse than the best, which was written again at the end, unmeasured;
            because of hysteresis the surface need not be the same as before.
    """

    best: LoopStep
    steps: tuple[LoopStep, ...]
    converged: bool
    signals: Floats
    restored: bool

    @property
    def maps(self) -> int:
        """Maps taken."""
        return len(self.steps)


class StoppedLoop(Cancelled):
    """The loop was asked to stop after this number of maps."""

    def __init__(self, maps: int) -> None:
        super().__init__(f"cancelled after {maps} maps; the mirror holds the last command")


def response_ratio(commanded: Shape, measured: Shape) -> float:
    """Ratio of measured to commanded change, by least squares over coefficients beyond tilt; NaN if too little moved.

    Coefficients are weighted by their rms sag.
    """
    factors = TERM_RMS[PISTON_TILT : len(commanded.coefficients)]
    wanted, got = factors * commanded.coefficients[PISTON_TILT:], factors * measured.coefficients[PISTON_TILT:]
    power = float(wanted @ wanted)
    return float(wanted @ got) / power if math.sqrt(power) >= CHANGE_MIN else math.nan


def converge(
    solver: Solver,
    target: FocusTarget,
    plant: Bench,
    options: LoopOptions | None = None,
    *,
    start: Floats | None = None,
    creep: Creep | None = None,
    on_step: Callable[[LoopStep], None] = lambda step: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> LoopResult:
    """Bring the surface to `target`.

    Args:
        start: (N,) signals to begin with; None = the solver's open-loop command.
        creep: predicts creep; None = do not correct for it.
        on_step: called after each map.

    Raises:
        TargetError: no such surface exists over the aperture.
        StoppedLoop: `cancelled()` became true, or the plant was cancelled while settling.
        Refusal: the mirror or the interferometer failed.
        ValueError: maps of another kind than the calibration's.
    """
    options = options or LoopOptions()
    model = solver.model
    wanted = target_shape(target, model)
    signals = solver.command(target).signals if start is None else start
    steps: list[LoopStep] = []
    damping, scale = 1.0, 1.0
    drift = response(model, np.zeros_like(signals))
    while True:
        if cancelled():
            raise StoppedLoop(len(steps))
        applied = plant.apply(signals)
        if creep is not None:
            creep.moved(applied)
        if not plant.settle():
            raise StoppedLoop(len(steps))
        number = len(steps) + 1
        measured = plant.measure(f"converge {number}")
        error = measured_shape(measured.coefficients, measured.sag, model) - wanted
        step = LoopStep(number, signals, error, error.max_zernike, rms_sag(error, model))
        if steps:
            commanded = response(model, signals - steps[-1].signals)
            ratio = response_ratio(commanded, error - steps[-1].error - drift)
            if math.isfinite(ratio):
                scale = float(np.clip(1.0 / ratio, SCALE_MIN, SCALE_MAX)) if ratio > 0.0 else SCALE_MIN
            if step.max_zernike > steps[-1].max_zernike + CHANGE_MIN:
                damping = max(0.5 * damping, DAMPING_MIN)
        steps.append(step)
        on_step(step)
        best = min(steps, key=lambda taken: taken.max_zernike)
        converged = best.max_zernike <= options.tolerance
        used_up = number >= options.max_maps
        restored = step.max_zernike > RESTORE_RATIO * best.max_zernike and (converged or used_up)
        if restored:
            signals = best.signals
            break
        if converged or (used_up and not options.correct_last):
            break
        if creep is not None:
            drift = response(model, creep.predicted_change())
        better, limits = solver.correct(signals, error + drift).signals, solver.limits
        further = np.clip(signals + scale * damping * (better - signals), limits.low, limits.high)
        # A longer step is clipped to the range, but not scaled for the neighbours: that would shrink the whole shape.
        signals = further if limits.allow_neighbours(further) else better
        if used_up:
            break
    if signals is not steps[-1].signals:
        plant.apply(signals)
        plant.settle()
    return LoopResult(best, tuple(steps), converged, signals, restored)
