"""Node `focus_controller` as a process over DDS; the test plays driver and calibration with an exactly known mirror."""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from dm_msgs.action import MoveFocus
from dm_msgs.msg import (
    ActuatorEstimate,
    ActuatorState,
    Capabilities,
    ErrorCode,
    FocusRequest,
)
from dm_msgs.srv import Flatten, SetFocus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.time import Time

from dm_common.optics.conic import range_text
from dm_common.ros import qos
from focus_bench import MIRROR, Bench, calibration, mirror_info
from linear_mirror import RADIUS
from support import NodeProcess, Observer, wait_until


@pytest.fixture
def bench(observer: Observer, start: Callable[..., NodeProcess]) -> Iterator[Bench]:
    made = Bench(observer)
    start("dm_controller", "focus_controller", {})
    yield made


def test_a_curvature_becomes_the_right_command(bench: Bench) -> None:
    bench.ready()
    response = wait_until(lambda: (r := bench.set_focus(curvature=0.02)).error_code == ErrorCode.OK and r)
    state = response.state
    wait_until(lambda: bench.commands)
    signals = np.asarray(bench.commands[-1].signals)
    np.testing.assert_array_equal(signals, np.asarray(state.signals))
    radius = RADIUS * np.hypot(MIRROR.points.x, MIRROR.points.y)
    error = MIRROR.fit_terms(MIRROR.sag(signals) - 0.02 * radius**2 / 2)
    assert np.abs(error[3:]).max() < 1e-10
    assert state.applied
    assert state.power == pytest.approx(0.04)
    assert state.calibration_id == "known"
    assert state.curvature_min < 0.02 < state.curvature_max
    assert state.predicted_rms < state.predicted_rms_upper
    assert state.history_known
    late = bench.observer.record(ActuatorEstimate, "actuator_estimate", qos.LATCHED)
    estimate = wait_until(lambda: late and late[-1])
    assert (estimate.calibration_id, estimate.history_known) == ("known", True)
    np.testing.assert_array_equal(np.asarray(estimate.effective), signals)


def test_topic_requests_are_answered_on_focus_state(bench: Bench) -> None:
    bench.ready()
    wait_until(lambda: bench.request.get_subscription_count() > 0)
    request = FocusRequest(curvature=-0.01)
    request.header.stamp = bench.observer.node.get_clock().now().to_msg()
    bench.request.publish(request)
    state = wait_until(lambda: bench.focus_states and bench.focus_states[-1])
    assert (state.error_code, state.request_stamp) == (ErrorCode.OK, request.header.stamp)
    command = wait_until(lambda: bench.commands and bench.commands[-1])
    assert state.header.stamp == command.header.stamp


def test_dry_run_and_refusals_move_nothing(bench: Bench) -> None:
    bench.ready()
    preview = bench.set_focus(dry_run=True, curvature=0.01)
    assert preview.error_code == ErrorCode.OK
    assert not preview.state.applied
    far = bench.set_focus(curvature=1.0)
    assert far.error_code == ErrorCode.UNREACHABLE
    assert range_text(far.state.curvature_min, far.state.curvature_max, "1/m") in far.message
    assert "curvature = +1.0000" in far.message
    not_a_number = bench.set_focus(curvature=float("nan"))
    assert not_a_number.error_code == ErrorCode.NOT_FINITE
    assert math.isnan(not_a_number.state.predicted_rms) and math.isnan(not_a_number.state.curvature_max)
    assert "curvature = nan" in not_a_number.message
    two_terms = bench.set_focus(curvature=0.0, zernike=[1e-9, 2e-9])
    assert two_terms.error_code == ErrorCode.INVALID_LENGTH
    terms = [0.0] * 4 + [1e-9] + [0.0] * 16
    assert list(bench.set_focus(curvature=0.0, zernike=terms, dry_run=True).state.zernike) == terms
    recipe = bench.set_focus(curvature=0.0, mode=FocusRequest.MODE_CONDITIONED)
    assert recipe.error_code == ErrorCode.NOT_SUPPORTED
    assert bench.set_focus(curvature=0.0, mode="77").error_code == ErrorCode.UNKNOWN_NAME
    old = FocusRequest(curvature=0.01)
    old.header.stamp = Time(seconds=1000).to_msg()
    stale = bench.observer.call(SetFocus, "set_focus", SetFocus.Request(request=old))
    assert (stale.error_code, stale.state.request_stamp) == (ErrorCode.STALE, old.header.stamp)
    assert bench.commands == []


