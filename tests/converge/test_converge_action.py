"""The action `converge` over DDS: a host node, and stand-ins for driver and interferometer around a known mirror."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from dm_msgs.action import Converge
from dm_msgs.msg import ErrorCode, FocusRequest

import converge_stand_in
from calibration_stand_in import StandIn
from converge_stand_in import Host
from dm_common.ros.executor import BackgroundExecutor
from dm_controller.planning.target import FocusTarget
from linear_mirror import RADIUS
from support import Observer


@pytest.fixture
def host(observer: Observer) -> Iterator[Host]:
    node = Host()
    background = BackgroundExecutor(node)
    yield node
    background.destroy_node()


@pytest.fixture
def bench(observer: Observer) -> StandIn:
    return converge_stand_in.bench(observer.node)


def goal(curvature: float = 0.02, **fields: Any) -> Converge.Goal:
    return Converge.Goal(request=FocusRequest(curvature=curvature), **fields)


def run(observer: Observer, wanted: Converge.Goal) -> tuple[int, Any]:
    ended = observer.run_goal(Converge, "converge", wanted, timeout_s=30.0)
    return ended.status, ended.result


def test_it_converges_and_tells_its_steps(observer: Observer, host: Host, bench: StandIn) -> None:
    feedback: list[Any] = []
    _, future = observer.send_goal(
        Converge, "converge", goal(tolerance=1e-9), lambda message: feedback.append(message.feedback)
    )
    deadline = time.monotonic() + 30
    while not future.done() and time.monotonic() < deadline:
        time.sleep(0.02)
    ended = future.result()
    assert ended.status == GoalStatus.STATUS_SUCCEEDED, ended.result.message
    result = ended.result
    assert result.error_code == ErrorCode.OK
    assert result.maps == len(bench.measured) >= 2
    assert result.max_zernike < 1e-9
    assert result.residual_rms > 0
    np.testing.assert_allclose(result.signals, bench.signals)
    true = bench.plant.fit_terms(bench.plant.sag(bench.signals)) - FocusTarget(0.02).coefficients(RADIUS)
    assert np.abs(true[3:]).max() == pytest.approx(result.max_zernike, rel=1e-6)
    assert [step.step for step in feedback] == list(range(1, result.maps + 1))
    assert feedback[0].max_zernike > feedback[-1].max_zernike
    assert {step.curvature for step in feedback} == {0.02}


def test_the_map_limit_ends_it_with_the_best_command(observer: Observer, host: Host, bench: StandIn) -> None:
    status, result = run(observer, goal(tolerance=1e-11, max_maps=2, method="pseudo_inverse"))
    assert status == GoalStatus.STATUS_ABORTED
    assert result.error_code == ErrorCode.NOT_CONVERGED
    assert result.maps == len(bench.measured) == 2
    assert "not within the tolerance" in result.message
    assert len(result.signals) == 37


def test_a_failed_map_is_tried_again_then_given_up(observer: Observer, host: Host, bench: StandIn) -> None:
    bench.failures = 1
    assert run(observer, goal())[1].error_code == ErrorCode.OK
    bench.failures = 2
    _, result = run(observer, goal(-0.02))
    assert result.error_code == ErrorCode.MAP_TIMEOUT
    assert "no new file" in result.message


def test_cancelling_leaves_the_last_command(observer: Observer, host: Host, bench: StandIn) -> None:
    bench.pause = 0.5
    handle, future = observer.send_goal(Converge, "converge", goal(tolerance=1e-11, max_maps=50))
    deadline = time.monotonic() + 15
    while not bench.measured and time.monotonic() < deadline:
        time.sleep(0.02)
    handle.cancel_goal_async()
    while not future.done() and time.monotonic() < deadline:
        time.sleep(0.02)
    ended = future.result()
    assert ended.status == GoalStatus.STATUS_CANCELED
    assert ended.result.error_code == ErrorCode.CANCELED
    assert "the mirror holds the last command" in ended.result.message
    assert ended.result.maps >= 1
    held = bench.signals.copy()
    time.sleep(1.0)
    np.testing.assert_array_equal(bench.signals, held)


@pytest.mark.parametrize(
    ("fields", "code", "words"),
    [
        ({"method": "SVD"}, ErrorCode.UNKNOWN_NAME, "method = 'SVD': unknown; must be one of pseudo_inverse"),
        ({"tolerance": -1.0}, ErrorCode.OUT_OF_RANGE, "tolerance = -1.0: must be float, 0 to 0.001 m"),
        ({"tolerance": float("nan")}, ErrorCode.NOT_FINITE, "tolerance = nan"),
        ({"max_maps": 1000}, ErrorCode.OUT_OF_RANGE, "max_maps = 1000: must be"),
        ({"curvature": 200.0}, ErrorCode.OUT_OF_RANGE, "must be below 1"),
    ],
)
def test_bad_goals_are_refused_and_nothing_moves(
    observer: Observer, host: Host, bench: StandIn, fields: dict[str, Any], code: int, words: str
) -> None:
    status, result = run(observer, goal(**fields))
    assert status == GoalStatus.STATUS_ABORTED
    assert result.error_code == code
    assert words in result.message
    assert not bench.measured
    assert not bench.signals.any()


def test_what_the_host_refuses_does_not_start(observer: Observer, host: Host, bench: StandIn) -> None:
    host.refuse = True
    _, result = run(observer, goal())
    assert (result.error_code, result.message) == (ErrorCode.STALE, "header.stamp: the request is 9 s old")
    host.refuse, host.calibration = False, None
    assert run(observer, goal())[1].error_code == ErrorCode.NOT_CALIBRATED
    assert not bench.measured
