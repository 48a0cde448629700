"""Node `focus_controller` before a mirror that remembers: what it knows of the state, and what it does about it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from dm_msgs.action import Degauss, MoveFocus
from dm_msgs.msg import ErrorCode, FocusRequest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter as RosParameter

from dm_common.errors import Refusal
from dm_common.hysteresis.creep_record import CreepRecord, write_record
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_common.state_files import state_file
from dm_controller.planning.active_calibration import active_calibration
from focus_bench import HysteresisBench, calibration_with_history, make_law, mirror_info, recipe, recipe_book
from support import NodeProcess, Observer, wait_until

Start = Callable[..., NodeProcess]
#: Long enough for the shape to be judged when it should be right.
SETTLE_S = 0.05
#: Without creep, which would go on while a busy machine takes its time.
STILL = make_law(0.0)


def make(
    observer: Observer,
    start: Start,
    message: Any = None,
    parameters: Mapping[str, Any] | None = None,
    law: HysteresisModel | None = None,
) -> HysteresisBench:
    """A controller with a calibration that knows the memory; nothing is known of the history yet."""
    bench = HysteresisBench(observer, law)
    values = {"settle_time": SETTLE_S, "hold.enable": False, **(parameters or {})}
    bench.controller = start("dm_controller", "focus_controller", values)
    bench.ready(message or calibration_with_history(bench.law))
    wait_until(lambda: bench.set_focus(dry_run=True).error_code == ErrorCode.OK)
    return bench


def degauss(bench: HysteresisBench) -> None:
    count = bench.degausses
    bench.observer.run_goal(Degauss, "degauss", Degauss.Goal())
    wait_until(lambda: bench.degausses > count and bench.set_focus(dry_run=True).state.history_known)


def set_parameter(bench: HysteresisBench, name: str, value: int) -> None:
    parameter = RosParameter(name, value=value).to_parameter_msg()
    request = SetParameters.Request(parameters=[parameter])
    response = bench.observer.call(SetParameters, "focus_controller/set_parameters", request)
    assert response.results[0].successful, response.results[0].reason


def shapes() -> tuple[np.ndarray, ...]:
    random = np.random.default_rng(4)
    return tuple(random.uniform(-0.9, 0.9, 37) for _ in range(6))


def test_unknown_history_is_told_and_cured_by_a_degauss(
    observer: Observer, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What was held before, the node finds on disk: nothing.
    monkeypatch.setenv("ROS_HOME", str(tmp_path))
    file = state_file("~/.ros/focus_controller", ".creep.npz", mirror_info().serial)
    assert file is not None
    write_record(file, CreepRecord(time.time() - 1.0, CREEP_TIMES, np.zeros((37, 15)), np.zeros(15), np.zeros((37, 0))))
    bench = make(observer, start, law=STILL)
    health: list[DiagnosticArray] = observer.record(DiagnosticArray, "/diagnostics")
    before = bench.set_focus(dry_run=True, curvature=0.02).state
    assert not before.history_known
    assert "degauss" in before.message
    wide = bench.capabilities[-1].error_bound
    wait_until(lambda: any("degauss" in status.message for array in health for status in array.status))
    degauss(bench)
    after = bench.set_focus(dry_run=True, curvature=0.02).state
    assert after.history_known and "degauss" not in after.message
    assert after.predicted_max_zernike_upper < 0.1 * before.predicted_max_zernike_upper
    wait_until(lambda: bench.capabilities[-1].error_bound < 0.1 * wide)
    assert after.predicted_rms_lower <= after.predicted_rms <= after.predicted_rms_upper < before.predicted_rms_upper
    health.clear()
    wait_until(lambda: any(s.level == DiagnosticStatus.OK for array in health for s in array.status))


def test_the_state_follows_what_others_command(observer: Observer, start: Start) -> None:
    bench = make(observer, start)
    degauss(bench)
    for shape in shapes():
        bench.command(shape)
    state = bench.set_focus(curvature=0.02).state
    assert state.history_known
    wait_until(lambda: list(bench.commands[-1].signals) == list(state.signals))
    assert bench.surface_error(0.02, age=SETTLE_S) < 2e-9
    # The same command from another history makes another surface.
    fresh = bench.law.demagnetised(37, bench.mirror.time)
    assert bench.surface_error(0.02, bench.law.move(fresh, np.array(state.signals), fresh.time), SETTLE_S) > 10e-9


def test_planning_leaves_no_trace(observer: Observer, start: Start) -> None:
    bench = make(observer, start, law=STILL)
    degauss(bench)
    first = bench.set_focus(dry_run=True, curvature=0.02).state
    for curvature in (-0.03, 0.04):
        bench.set_focus(dry_run=True, curvature=curvature)
    again = bench.set_focus(dry_run=True, curvature=0.02).state
    np.testing.assert_allclose(again.signals, first.signals, atol=1e-4)


def test_a_restarted_controller_knows_no_history(observer: Observer, start: Start) -> None:
    bench = make(observer, start)
    degauss(bench)
    assert bench.controller is not None
    bench.controller.stop()
    bench.capabilities.clear()
    start("dm_controller", "focus_controller", {})
    wait_until(lambda: bench.capabilities and bench.capabilities[-1].calibration_id == "known")
    bench.command(shapes()[0])
    state = wait_until(lambda: (r := bench.set_focus(dry_run=True)).error_code == ErrorCode.OK and r.state)
    assert not state.history_known


@pytest.mark.parametrize("other_law", [False, True])
def test_the_history_stays_known_under_a_new_calibration(observer: Observer, start: Start, other_law: bool) -> None:
    bench = make(observer, start)
    degauss(bench)
    law = make_law(creep_rate=0.02) if other_law else bench.law
    bench.calibration.publish(calibration_with_history(law, id="newer", revision=3))
    wait_until(lambda: bench.capabilities[-1].calibration_id == "newer")
    assert bench.set_focus(dry_run=True).state.history_known


def test_writes_that_were_lost_make_the_history_unknown(observer: Observer, start: Start) -> None:
    bench = make(observer, start)
    degauss(bench)
    bench.turns += 5
    bench.command(shapes()[0])
    state = wait_until(lambda: (s := bench.set_focus(dry_run=True).state) and not s.history_known and s)
    assert "turns were not seen" in state.message


def holding(observer: Observer, start: Start) -> HysteresisBench:
    """A degaussed mirror with much creep, whose shape is corrected often."""
    law = make_law(0.05)
    parameters = {"hold.enable": True, "hold.period": 0.05}
    bench = make(observer, start, calibration_with_history(law), parameters, law)
    degauss(bench)
    return bench


def test_a_held_shape_is_corrected_for_creep(observer: Observer, start: Start) -> None:
    bench = holding(observer, start)
    assert bench.set_focus(curvature=0.03).state.creep_held
    wait_until(lambda: len(bench.commands) > 6)
    asked, *corrected = [command.expected_turns for command in bench.commands[:7]]
    assert asked == 0
    assert corrected == list(range(corrected[0], corrected[0] + 6))  # each counts only for the shape before it
    assert bench.surface_error(0.03) < 0.05 * bench.surface_error(0.03, bench.reached[0])
    assert bench.surface_error(0.03) < 2e-9


def test_a_hold_ends_with_the_command_of_another_publisher(observer: Observer, start: Start) -> None:
    bench = holding(observer, start)
    bench.set_focus(curvature=0.03)
    wait_until(lambda: len(bench.commands) > 2)
    shape = shapes()[1]
    bench.command(shape)
    wait_until(lambda: list(bench.commands[-1].signals) == list(shape))
    bench.commands.clear()
    threading.Event().wait(1.0)
    assert bench.commands == []


def test_auto_conditions_within_the_time_budget_only(observer: Observer, start: Start) -> None:
    bench = make(observer, start)
    needed = bench.capabilities[-1].condition_time
    assert needed > 0.5
    hasty = bench.set_focus(curvature=0.01, time_budget=0.5 * needed).state
    assert hasty.applied
    assert not hasty.history_known
    patient = bench.set_focus(curvature=0.02, time_budget=2.0 * needed).state
    assert patient.error_code == ErrorCode.OK
    assert not patient.applied
    assert needed < patient.predicted_duration < 2.0 * needed
    done = wait_until(lambda: (s := bench.focus_states[-1]).applied and s.curvature == 0.02 and s)
    assert done.history_known
    assert done.mode == FocusRequest.MODE_DIRECT
    assert bench.begun == [0]
    # The time that it took is what is told from now on.
    wait_until(lambda: bench.capabilities[-1].condition_time == pytest.approx(0.2))
    at_once = bench.set_focus(curvature=0.03, time_budget=60.0).state
    assert at_once.applied
    assert bench.begun == [0]


def test_a_recipe_follows_the_degauss_it_was_built_with(observer: Observer, start: Start) -> None:
    message = calibration_with_history(STILL)
    tilt = active_calibration(message, mirror_info()).mirror.tilt
    assert tilt is not None
    effective = np.random.default_rng(6).uniform(-0.5, 0.5, (2, 37))
    effective -= effective @ np.linalg.pinv(tilt) @ tilt  # which every recipe has as it is wanted
    ends = [recipe(curvature, each) for curvature, each in zip((-0.02, 0.02), effective, strict=True)]
    bench = make(observer, start, message, law=STILL)
    bench.recipes.publish(recipe_book(*ends))
    wait_until(lambda: bench.capabilities[-1].error_bound_conditioned > 0.0)
    bench.command(shapes()[0])
    state = bench.set_focus(curvature=0.02, mode=FocusRequest.MODE_CONDITIONED).state
    assert state.error_code == ErrorCode.OK
    done = wait_until(lambda: (s := bench.focus_states[-1]).applied and s)
    assert done.mode == FocusRequest.MODE_CONDITIONED
    assert bench.begun == [60]
    wait_until(lambda: list(bench.commands[-1].signals) == list(done.signals))
    reached = bench.law.effective(bench.law.advance(bench.mirror, bench.mirror.time + SETTLE_S))
    assert np.abs(reached - ends[1].effective).max() < 5e-4


def test_recipes_are_not_used_outside_their_range_or_condition(observer: Observer, start: Start) -> None:
    bench = make(observer, start, parameters={"condition.degauss_steps": 40})
    bench.recipes.publish(recipe_book(*(recipe(curvature, np.zeros(37)) for curvature in (-0.02, 0.02))))
    wait_until(lambda: bench.capabilities[-1].error_bound_conditioned > 0.0)
    other = bench.set_focus(curvature=0.01, mode=FocusRequest.MODE_CONDITIONED)
    assert other.error_code == ErrorCode.CALIBRATION_MISMATCH
    assert "60 half-swings" in other.message
    set_parameter(bench, "condition.degauss_steps", 60)
    outside = bench.set_focus(curvature=0.03, mode=FocusRequest.MODE_CONDITIONED)
    assert outside.error_code == ErrorCode.OUT_OF_RANGE
    assert "+0.0200" in outside.message
    assert bench.commands == []
    assert bench.begun == []


def conditioning(bench: HysteresisBench) -> None:
    """A degauss has begun on request, and goes on until the test lets it end."""
    bench.degauss_may_end.clear()
    assert bench.set_focus(curvature=0.01, time_budget=60.0).error_code == ErrorCode.OK
    wait_until(lambda: bench.begun)


def test_the_newest_request_follows_a_degauss(observer: Observer, start: Start) -> None:
    bench = make(observer, start)
    conditioning(bench)
    for curvature in (0.02, 0.03):
        waiting = bench.set_focus(curvature=curvature, mode=FocusRequest.MODE_DIRECT).state
        assert not waiting.applied
        assert "degaussed first" in waiting.message
    refused = bench.set_focus(curvature=9.0)
    assert refused.error_code == ErrorCode.UNREACHABLE
    bench.degauss_may_end.set()
    done = wait_until(lambda: (s := bench.focus_states[-1]).applied and s)
    assert done.curvature == 0.03
    assert done.history_known
    assert bench.begun == [0]
    wait_until(lambda: len(bench.commands) == 1)


def test_cancel_during_conditioning_leaves_the_mirror_degaussed(observer: Observer, start: Start) -> None:
    bench = make(observer, start)
    bench.degauss_may_end.clear()
    goal = MoveFocus.Goal(request=FocusRequest(curvature=0.01, time_budget=60.0))
    handle, result = observer.send_goal(MoveFocus, "move_focus", goal)
    wait_until(lambda: bench.begun)
    handle.cancel_goal_async()
    wait_until(result.done)
    assert result.result().status == GoalStatus.STATUS_CANCELED
    assert result.result().result.error_code == ErrorCode.CANCELED
    bench.degauss_may_end.set()
    wait_until(lambda: bench.set_focus(dry_run=True).state.history_known)
    assert bench.commands == []


def test_move_focus_waits_for_conditioning(observer: Observer, start: Start) -> None:
    bench = make(observer, start)
    goal = MoveFocus.Goal(request=FocusRequest(curvature=0.01, time_budget=60.0))
    result = observer.run_goal(MoveFocus, "move_focus", goal)
    assert result.status == GoalStatus.STATUS_SUCCEEDED
    assert result.result.state.history_known
    assert bench.surface_error(0.01, age=SETTLE_S) < 2e-9
    assert bench.begun == [0]


def test_a_stale_calibration_says_so_and_serves(observer: Observer, start: Start) -> None:
    old = calibration_with_history(make_law())
    old.header.stamp = Time(sec=1)
    bench = make(observer, start, old)
    state = bench.set_focus(curvature=0.01).state
    assert state.applied
    assert "stale" in state.message
    assert "stale" in bench.capabilities[-1].message
    bench.calibration.publish(
        calibration_with_history(make_law(), id="checked", checked=observer.node.get_clock().now().to_msg())
    )
    wait_until(lambda: bench.capabilities[-1].calibration_id == "checked")
    assert "stale" not in bench.set_focus(curvature=0.01).message


def broken(**fields: Any) -> Any:
    message = calibration_with_history(make_law(), id="broken")
    for name, value in fields.items():
        setattr(message.hysteresis, name, value)
    return message


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (broken(play_weight=[1.0, 0.2]), "play_weight"),
        (broken(play_weight=[-0.8, 0.1, 0.1]), "play_weight"),
        (broken(play_weight=[float("nan"), 0.1, 0.1]), "play_weight"),
        (broken(play_weight=[8.0, 1.0, 1.0]), "another scale"),
        (broken(creep_rate=3.0), "creep_rate"),
        (broken(unknown_sigma=-1.0), "unknown_sigma"),
    ],
)
def test_a_hysteresis_that_makes_no_sense_is_refused(message: Any, field: str) -> None:
    with pytest.raises(Refusal) as refused:
        active_calibration(message, mirror_info())
    assert refused.value.error_code == ErrorCode.CALIBRATION_UNREADABLE
    assert field in str(refused.value)


def test_recipes_count_for_their_calibration_only() -> None:
    other = recipe_book(recipe(0.0, np.zeros(19)))
    with pytest.raises(Refusal, match="recipes: effective must have 37 values each"):
        active_calibration(calibration_with_history(make_law()), mirror_info(), recipes=other)
    newer = active_calibration(calibration_with_history(make_law(), id="newer"), mirror_info(), recipes=other)
    assert newer.recipes.recipes == ()


def test_nothing_moves_on_a_calibration_that_makes_no_sense(observer: Observer, start: Start) -> None:
    bench = make(observer, start)
    bench.calibration.publish(broken(creep_rate=3.0))
    refused = wait_until(
        lambda: (r := bench.set_focus(curvature=0.01)).error_code == ErrorCode.CALIBRATION_UNREADABLE and r
    )
    assert "creep_rate = 3" in refused.message
