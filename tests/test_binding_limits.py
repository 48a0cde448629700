"""Limits that bind: plan, quantise, hold, plan again, at loose and tight limits; the driver's limiter is the judge."""

from __future__ import annotations

import numpy as np
import pytest

from dm_common import Floats
from dm_common.hysteresis.law_shape import normalised
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel, HysteresisState
from dm_common.limits import Limits
from dm_controller.planning.mirror_model import CalibratedMirror
from dm_controller.planning.planner import HysteresisFigures, Planner
from dm_controller.planning.target import FocusTarget
from dm_driver.safety_limiter import DriverLimits, SafetyLimiter
from linear_mirror import LinearMirror, hexagon, make_mirror
from perfect_calibration import perfect_model

ACTUATORS = 37
PAIRS = np.asarray(make_mirror().limits.pairs, dtype=np.intp)
#: Step of a 16-bit DAC over signals of -1 to 1.
DAC_STEP = 2.0**-15


def law(rng: np.random.Generator) -> HysteresisModel:
    """Loops of about a tenth of the range, another for each actuator, and creep."""
    radius = np.array([0.0, 0.1, 0.3, 0.6])
    weight = np.array([0.85, 0.06, 0.05, 0.04]) * np.exp(0.2 * rng.standard_normal((ACTUATORS, 4)))
    model = HysteresisModel(radius, weight[..., None], np.zeros(0), 0.0, 0.01, CREEP_TIMES)
    return normalised(model)


def planner(difference: float, rng: np.random.Generator) -> Planner:
    mirror = CalibratedMirror(perfect_model(LinearMirror(*hexagon())), Limits(-1.0, 1.0, PAIRS, difference))
    return Planner(mirror, HysteresisFigures(law(rng), 1e-9, 0.05), slew_rate=20.0)


def written(signals: Floats) -> Floats:
    """What a DAC makes of `signals`."""
    return np.clip(np.round((signals + 1.0) / DAC_STEP) * DAC_STEP - 1.0, -1.0, 1.0)


@pytest.mark.parametrize("difference", [0.3, 0.5, 1.0, 1.5, 2.0])
def test_every_plan_and_every_correction_is_one_that_the_driver_takes(difference: float) -> None:
    rng = np.random.default_rng(round(10 * difference))
    plans = planner(difference, rng)
    limiter = SafetyLimiter(DriverLimits(actuators=ACTUATORS, neighbour_difference=difference, pairs=PAIRS))
    low, high = plans.mirror.reachable_range(FocusTarget(0.0), 20e-9)
    state: HysteresisState = plans.law.demagnetised(ACTUATORS, 0.0)
    time, bound = 0.0, 0
    for curvature in rng.uniform(1.3 * low, 1.3 * high, 25):  # some of it beyond the range
        move = plans.plan(FocusTarget(float(curvature)), state, time, ahead=0.05)
        signals = limiter.check_shape(move.signals)
        bound += bool(plans.mirror.limits.at_limit(signals).any())
        state = plans.law.move(state, written(signals), time + 0.1)
        time += 0.1
        for pause, ahead in ((0.05, 0.02), (1.0, 0.5), (30.0, 0.0)):
            time += pause
            correction = limiter.check_shape(plans.hold(state, time, move.effective, ahead))
            state = plans.law.move(state, written(correction), time)
            reached = plans.law.effective(state)
        predicted = move.plan.max_zernike
        error = plans.mirror.predict(FocusTarget(float(curvature)), reached).max_zernike
        assert error <= 1.2 * predicted + 1e-9
    assert bound > 0 or difference == 2.0


def test_a_limit_that_binds_costs_no_more_than_it_must() -> None:
    """What the nearest legal shape leaves is far below what a part of the way would leave."""
    rng = np.random.default_rng(4)
    plans = planner(1.0, rng)
    _, high = plans.mirror.reachable_range(FocusTarget(0.0), 20e-9)
    state = plans.law.demagnetised(ACTUATORS, 0.0)
    for _ in range(6):
        state = plans.law.move(state, rng.uniform(-0.4, 0.4, ACTUATORS), state.time + 1.0)
    move = plans.plan(FocusTarget(0.97 * high), state, state.time + 1.0, ahead=0.05)
    assert move.plan.max_zernike < 40e-9