def test_requests_without_calibration_driver_or_activation_are_refused(bench: Bench) -> None:
    assert bench.set_focus(curvature=0.01).error_code == ErrorCode.NOT_CALIBRATED
    bench.calibration.publish(calibration())
    wait_until(lambda: bench.set_focus(curvature=0.01).error_code == ErrorCode.DRIVER_UNAVAILABLE)
    bench.info.publish(mirror_info())
    wait_until(lambda: bench.capabilities[-1].calibration_id == "known")
    assert bench.set_focus(curvature=0.01).error_code == ErrorCode.DRIVER_UNAVAILABLE
    bench.publish_state([], ActuatorState.STATE_INACTIVE)
    wait_until(lambda: bench.set_focus(curvature=0.01).error_code == ErrorCode.DRIVER_INACTIVE)
    assert bench.commands == []


@pytest.mark.parametrize(
    ("wrong", "words"),
    [(calibration(serial="other"), "mirror serial 'other'"), (calibration(radius=0.0085), "radius 8.500 mm")],
)
def test_a_calibration_of_another_mirror_or_aperture_is_refused(bench: Bench, wrong: Any, words: str) -> None:
    bench.info.publish(mirror_info())
    bench.calibration.publish(wrong)
    bench.activate()
    response = wait_until(
        lambda: (r := bench.set_focus(curvature=0.01)).error_code == ErrorCode.CALIBRATION_MISMATCH and r
    )
    assert words in response.message
    assert bench.capabilities[-1].quality == Capabilities.UNCALIBRATED
    assert bench.commands == []


def test_capabilities_tell_range_in_curvature_and_dioptre(bench: Bench) -> None:
    bench.ready()
    wait_until(lambda: bench.capabilities[-1].quality == Capabilities.CALIBRATED, what="a driver that takes commands")
    message = bench.capabilities[-1]
    assert message.power_max == pytest.approx(2 * message.curvature_max)
    assert message.error_bound == pytest.approx(3e-10)
    assert "dioptre" in message.message
    assert message.settling == pytest.approx(2.0 / 40.0)


def test_flatten_removes_the_initial_figure(bench: Bench) -> None:
    bench.ready()
    response = wait_until(lambda: (r := bench.observer.call(Flatten, "flatten")).error_code == 0 and r)
    flat = MIRROR.fit_terms(MIRROR.sag(np.asarray(response.state.signals)))
    assert np.abs(flat[3:]).max() < 1e-10
    assert np.abs(MIRROR.figure_coefficients[3:]).max() > 1e-8


def test_move_focus_reports_when_the_shape_stands(bench: Bench) -> None:
    bench.ready()
    goal = MoveFocus.Goal(request=FocusRequest(curvature=0.015), settle_time=0.1)
    result = bench.observer.run_goal(MoveFocus, "move_focus", goal)
    assert result.status == GoalStatus.STATUS_SUCCEEDED
    assert result.result.error_code == ErrorCode.OK
    assert result.result.state.applied
    assert result.result.duration >= 0.1


def test_move_focus_refuses_a_tolerance_it_cannot_keep(bench: Bench) -> None:
    bench.ready()
    preview = bench.set_focus(dry_run=True, curvature=0.02)
    goal = MoveFocus.Goal(
        request=FocusRequest(curvature=0.02), tolerance=max(preview.state.predicted_max_zernike / 2, 1e-18)
    )
    result = bench.observer.run_goal(MoveFocus, "move_focus", goal)
    assert result.status == GoalStatus.STATUS_ABORTED
    assert result.result.error_code == ErrorCode.OUT_OF_RANGE
    assert bench.commands == []


def test_a_refused_goal_says_so_in_its_state_too(bench: Bench) -> None:
    bench.ready()
    goal = MoveFocus.Goal(request=FocusRequest(curvature=0.02), settle_time=-1.0)
    result = bench.observer.run_goal(MoveFocus, "move_focus", goal).result
    assert result.error_code == result.state.error_code == ErrorCode.OUT_OF_RANGE
    assert result.message == result.state.message and "settle_time = -1" in result.message


