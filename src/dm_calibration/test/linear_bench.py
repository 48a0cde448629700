"""The bench of tests of the calibration without ROS: driver and interferometer around a linear mirror."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dm_calibration.procedure.recorded_run import Move
from dm_common import Floats
from dm_common.errors import MeasurementError
from dm_common.measurement import Measurement
from dm_common.mirror import Mirror
from linear_mirror import LinearMirror


class LinearBench:
    """Implements dm_common.measurement.Bench, and keeps what was done on it as a recording does.

    A move and a map take a tenth of a second each, the settling between them a second.

    Args:
        mirror: what the driver tells of it.
        plant: what it does; by default without noise.
        backlash: half-width, in signals, within which an actuator stays where it is.
        share: of the move that lags behind so.

    Attributes:
        moves, maps: what the driver and the interferometer did, in order.
        tries: labels of all maps that were asked for.
        failing: {label: measurements that still fail}.
        changes: {label: fields of the measurement to replace}.
        stop_at: label of the map during which the run is stopped.
    """

    def __init__(
        self, mirror: Mirror, plant: LinearMirror | None = None, backlash: float = 0.0, share: float = 0.0
    ) -> None:
        self.plant = plant or LinearMirror(mirror.x, mirror.y)
        self.backlash, self.share = backlash, share
        self.rest = self.signals = self.lag = mirror.rest
        self.clock_ns = 0
        self.moves: list[Move] = []
        self.maps: list[Measurement] = []
        self.tries: list[str] = []
        self.failing: dict[str, int] = {}
        self.changes: dict[str, dict[str, object]] = {}
        self.stop_at = ""
        self.stopped = False

    def degauss(self) -> None:
        self.signals = self.lag = self.rest
        self._moved(self.rest, True)

    def apply(self, signals: Floats) -> Floats:
        self.signals = np.round(signals * 32768) / 32768  # a 16-bit converter
        self.lag = np.clip(self.lag, self.signals - self.backlash, self.signals + self.backlash)
        self._moved(signals, False)
        return self.signals

    def _moved(self, requested: Floats, degauss: bool) -> None:
        self.clock_ns += 10**8
        self.moves.append(Move(self.clock_ns, requested.copy(), self.signals.copy(), degauss))

    @property
    def applied(self) -> list[Floats]:
        """Signals (N,) of all commands."""
        return [move.applied for move in self.moves if not move.degauss]

    def settle(self, dwell: float = 0.0, share: float = 1.0) -> bool:
        self.clock_ns += 10**9
        return not self.stopped

    def sag(self) -> Floats:
        """(P,) one reading of the mirror as it stands, m."""
        return self.plant.sag((1.0 - self.share) * self.signals + self.share * self.lag)

    def measure(self, label: str) -> Measurement:
        self.tries.append(label)
        self.clock_ns += 10**8
        if label == self.stop_at:
            self.stopped = True
        if self.failing.get(label, 0) > 0:
            self.failing[label] -= 1
            raise MeasurementError(302, "no map within 5 s")
        measured = self.plant.measurement(
            self.sag(),
            self.clock_ns,
            file=f"{label}.dat",
            sha256="00",
            moved_ns=self.moves[-1].stamp_ns if self.moves else 0,
        )
        self.maps.append(replace(measured, **self.changes.get(label, {})))  # type: ignore[arg-type]
        return self.maps[-1]
