"""Control that follows hysteresis and creep through the commands, with the modules that the suite uses for it.

The law of all actuators is identified from the maps of the sample surfaces, and the influence function fitted to
effective signals (:func:`~dm_calibration.hysteresis.hysteresis_fit.fit_hysteresis`). The tracker follows the state of
the actuators from what the driver reports. A solver gives effective signals; the controller's planner inverts the law,
so that they are reached when the next map is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dm_common import Floats
from dm_common.hysteresis.model import HysteresisState
from dm_common.hysteresis.observer import HysteresisTracker
from dm_controller.planning.mirror_model import CalibratedMirror, response
from dm_controller.planning.planner import HysteresisFigures, Planner
from dm_controller.solvers.base import MISS, Shape, Solver, measured_shape
from studies.comparison.simulated_bench import SimulatedBench
from studies.paper.samples import Samples


@dataclass
class Estimate:
    """Estimate of the surface error from maps and moves (a Kalman filter with one variance for all coefficients).

    When a correction is hardly larger than the noise of a map, the map before it plus the commanded change is as good
    a measurement as the map after it.

    Attributes:
        noise: of a map, m: typical size of its largest coefficient error.
        error: best estimate of measured less wanted; None before the first map.
        variance: of this estimate, m^2, in the same terms as `noise`.
    """

    noise: float
    error: Shape | None = None
    variance: float = 0.0

    def update(self, measured: Shape, change: Shape) -> Shape:
        """Take in a map.

        Args:
            measured: its error.
            change: commanded change of the surface since the last map; its relative uncertainty is MISS.
        """
        if self.error is None:
            self.error, self.variance = measured, self.noise**2
            return measured
        expected = self.error + change
        before = self.variance + (MISS * change.max_zernike) ** 2
        gain = before / (before + self.noise**2)
        news = measured - expected
        self.error = expected + Shape(gain * news.coefficients, gain * news.sag)
        self.variance = (1.0 - gain) * before
        return self.error


class HysteresisControl:
    """Control of one simulated mirror, step by step, by a solver on effective signals.

    Args:
        bench: a copy of that of `samples`, in the same state.
        solver: its model acts on effective signals.
    """

    def __init__(self, samples: Samples, bench: SimulatedBench, solver: Solver) -> None:
        self._bench, self._solver, self._noise = bench, solver, samples.noise
        self._stored, found = samples.effective_maps, samples.hysteresis
        figures = HysteresisFigures(found.law, found.held_out_max_zernike, found.unknown_sigma)
        self._planner = Planner(CalibratedMirror(solver.model, bench.limits), figures, bench.slew_rate)
        self._tracker = HysteresisTracker(found.law)
        self._seen = 0

    def start(self, row: int, wanted: Shape) -> tuple[Floats, float]:
        """Effective signals (N,) for the wanted surface from map `row` of the calibration, and their overflow."""
        effective = self._stored.applied[row]
        shown = measured_shape(self._stored.coefficients[row], self._stored.sag[row], self._solver.model)
        command = self._solver.correct(effective, shown - wanted)
        return command.signals, command.overflow

    def converge(self, effective: Floats, wanted: Shape, maps: int) -> None:
        """Go to `effective` (N,), then take a map and correct, `maps` times; the last correction is not measured."""
        model = self._solver.model
        estimate = Estimate(self._noise)
        before = None
        for number in range(maps):
            self._go(effective)
            taken = self._bench.measure(f"converge {number + 1}")
            reached = self._effective()
            moved = np.zeros_like(reached) if before is None else reached - before
            change = response(model, moved)
            error = estimate.update(measured_shape(taken.coefficients, taken.sag, model) - wanted, change)
            before = reached
            effective = self._solver.correct(reached, error).signals
        self._go(effective)

    def _go(self, effective: Floats) -> None:
        """Move so that `effective` (N,) is reached when the next map is taken, and let the mirror settle."""
        bench = self._bench
        state = self._follow()
        ahead = bench.config.settle_time + bench.config.exposure
        bench.apply(self._planner.hold(state, bench.time, effective, ahead))
        bench.settle()

    def _effective(self) -> Floats:
        """(N,) effective signals now."""
        state = self._follow()
        return self._planner.law.effective(self._planner.law.advance(state, self._bench.time))

    def _follow(self) -> HysteresisState:
        """The state after all that the driver has reported."""
        for report in self._bench.reports[self._seen :]:
            self._tracker.observe(report)
        self._seen = len(self._bench.reports)
        state = self._tracker.state
        assert state is not None
        return state