def test_cancel_holds_the_shape_reached_and_the_newest_goal_preempts(bench: Bench) -> None:
    bench.follow = False  # the driver never gets there: the move lasts until it is told to stop
    bench.ready()
    half_way = [0.1] * 37
    handle, result = bench.observer.send_goal(
        MoveFocus, "move_focus", MoveFocus.Goal(request=FocusRequest(curvature=0.01))
    )
    wait_until(lambda: len(bench.commands) == 1)
    bench.publish_state(half_way)
    threading.Event().wait(0.1)
    handle.cancel_goal_async()
    wait_until(result.done)
    assert result.result().status == GoalStatus.STATUS_CANCELED
    assert result.result().result.error_code == ErrorCode.CANCELED
    wait_until(lambda: len(bench.commands) == 2)
    assert list(bench.commands[-1].signals) == half_way

    _, first = bench.observer.send_goal(MoveFocus, "move_focus", MoveFocus.Goal(request=FocusRequest(curvature=0.01)))
    wait_until(lambda: len(bench.commands) == 3)
    bench.follow = True
    _, second = bench.observer.send_goal(MoveFocus, "move_focus", MoveFocus.Goal(request=FocusRequest(curvature=0.02)))
    wait_until(first.done)
    assert first.result().result.error_code == ErrorCode.PREEMPTED
    wait_until(second.done)
    assert second.result().result.error_code == ErrorCode.OK


def test_a_goal_that_is_refused_does_not_end_the_one_that_runs(bench: Bench) -> None:
    bench.follow = False
    bench.ready()
    _, running = bench.observer.send_goal(MoveFocus, "move_focus", MoveFocus.Goal(request=FocusRequest(curvature=0.01)))
    wait_until(lambda: len(bench.commands) == 1)
    for wrong, code in ((0.5, ErrorCode.UNREACHABLE), (math.nan, ErrorCode.NOT_FINITE)):
        goal = MoveFocus.Goal(request=FocusRequest(curvature=wrong))
        refused = bench.observer.run_goal(MoveFocus, "move_focus", goal).result
        assert refused.error_code == refused.state.error_code == code and not running.done(), refused.message
    bench.publish_state(list(bench.commands[-1].signals))
    wait_until(running.done)
    assert running.result().result.error_code == ErrorCode.OK, running.result().result.message


def test_a_shape_that_is_overtaken_while_it_settles_is_not_waited_for(bench: Bench) -> None:
    bench.ready()
    goal = MoveFocus.Goal(request=FocusRequest(curvature=0.01), settle_time=3600.0)
    _, result = bench.observer.send_goal(MoveFocus, "move_focus", goal)
    wait_until(lambda: bench.focus_states and bench.focus_states[-1].applied)
    bench.request.publish(FocusRequest(curvature=0.02))
    wait_until(result.done)
    assert result.result().result.error_code == ErrorCode.PREEMPTED


def test_a_call_that_waits_for_the_driver_keeps_no_other_waiting(bench: Bench) -> None:
    bench.follow = False
    bench.ready()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(bench.set_focus, curvature=0.01)
        wait_until(lambda: len(bench.commands) == 1)
        assert bench.set_focus(curvature=0.02, dry_run=True).error_code == ErrorCode.OK
        assert not waiting.done()
        assert waiting.result(60.0).error_code == ErrorCode.TIMEOUT


