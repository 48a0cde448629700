"""When the mirror moved between two maps: creep depends on it, and not every file tells it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_calibration.hysteresis.features import crept, follow, play_features
from dm_calibration.influence.maps import BEFORE_FIRST_MAP_S, MapSet
from dm_common.hysteresis.law_shape import worst_case_limits
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_common.limits import Limits
from dm_common.measurement import Measurement
from dm_common.optics.sampling import edge_clustered_points

RATE = 0.02
LAW = HysteresisModel(np.zeros(1), np.ones((1, 1)), np.zeros(0), 0.0, RATE, CREEP_TIMES)
SIGNALS = np.array([[0.5], [-0.5], [0.8], [0.8]])
TIME = np.array([1.0, 4.0, 9.0, 60.0])
MOVED = np.array([0.2, 3.5, 4.0, 9.0])


@pytest.mark.parametrize("moved", [None, MOVED])
def test_features_and_law_creep_alike(moved: np.ndarray | None) -> None:
    values = play_features(SIGNALS, np.zeros(1), 1)
    effective, _ = follow(LAW, LAW.demagnetised(1, 0.0), SIGNALS, TIME, moved)
    assert effective == pytest.approx((values + RATE * crept(values, TIME, 0.0, moved))[:, 0], abs=1e-12)


def test_a_later_move_has_crept_less() -> None:
    rested = LAW.demagnetised(1, 0.0)
    at_once = follow(LAW, rested, SIGNALS[:1], TIME[:1])[0]
    late = follow(LAW, rested, SIGNALS[:1], TIME[:1], np.array([0.9]))[0]
    # From 1 s to 0.1 s after a step of 0.5: one decade less.
    assert (at_once - late)[0, 0] == pytest.approx(RATE * 0.5, rel=0.2)


def test_maps_that_do_not_tell_count_from_the_map_before() -> None:
    points = edge_clustered_points(30)
    record = Measurement(
        points=points,
        sag=np.zeros(30),
        coefficients=np.zeros(21),
        sigma=np.zeros(21),
        stamp_ns=10**9,
        residual_rms=0.0,
        valid_fraction=1.0,
        signals=np.zeros(2),
        applied=np.zeros(2),
    )
    times = [
        (1, 0),
        (3, 2),
        (5, 0),
        (7, 1),
        (9, 10),
    ]  # s of map and move: known, not known, before the last map, after it
    records = [
        replace(record, label=str(k), stamp_ns=stamp * 10**9, moved_ns=moved * 10**9)
        for k, (stamp, moved) in enumerate(times)
    ]
    assert MapSet.of(records).moved_s() == pytest.approx([-BEFORE_FIRST_MAP_S, 1.0, 2.0, 4.0, 6.0])


def test_what_is_certainly_within_reach_leaves_room_for_hysteresis_and_creep() -> None:
    linear = worst_case_limits(HysteresisModel.linear(), Limits(-1.0, 0.5))
    assert (linear.low, linear.high) == pytest.approx((-1.0, 0.5))
    certain = worst_case_limits(LAW, Limits())
    low, high = certain.low, certain.high
    assert -1.0 < low < -0.85 and 0.85 < high < 1.0
    rng = np.random.default_rng(7)
    state = LAW.demagnetised(50, 0.0)
    for _ in range(20):
        state = LAW.move(state, rng.uniform(-1.0, 1.0, 50), state.time + 600.0)
    assert LAW.effective(LAW.move(state, np.ones(50), state.time)).min() > high - 0.01


def test_follow_is_step_by_step() -> None:
    law, rng = LAW, np.random.default_rng(1)
    signals, time = rng.uniform(-1.0, 1.0, (20, 3)), np.cumsum(rng.uniform(0.1, 5.0, 20))
    start = law.demagnetised(3, 0.0)
    effective, last = follow(law, start, signals, time)
    state = start
    for row, (shape, when) in enumerate(zip(signals, time, strict=True)):
        state = law.advance(law.move(state, shape, state.time), when)
        np.testing.assert_allclose(effective[row], law.effective(state), atol=1e-14)
    np.testing.assert_array_equal(last.crept, state.crept)


def test_follow_refuses_time_that_runs_backwards() -> None:
    with pytest.raises(ValueError, match=r"row 2 is 1\.000 s before"):
        follow(LAW, LAW.demagnetised(1, 0.0), np.zeros((3, 1)), np.array([0.0, 2.0, 1.0]))
