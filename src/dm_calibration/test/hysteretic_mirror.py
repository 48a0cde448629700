"""A calibrated mirror whose actuators remember: LinearMirror behind one backlash, for tests of error prediction."""

from __future__ import annotations

from functools import cache

import numpy as np

from dm_calibration.influence.fit import FitOptions, InfluenceFit, fit_influence
from dm_calibration.influence.maps import MapSet
from dm_calibration.procedure.plan import PlanKind, make_plan
from dm_calibration.procedure.procedure import Procedure
from dm_common.mirror import Mirror
from linear_bench import LinearBench
from linear_mirror import LinearMirror, make_mirror

MIRROR = make_mirror()
#: Half-width of the backlash and its share of the move.
BACKLASH, SHARE = 0.35, 0.15


def lagging_bench(mirror: Mirror = MIRROR) -> LinearBench:
    """A bench whose actuators lag behind. The gains differ, so that hysteresis bends the plate."""
    gains = 1.0 + 0.05 * np.random.default_rng(9).standard_normal(mirror.actuators)
    plant = LinearMirror(mirror.x, mirror.y, noise=0.5e-9, piston_tilt=1e-7, gains=gains)
    return LinearBench(mirror, plant, BACKLASH, SHARE)


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
    return Procedure(make_plan(kind, MIRROR), MIRROR, lagging_bench()).run().maps()
