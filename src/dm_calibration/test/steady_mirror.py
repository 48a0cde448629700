"""A mirror without hysteresis whose gains and figure can be made to drift, calibrated by pokes."""

from __future__ import annotations

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit
from dm_calibration.influence.fit import FitOptions
from dm_calibration.procedure.applied_history import SettledState
from dm_calibration.procedure.plan import PlanKind, make_plan
from dm_calibration.procedure.procedure import Procedure
from dm_common import Floats
from dm_common.hysteresis.model import HysteresisModel
from dm_common.measurement import Measurement
from linear_bench import LinearBench
from linear_mirror import LinearMirror, make_mirror

RINGS = 2
NOISE = 0.5e-9


class SteadyMirror(LinearBench):
    """Keeps no record of its maps."""

    def __init__(self, seed: int = 1) -> None:
        self.mirror = make_mirror(RINGS)
        super().__init__(
            self.mirror, LinearMirror(self.mirror.x, self.mirror.y, noise=NOISE, piston_tilt=1e-7, seed=seed)
        )
        self.clock_ns = 10**15
        self._first = self.plant.influence, self.plant.figure_coefficients

    def drift(self, gain: Floats | float, figure: Floats | float = 0.0) -> None:
        """Change gains (N,) relatively and figure coefficients (21,) m, against when it was made."""
        self.plant.influence = self._first[0] * (1.0 + gain)
        self.plant.figure_coefficients = self._first[1] + figure

    def measure(self, label: str, days: float = 0.0, bump: float = 0.0) -> Measurement:
        """One map, `days` later; `bump` (m) is astigmatism that the mirror does not have."""
        self.clock_ns += 10**9 + round(days * 86400e9)
        sag = self.plant.sag(self.signals) + bump * self.plant.modes[:, 4]
        return self.plant.measurement(sag, self.clock_ns)

    def settled(self) -> SettledState:
        """What stands at the mirror, as if it had just come."""
        return SettledState(self.signals, 1e-9 * self.clock_ns)

    def calibrate(self, stamp_ns: int = 0) -> Calibration:
        """Push-pull pokes, fitted; the last map not long before `stamp_ns` where given."""
        plan = make_plan(PlanKind.POKES, self.mirror)
        if stamp_ns:
            self.clock_ns = stamp_ns - 22 * 10**8 * len(plan.steps)
        outcome = Procedure(plan, self.mirror, self).run()
        provenance = Provenance("steady", self.clock_ns)
        return calibrate(outcome, mirror=self.mirror, options=FitOptions(), provenance=provenance)


def without_effect(error: float = 1e-10) -> HysteresisFit:
    """A play operator of no weight, predicted within `error` (m): of the history only counts whether it is known."""
    sigma = np.concatenate((np.zeros(3), np.full(18, error)))
    none = np.zeros(0)
    law = HysteresisModel(np.array([0.0, 0.5]), np.array([[1.0], [0.0]]), none, 0.0, 0.0, none)
    return HysteresisFit("none", law, sigma, 3.0 * error, 0.05, 100, ())
