"""What a hysteresis plan will take and give, before anything moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dm_calibration.calibration import Calibration
from dm_calibration.hysteresis.accuracy import TYPICAL_NOISE, expected_accuracy
from dm_calibration.influence.maps import MapSet
from dm_calibration.procedure.plan import Plan, StepKind
from dm_common.optics.zernike import PISTON_TILT

Floats = NDArray[np.float64]

#: Time that one map takes, s, where neither a map nor a calibration says so.
TYPICAL_MAP_S = 1.0
#: Fewest pairs of maps of the same command that tell the noise.
PAIRS_MIN = 4


@dataclass(frozen=True)
class Forecast:
    """Attributes: s, and m as `HysteresisFit.held_out_max_zernike`; 0 = not known without an influence function."""

    duration: float
    max_zernike: float


def forecast(plan: Plan, settle_time: float, earlier: Calibration | None, map_time: float = 0.0) -> Forecast:
    """Duration and accuracy to expect of `plan`; accuracy only of hysteresis plans.

    Args:
        settle_time: s between command and map.
        earlier: calibration of the same mirror that tells gains and noise; None = there is none.
        map_time: s that the last map took; 0 = none was taken: then as in `earlier`, or TYPICAL_MAP_S.
    """
    steps = [step for step in plan.steps if step.kind is not StepKind.DEGAUSS]
    per_map = settle_time + (map_time or TYPICAL_MAP_S)
    if not map_time and earlier is not None and len(earlier.maps) > 1:
        gap = np.diff(np.sort(earlier.maps.stamp_ns)) * 1e-9
        per_map = max(float(np.median(gap)), settle_time)
    time = np.cumsum([per_map - (1.0 - step.settle_share) * settle_time + step.dwell for step in steps])
    duration = float(time[-1]) if len(time) else 0.0
    signals = [step.signals for step in steps if step.signals is not None]
    check = np.array([step.kind is StepKind.CHECK for step in steps], dtype=bool)
    if earlier is None or len(signals) < len(steps) or not check.any():
        return Forecast(duration, 0.0)
    found = expected_accuracy(np.array(signals), time, check, map_noise(earlier.maps), earlier.fit.influence_zernike)
    return Forecast(duration, found.max_zernike)


def map_noise(maps: MapSet) -> float:
    """Standard deviation of a coefficient of one map, m, from maps of the same command that follow each other."""
    same = (np.diff(maps.applied, axis=0) == 0.0).all(axis=1)
    change = np.diff(maps.coefficients[:, PISTON_TILT:], axis=0)[same]
    change = change[np.isfinite(change).all(axis=1)]
    if len(change) < PAIRS_MIN:
        return TYPICAL_NOISE
    return float(np.sqrt(0.5 * np.mean(np.square(change))))
