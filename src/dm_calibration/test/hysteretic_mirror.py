"""A calibrated mirror whose actuators remember: LinearMirror behind one backlash, for tests of error prediction."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from dm_calibration.influence.fit import FitOptions, InfluenceFit, fit_influence
from dm_calibration.influence.maps import MapSet
from dm_calibration.procedure.plan import PlanKind, make_plan
from dm_calibration.procedure.procedure import Procedure
from dm_common.measurement import Measurement
from linear_mirror import RADIUS, LinearMirror, make_mirror

Floats = NDArray[np.float64]

MIRROR = make_mirror()
#: Half-width of the backlash and its share of the move.
BACKLASH, SHARE = 0.35, 0.15


class RememberingBench:
    """Implements dm_common.measurement.Bench. The gains differ, so that hysteresis bends the plate."""

    def __init__(self) -> None:
        gains = 1.0 + 0.05 * np.random.default_rng(9).standard_normal(MIRROR.actuators)
        self.plant = LinearMirror(MIRROR.x, MIRROR.y, noise=0.5e-9, piston_tilt=1e-7, gains=gains)
        self.lag = np.zeros(MIRROR.actuators)
        self.signals = MIRROR.rest
        self.clock_ns = 0

    def degauss(self) -> None:
        self.lag = np.zeros(MIRROR.actuators)

    def apply(self, signals: Floats) -> Floats:
        self.signals = signals
        self.lag = np.clip(self.lag, signals - BACKLASH, signals + BACKLASH)
        return signals

    def settle(self, dwell: float = 0.0) -> bool:
        self.clock_ns += 10**9
        return True

    def sag(self) -> Floats:
        return self.plant.sag((1.0 - SHARE) * self.signals + SHARE * self.lag)

    def measure(self, label: str) -> Measurement:
        sag = self.sag()
        return Measurement(
            points=self.plant.points,
            sag=sag,
            coefficients=self.plant.fit_terms(sag),
            sigma=np.full(21, 1e-10),
            stamp_ns=self.clock_ns,
            residual_rms=2e-9,
            valid_fraction=0.98,
            radius=RADIUS,
            wavelength=632.8e-9,
        )


@cache
def calibrated(method: str = "AZreg") -> tuple[MapSet, InfluenceFit]:
    """Maps and influence function of one calibration with the plan FULL."""
    maps = _maps(PlanKind.FULL)
    return maps, fit_influence(maps, FitOptions(method=method), rings=MIRROR.rings)


@cache
def calibrated_by_pokes() -> tuple[MapSet, InfluenceFit]:
    """The same without sample surfaces."""
    maps = _maps(PlanKind.POKES)
    return maps, fit_influence(maps, rings=MIRROR.rings)


@cache
def _maps(kind: PlanKind) -> MapSet:
    return Procedure(make_plan(kind, MIRROR), MIRROR, RememberingBench()).run().maps()
