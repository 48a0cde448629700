"""Control that knows what the actuators remember: hysteresis and creep followed through the commands.

An influence function knows signals only. Here each actuator follows a position, the sum of its signal and of play
operators of it (Prandtl-Ishlinskii law, [16], section 2.4), with the weights that
`dm_calibration.regression.sag_history` found on the maps of the calibration; and each change of position goes on
creeping with the logarithm of time [18]. The creep rate is a property of the piezos, as `closed_loop.Creep` takes it:
fitted to a calibration run, creep would take up what the play operators cannot follow.

A solver asks for a linear change of signals. The command is then the signals that change the positions as much, from
the state the actuators are in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dm_calibration.regression.sag_history import PLAY_RADII, RunHistory
from dm_controller.solvers.base import MISS, Floats, Shape, Solver, measured_shape
from studies.comparison.simulated_bench import SimulatedBench
from studies.paper.samples import Samples

#: Halvings of the range of signals that find a command: 2 / 2^36 is far below a step of the DAC.
HALVINGS = 36


class Memory:
    """State of the actuators of one mirror, at the end of its calibration to begin with.

    Attributes:
        slope: position per unit signal that the influence function holds, the average over the calibration.
        calibrated: (M, N) positions at the maps of the calibration, creep included.
    """

    def __init__(self, samples: Samples) -> None:
        maps, fit, config = samples.calibration.maps, samples.fit, samples.bench.config
        run = RunHistory(maps, maps.applied @ fit.influence_sag.T + fit.sag_offset)
        self._weights = run.fit(run.usable).hysteresis.play_weight[1:, 0]
        self._radius = np.array(PLAY_RADII)[:, None]
        self._share, self._age = config.creep, config.settle_time + config.exposure
        count = maps.applied.shape[1]
        self._play = np.zeros((len(PLAY_RADII), count))
        self._position = np.zeros(count)
        self._moves, self._times = np.empty((0, count)), np.empty(0)
        times = 1e-9 * maps.stamp_ns
        self.calibrated = np.stack([self.stand(*row) for row in zip(maps.applied, times, strict=True)])
        signals = maps.applied - maps.applied.mean(axis=0)
        self.slope = float(
            (signals * (self.calibrated - self.calibrated.mean(axis=0))).sum() / np.square(signals).sum()
        )
        self.stand(samples.bench.mirror.rest, samples.bench.time + self._age)

    def stand(self, signals: Floats, time: float) -> Floats:
        """Take in that the mirror was brought to `signals` (N,), and stands there at `time` (s).

        Returns:
            (N,) positions.
        """
        self._play = self._plays(signals)
        position = self._static(signals, self._play)
        if not np.array_equal(position, self._position):
            self._moves = np.vstack([self._moves, position - self._position])
            self._times = np.append(self._times, time - self._age)
        self._position = position
        return position + self._crept(time)

    def command(self, position: Floats, time: float) -> Floats:
        """(N,) signals in -1..+1 that bring the actuators to `position` (N,) at `time`, or as near as they go."""
        wanted = position - self._crept(time)
        low, high = -np.ones_like(wanted), np.ones_like(wanted)
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            short = self._static(middle, self._plays(middle)) < wanted
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        return 0.5 * (low + high)

    def _plays(self, signals: Floats) -> Floats:
        return np.clip(self._play, signals - self._radius, signals + self._radius)

    def _static(self, signals: Floats, play: Floats) -> Floats:
        """(N,) positions without creep; they rise with the signals, for no weight is negative."""
        return np.asarray(signals + self._weights @ play)

    def _crept(self, time: float) -> Floats:
        """(N,) what moves have crept beyond the age at which the maps of the calibration were taken."""
        age = np.maximum(time - self._times, self._age) / self._age
        return np.asarray(self._share * np.log10(age) @ self._moves)


@dataclass
class Estimate:
    """The surface error as far as maps and moves tell it (a Kalman filter with one variance for all coefficients).

    When a correction is hardly larger than the noise of a map, the map before it, carried on by the change that was
    asked for, says as much as the map after it.

    Attributes:
        noise: of a map, m, as the size of the largest coefficient.
        error: measured less wanted, the best estimate; None before the first map.
        variance: of it, m^2, in the same terms.
    """

    noise: float
    error: Shape | None = None
    variance: float = 0.0

    def update(self, measured: Shape, change: Shape) -> Shape:
        """Take in a map.

        Args:
            measured: its error.
            change: of the surface that was asked for since the last map; it may be missed by a share of MISS.
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


class RememberingControl:
    """Control of one twin, step by step, by a solver and the memory of the actuators."""

    def __init__(self, samples: Samples, bench: SimulatedBench, solver: Solver) -> None:
        self._solver, self._bench = solver, bench
        self._noise = samples.noise
        self._hysteresis = Memory(samples)
        self._stored = samples.calibration.maps

    def start(self, row: int, wanted: Shape) -> tuple[Floats, float]:
        """Signals (N,) for a surface from what a map of the calibration showed; no new map. And the overflow."""
        signals = self._stored.applied[row]
        shown = measured_shape(self._stored.coefficients[row], self._stored.sag[row], self._solver.model)
        command = self._solver.correct(signals, shown - wanted)
        return self._next(self._hysteresis.calibrated[row], command.signals - signals), command.overflow

    def move(self, signals: Floats) -> None:
        """Go to `signals` (N,) and let them stand."""
        self._bench.apply(signals)
        self._bench.settle()
        self._hysteresis.stand(signals, self._bench.time + self._bench.config.exposure)

    def converge(self, signals: Floats, wanted: Shape, maps: int) -> None:
        """Go to `signals`, then take a map and correct, `maps` times; the last correction is not measured."""
        model = self._solver.model
        estimate = Estimate(self._noise)
        before = None
        for number in range(maps):
            self._bench.apply(signals)
            self._bench.settle()
            taken = self._bench.measure(f"converge {number + 1}")
            position = self._hysteresis.stand(signals, self._bench.time)
            moved = np.zeros_like(position) if before is None else (position - before) / self._hysteresis.slope
            change = Shape(model.influence_zernike @ moved, model.influence_sag @ moved)
            error = estimate.update(measured_shape(taken.coefficients, taken.sag, model) - wanted, change)
            before = position
            signals = self._next(position, self._solver.correct(signals, error).signals - signals)
        self.move(signals)

    def _next(self, position: Floats, change: Floats) -> Floats:
        """Signals that lead from `position` by a linear `change` of signals, at the time of the next map."""
        config = self._bench.config
        time = self._bench.time + config.settle_time + config.exposure
        return self._solver.limited(self._hysteresis.command(position + self._hysteresis.slope * change, time)).signals