def test_deactivated_in_a_move_it_holds_the_shape_reached_and_refuses_until_it_is_active_again(bench: Bench) -> None:
    def change(transition: int, possible: bool = True) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        assert bench.observer.call(ChangeState, "focus_controller/change_state", request).success == possible

    bench.follow = False
    bench.ready()
    _, result = bench.observer.send_goal(MoveFocus, "move_focus", MoveFocus.Goal(request=FocusRequest(curvature=0.01)))
    wait_until(lambda: len(bench.commands) == 1)
    half_way = [0.1] * 37
    bench.publish_state(half_way)
    threading.Event().wait(0.1)
    change(Transition.TRANSITION_DEACTIVATE)
    wait_until(result.done)
    assert result.result().result.error_code == ErrorCode.CANCELED
    wait_until(lambda: len(bench.commands) == 2)
    assert list(bench.commands[-1].signals) == half_way
    wait_until(lambda: bench.capabilities[-1].error_code == ErrorCode.NODE_INACTIVE)
    refused = bench.set_focus(curvature=0.01)
    assert refused.error_code == ErrorCode.NODE_INACTIVE and math.isnan(refused.state.curvature_max)
    wait_until(lambda: bench.request.get_subscription_count() > 0)
    bench.request.publish(FocusRequest(curvature=0.01))
    wait_until(lambda: bench.focus_states and bench.focus_states[-1].error_code == ErrorCode.NODE_INACTIVE)
    assert len(bench.commands) == 2
    change(Transition.TRANSITION_ACTIVATE)
    change(Transition.TRANSITION_CONFIGURE, possible=False)
    bench.follow = True
    wait_until(lambda: bench.set_focus(curvature=0.01).error_code == ErrorCode.OK)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_goal_is_answered_when_the_process_ends(
    observer: Observer, start: Callable[..., NodeProcess], number: int
) -> None:
    bench, controller = Bench(observer, follow=False), start("dm_controller", "focus_controller", {})
    bench.ready()
    _, result = observer.send_goal(MoveFocus, "move_focus", MoveFocus.Goal(request=FocusRequest(curvature=0.01)))
    wait_until(lambda: len(bench.commands) == 1)
    assert controller.stop(number) == 0
    wait_until(result.done)
    assert result.result().result.error_code == ErrorCode.CANCELED
    wait_until(lambda: bench.capabilities[-1].error_code == ErrorCode.NODE_INACTIVE)
    assert "Traceback" not in controller.output


def test_move_is_aborted_when_the_driver_loses_its_electronics(bench: Bench) -> None:
    bench.follow = False
    bench.ready()
    _, result = bench.observer.send_goal(MoveFocus, "move_focus", MoveFocus.Goal(request=FocusRequest(curvature=0.01)))
    wait_until(lambda: bench.commands)
    bench.publish_state([0.0] * 37, ActuatorState.STATE_LINK_LOST)
    wait_until(result.done)
    assert result.result().result.error_code == ErrorCode.ELECTRONICS_UNREACHABLE


def test_a_newer_request_ends_a_goal_that_is_under_way(bench: Bench) -> None:
    bench.follow = False
    bench.ready()
    handle, result = bench.observer.send_goal(
        MoveFocus, "move_focus", MoveFocus.Goal(request=FocusRequest(curvature=0.01))
    )
    wait_until(lambda: len(bench.commands) == 1)
    bench.request.publish(FocusRequest(curvature=0.02))
    wait_until(lambda: len(bench.commands) == 2)
    handle.cancel_goal_async()  # comes too late to stop anything
    wait_until(result.done)
    assert result.result().result.error_code in (ErrorCode.PREEMPTED, ErrorCode.CANCELED)
    threading.Event().wait(0.2)
    assert len(bench.commands) == 2 and bench.commands[0].signals != bench.commands[1].signals


def test_a_command_that_the_driver_does_not_take_is_told_of(bench: Bench) -> None:
    bench.follow = False
    bench.ready()
    answer = bench.set_focus(curvature=0.01)
    told = wait_until(lambda: [s for s in bench.focus_states if s.error_code != ErrorCode.OK], 60)[0]
    assert told.curvature == 0.01 and not (told.applied or answer.state.applied)
    assert told.error_code == answer.error_code == ErrorCode.TIMEOUT
    assert "has not confirmed the command: it holds the earlier shape" in told.message


def test_requests_are_refused_when_the_driver_falls_silent(bench: Bench) -> None:
    bench.ready()
    bench.fall_silent()
    wait_until(lambda: bench.set_focus(dry_run=False).error_code != ErrorCode.OK, 60)
    refused = bench.set_focus(curvature=0.01)
    assert refused.error_code == ErrorCode.DRIVER_UNAVAILABLE
    assert "has not reported for" in refused.message
    bench.follow = True
    bench.activate()
    wait_until(lambda: bench.set_focus(curvature=0.01).error_code == ErrorCode.OK)
