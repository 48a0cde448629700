"""Random requests to a calibrated simulation, and how near the true surface comes to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from dm_msgs.msg import Calibration

from dm_common import Floats
from dm_common.errors import Refusal
from dm_common.messages import mirror_info_of
from dm_common.optics.zernike import PISTON_TILT, TERMS
from dm_common.recipes import RecipeError
from dm_controller.planning.active_calibration import ActiveCalibration, active_calibration
from dm_controller.planning.choice import unreachable
from dm_controller.planning.target import FocusTarget
from studies.comparison.driven_mirror import DrivenMirror
from studies.comparison.simulated_bench import SimulatedBench
from studies.comparison.true_surface import TrueSurface

#: Parameter reachable_tolerance as shipped, m.
REACHABLE_TOLERANCE = 2e-8
#: Times that shapes are held, s.
DWELLS = (0.1, 1.0, 10.0, 60.0, 600.0)
#: Largest requested curvature, 1/m, and largest requested sum of added terms, m.
CURVATURE_MAX, ADDED_MAX = 0.05, 3e-7
#: Number of terms added to every other request.
ADDED_TERMS = 3


@dataclass(frozen=True, eq=False)
class Requests:
    """R requests of one kind.

    Attributes:
        error, upper: (R,) m, largest coefficient error of the true surface, and its bound predicted beforehand.
        dwell: (R,) s.
        refusals: of requests inside the published range that controller or driver refused.
    """

    error: Floats
    upper: Floats
    dwell: Floats
    refusals: tuple[str, ...] = ()

    @classmethod
    def none(cls, refusals: Sequence[str]) -> Requests:
        """No outcome: all requests were refused."""
        return cls(np.empty(0), np.empty(0), np.empty(0), tuple(refusals))

    @property
    def coverage(self) -> float:
        """Share inside the bound; NaN without requests."""
        return float(np.mean(self.error <= self.upper)) if len(self.error) else float("nan")

    def quantile(self, share: float) -> float:
        """Quantile of the errors, m; NaN without requests."""
        return float(np.quantile(self.error, share)) if len(self.error) else float("nan")


def active_of(bench: SimulatedBench, calibration: Calibration) -> ActiveCalibration:
    """The focus controller's active calibration, from this message on `calibration` and `mirror_info` of the bench."""
    return active_calibration(calibration, mirror_info_of(bench.mirror, slew_rate_max=bench.slew_rate))


def draw_targets(active: ActiveCalibration, count: int, rng: np.random.Generator) -> list[FocusTarget]:
    """Spheres, every other one with terms of orders 2 to 5 on top, inside the reachable range of the calibration."""
    targets = []
    for number in range(count):
        added = np.zeros(len(TERMS))
        if number % 2:
            which = rng.choice(np.arange(PISTON_TILT, len(TERMS)), ADDED_TERMS, replace=False)
            added[which] = rng.uniform(-1, 1, ADDED_TERMS) * rng.uniform(0.1, 1.0) * ADDED_MAX / ADDED_TERMS
        while True:
            plain = FocusTarget(0.0, zernike=tuple(added.tolist()) if added.any() else ())
            low, high = active.reachable_range(plain, REACHABLE_TOLERANCE)
            if low <= high:
                break
            added = np.where(np.abs(added) > 1e-9, 0.5 * added, 0.0)
            if not added.any() and not plain.zernike:
                raise ValueError("no curvature is reachable")
        curvature = rng.uniform(max(low, -CURVATURE_MAX), min(high, CURVATURE_MAX))
        targets.append(plain.with_curvature(float(curvature)))
    return targets


def judge_requests(
    driven: DrivenMirror,
    active: ActiveCalibration,
    surface: TrueSurface,
    targets: Sequence[FocusTarget],
    dwells: Floats,
) -> Requests:
    """Carry out the requests in order, and judge the true surface after each dwell."""
    served, served_dwells, upper, displacements, refusals = [], [], [], [], []
    for target, dwell in zip(targets, dwells, strict=True):
        try:
            move = driven.plan(target)
            if not move.max_zernike <= REACHABLE_TOLERANCE:
                raise unreachable(move, active, REACHABLE_TOLERANCE)
            driven.go(move)
            driven.hold(move, float(dwell))
        except (Refusal, RecipeError) as error:
            refusals.append(str(error))
            continue
        served.append(target)
        served_dwells.append(dwell)
        upper.append(move.plan.max_zernike_upper)
        displacements.append(driven.bench.true_displacement)
    if not served:
        return Requests.none(refusals)
    errors, _ = surface.errors(np.array(displacements), served)
    return Requests(np.abs(errors).max(axis=1), np.array(upper), np.array(served_dwells), tuple(refusals))
