"""Every limit at its edge: at it is legal, beyond it is refused, whatever the other values are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dm_common.errors import ErrorCode, Refusal
from dm_driver.safety_limiter import SLACK, DriverLimits, SafetyLimiter

RING = np.arange(7)
BEYOND = 2 * SLACK

floats = st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=True)


def limiter(**limits: float) -> SafetyLimiter:
    """Seven actuators in a ring."""
    return SafetyLimiter(DriverLimits(actuators=7, pairs=np.column_stack((RING, np.roll(RING, 1))), **limits))


def reason(action: object, *arguments: object) -> int:
    with pytest.raises(Refusal) as caught:
        action(*arguments)  # type: ignore[operator]
    return ErrorCode(caught.value.error_code)


@given(low=st.floats(-1.0, -0.01), high=st.floats(0.01, 1.0), actuator=st.integers(0, 6))
def test_range(low: float, high: float, actuator: int) -> None:
    judge = limiter(low=low, high=high, neighbour_difference=2.0)
    for edge, outwards in ((low, -1.0), (high, 1.0)):
        signals = np.zeros(7)
        signals[actuator] = edge
        assert judge.check_shape(signals)[actuator] == edge
        signals[actuator] = edge + outwards * BEYOND
        assert reason(judge.check_shape, signals) is ErrorCode.OUT_OF_RANGE


@given(most=st.floats(0.001, 0.99), actuator=st.integers(0, 6), side=st.sampled_from((-1.0, 1.0)))
def test_neighbour_difference(most: float, actuator: int, side: float) -> None:
    judge = limiter(neighbour_difference=most)
    signals = np.zeros(7)
    signals[actuator] = side * most
    judge.check_shape(signals)
    signals[actuator] = side * (most + BEYOND)
    assert reason(judge.check_shape, signals) is ErrorCode.NEIGHBOUR_DIFFERENCE


@given(age=st.floats(1e-3, 1e6), lead=st.floats(1e-3, 1e6))
def test_age_and_lead(age: float, lead: float) -> None:
    judge = limiter(command_age=age, command_lead=lead)
    judge.check_age(age)
    judge.check_age(-lead)
    assert reason(judge.check_age, float(np.nextafter(age, np.inf))) is ErrorCode.STALE
    assert reason(judge.check_age, float(np.nextafter(-lead, -np.inf))) is ErrorCode.STALE
    assert reason(judge.check_age, float("nan")) is ErrorCode.STALE


@given(step=st.floats(1e-3, 0.5), actuator=st.integers(0, 6), side=st.sampled_from((-1.0, 1.0)))
def test_step_of_one_write(step: float, actuator: int, side: float) -> None:
    judge = limiter(step=step)
    signals = np.zeros(7)
    signals[actuator] = side * step
    judge.check_write(np.zeros(7), signals)
    signals[actuator] = side * (step + BEYOND)
    assert reason(judge.check_write, np.zeros(7), signals) is ErrorCode.INTERNAL


@pytest.mark.parametrize("beyond", [0.0, 5e-12, 5e-11, SLACK])
@pytest.mark.parametrize("steps", [1, 2, 19])
def test_every_step_of_a_way_may_be_written(steps: int, beyond: float) -> None:
    judge, reached = limiter(step=0.1), np.full(7, -1.0)
    for shape in judge.ramp(reached, np.full(7, -1.0 + 0.1 * steps + beyond)):
        judge.check_write(reached, shape)
        reached = shape


@given(signals=st.lists(floats, max_size=60))
def test_whatever_arrives_is_legal_or_refused(signals: list[float]) -> None:
    judge = limiter()
    try:
        shape = judge.check_shape(signals)
    except Refusal:
        return
    assert shape.shape == (7,)
    assert (np.abs(shape) <= 1.0).all()
    assert (np.abs(shape - np.roll(shape, 1)) <= 1.0 + SLACK).all()
