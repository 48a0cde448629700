"""The actions `converge` and `build_recipes` over DDS: a host node, and stand-ins for driver, interferometer and store.

The mirror is known exactly, and is not as calibrated.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from dm_msgs.action import BuildRecipes, Converge
from dm_msgs.msg import ErrorCode, FocusRequest
from dm_msgs.srv import StoreRecipes
from rclpy.node import Node
from rclpy.parameter import Parameter

from calibration_stand_in import StandIn
from dm_common.errors import Refusal
from dm_common.messages import recipe_book_from
from dm_common.ros.executor import BackgroundExecutor
from dm_common.ros.parameters import declare
from dm_common.ros.worker import WorkerService
from dm_controller.focus_controller import FocusController
from dm_controller.focus_parameters import PARAMETERS
from dm_controller.focus_types import Moment, Order
from dm_controller.loop_actions import serve_loops
from dm_controller.planning.target import FocusTarget
from focus_bench import calibration, calibration_with_history, make_law, mirror_info
from linear_mirror import RADIUS, LinearMirror, hexagon, make_mirror
from support import Observer, wait_until

#: The mirror answers more weakly than its calibration says.
GAIN = 0.85
ACTIONS = {Converge.Goal: (Converge, "converge"), BuildRecipes.Goal: (BuildRecipes, "build_recipes")}


class Host(Node):
    """What hosts the actions: the focus controller, which no driver reports to."""

    def __init__(self) -> None:
        super().__init__("loop_host")
        values = declare(self, PARAMETERS)
        self.focus, self.now = FocusController(values), Moment(0, 0.0, 0.0)
        self.focus.use(calibration(held_out_rms=1e-10, held_out_max_zernike=1e-10), mirror_info())
        serve_loops(cast(Any, self), values)

    def order(self, wanted: FocusRequest, dry_run: bool) -> Order:
        return self.focus.request(wanted, self.now, dry_run)[0]

    def controller(self) -> AbstractContextManager[tuple[FocusController, Moment]]:
        return nullcontext((self.focus, self.now))


class Rig:
    """The host, and driver, interferometer and the service `store_recipes` on the observer's node."""

    def __init__(self, observer: Observer, host: Host) -> None:
        self._observer, self.host = observer, host
        self.bench = StandIn(observer.node, make_mirror(), LinearMirror(*hexagon(), gains=np.full(37, GAIN)))
        self.stored: list[Any] = []
        self.store_answer = (ErrorCode.OK, "")
        WorkerService(observer.node, StoreRecipes, "store_recipes", self._on_store)

    def _on_store(self, request: Any, response: Any) -> Any:
        self.stored.append(request)
        response.error_code, response.message = self.store_answer
        return response

    def send(self, goal: Any, feedback: list[Any] | None = None) -> tuple[Any, Any]:
        """Send a goal; returns its handle, and the future of what it ends with."""
        seen = [] if feedback is None else feedback
        return self._observer.send_goal(*ACTIONS[type(goal)], goal, lambda message: seen.append(message.feedback))

    def run(self, goal: Any, feedback: list[Any] | None = None) -> tuple[int, Any]:
        """Status and result of a goal."""
        _, future = self.send(goal, feedback)
        ended = wait_until(lambda: future.done() and future.result(), 60)
        return ended.status, ended.result

    def run_cancelled(self, goal: Any, maps: int) -> Any:
        """The result of a goal that is cancelled after so many maps."""
        handle, future = self.send(goal)
        wait_until(lambda: len(self.bench.measured) >= maps, 60)
        self.bench.pause = 0.3
        handle.cancel_goal_async()
        ended = wait_until(lambda: future.done() and future.result(), 60)
        assert ended.status == GoalStatus.STATUS_CANCELED
        assert ended.result.error_code == ErrorCode.CANCELED
        return ended.result


@pytest.fixture
def rig(observer: Observer) -> Iterator[Rig]:
    host = Host()
    background = BackgroundExecutor(host)
    yield Rig(observer, host)
    background.destroy_node()


def converge(curvature: float = 0.02, **fields: Any) -> Converge.Goal:
    return Converge.Goal(request=FocusRequest(curvature=curvature), **fields)


def recipes(*curvatures: float, max_maps: int = 4, **fields: Any) -> BuildRecipes.Goal:
    return BuildRecipes.Goal(curvatures=list(curvatures), max_maps=max_maps, **fields)


@pytest.mark.parametrize(
    ("goal", "code", "words"),
    [
        (converge(method="SVD"), ErrorCode.UNKNOWN_NAME, "method = 'SVD': unknown; must be one of pseudo_inverse"),
        (converge(tolerance=-1.0), ErrorCode.OUT_OF_RANGE, "tolerance = -1.0: must be float, 0 to 0.001 m"),
        (converge(tolerance=float("nan")), ErrorCode.NOT_FINITE, "tolerance = nan"),
        (converge(max_maps=1000), ErrorCode.OUT_OF_RANGE, "max_maps = 1000: must be"),
        (converge(200.0), ErrorCode.OUT_OF_RANGE, "must be below 1"),
        (recipes(0.01, float("nan")), ErrorCode.NOT_FINITE, "curvatures[1] = nan: must be a finite float"),
        (recipes(0.01, 0.01), ErrorCode.INVALID_ARGUMENT, "+0.0100 1/m is given twice"),
        (recipes(0.0, 5.0), ErrorCode.UNREACHABLE, "curvature = +5.0000 1/m"),
        (recipes(), ErrorCode.INVALID_LENGTH, "curvatures has 0 values: must have 1 to 1000"),
        (recipes(0.0, max_maps=3), ErrorCode.OUT_OF_RANGE, "max_maps = 3: must be int, 4 to 100"),
        (recipes(0.0, tolerance=-1.0), ErrorCode.OUT_OF_RANGE, "tolerance = -1.0: must be"),
        (recipes(0.0, max_maps=101), ErrorCode.OUT_OF_RANGE, "max_maps = 101"),
        (recipes(0.0, zernike=[0.0, 1e-7]), ErrorCode.INVALID_LENGTH, "zernike has 2 values"),
        (recipes(0.0, conic_constant=float("inf")), ErrorCode.NOT_FINITE, "conic_constant = inf"),
    ],
)
def test_bad_goals_are_refused_and_nothing_moves(rig: Rig, goal: Any, code: int, words: str) -> None:
    status, result = rig.run(goal)
    assert status == GoalStatus.STATUS_ABORTED
    assert (result.error_code, words in result.message) == (code, True), result.message
    assert not (rig.bench.measured or rig.bench.degauss_steps or rig.stored or rig.bench.signals.any())


def test_it_converges_and_tells_its_steps(rig: Rig) -> None:
    feedback: list[Any] = []
    status, result = rig.run(converge(tolerance=1e-9), feedback)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert result.error_code == ErrorCode.OK
    assert result.maps == len(rig.bench.measured) >= 2
    assert result.max_zernike < 1e-9
    assert result.residual_rms > 0
    np.testing.assert_allclose(result.signals, rig.bench.signals)
    plant = rig.bench.plant
    true = plant.fit_terms(plant.sag(rig.bench.signals)) - FocusTarget(0.02).coefficients(RADIUS)
    assert np.abs(true[3:]).max() == pytest.approx(result.max_zernike, rel=1e-6)
    assert [step.step for step in feedback] == list(range(1, result.maps + 1))
    assert feedback[0].max_zernike > feedback[-1].max_zernike
    assert {step.curvature for step in feedback} == {0.02}


def test_it_begins_where_a_move_would_go_and_another_solver_does_not(rig: Rig) -> None:
    rig.host.focus.use(calibration_with_history(make_law()), mirror_info())
    move = rig.host.order(FocusRequest(curvature=0.02), dry_run=True).move
    assert move is not None and np.abs(move.signals - move.effective).max() > 0.01, "there is hysteresis to invert"
    for method, wanted in (("", move.signals), ("bounded", move.effective)):
        _, result = rig.run(converge(tolerance=1e-12, max_maps=1, method=method))
        assert result.maps == 1
        np.testing.assert_allclose(rig.bench.signals, wanted, atol=1e-6)


def test_the_map_limit_ends_it_with_the_best_command(rig: Rig) -> None:
    status, result = rig.run(converge(tolerance=1e-11, max_maps=2, method="pseudo_inverse"))
    assert status == GoalStatus.STATUS_ABORTED
    assert result.error_code == ErrorCode.NOT_CONVERGED
    assert result.maps == len(rig.bench.measured) == 2
    assert "not within the tolerance" in result.message and "at their limits" not in result.message
    assert len(result.signals) == 37
    assert rig.host.focus.active is not None
    furthest = rig.host.focus.active.reachable_range(FocusTarget(0.0), 2e-8)[1]
    _, result = rig.run(converge(furthest, tolerance=1e-11, max_maps=1))
    assert result.message.endswith("; actuators stand at their limits")


def test_a_failed_map_is_tried_again_then_given_up(rig: Rig) -> None:
    rig.bench.failures = 1
    assert rig.run(converge())[1].error_code == ErrorCode.OK
    rig.bench.failures = 2
    _, result = rig.run(converge(-0.02))
    assert result.error_code == ErrorCode.MAP_TIMEOUT
    assert "no new file" in result.message


def test_cancelling_leaves_the_last_command(rig: Rig) -> None:
    rig.bench.pause = 0.5
    result = rig.run_cancelled(converge(tolerance=1e-11, max_maps=50), maps=1)
    assert "the mirror holds the last command" in result.message
    assert result.maps >= 1
    held = rig.bench.signals.copy()
    time.sleep(1.0)
    np.testing.assert_array_equal(rig.bench.signals, held)


def test_what_the_host_refuses_does_not_start(rig: Rig) -> None:
    rig.host.focus.rest(Refusal(ErrorCode.STALE, "header.stamp: the request is 9 s old"), rig.host.now)
    _, result = rig.run(converge())
    assert (result.error_code, result.message) == (ErrorCode.STALE, "header.stamp: the request is 9 s old")
    rig.host.focus.use(None, mirror_info())
    assert rig.run(converge())[1].error_code == ErrorCode.NOT_CALIBRATED
    assert not rig.bench.measured


def test_of_a_mirror_that_goes_on_without_an_actuator_no_recipes_are_built(rig: Rig) -> None:
    """They would be withheld once they are stored."""
    without = ["Poke check: none.", "Used without actuator 5 (fixed at -1.00)."]
    rig.host.focus.use(calibration(known_limitations=without), mirror_info())
    _, refused = rig.run(recipes(0.0))
    assert refused.error_code == ErrorCode.NOT_SUPPORTED, refused.message
    assert "Used without actuator 5 (fixed at -1.00): `./dm calibrate`" in refused.message
    assert not (rig.bench.measured or rig.bench.degauss_steps or rig.stored)


def test_what_is_reachable_is_what_requests_go_by(rig: Rig) -> None:
    assert rig.host.focus.active is not None
    edge = rig.host.focus.active.reachable_range(FocusTarget(0.0), 2e-8)[1]
    assert rig.run(recipes(1.02 * edge))[1].error_code == ErrorCode.UNREACHABLE
    rig.host.set_parameters([Parameter("reachable_tolerance", value=1e-5)])
    assert rig.run(recipes(1.02 * edge))[1].recipes == 1


def test_recipes_are_built_and_stored(rig: Rig) -> None:
    feedback: list[Any] = []
    _, result = rig.run(recipes(0.02, -0.01, max_maps=16, tolerance=1e-9), feedback)
    assert (result.error_code, result.recipes) == (ErrorCode.OK, 2), result.message
    assert result.maps == len(rig.bench.measured)
    assert [step.step for step in feedback] == list(range(1, result.maps + 1))
    assert [step.curvature for step in feedback] == sorted(step.curvature for step in feedback)
    assert {(step.curvature, step.recipes) for step in feedback} == {(-0.01, 0), (0.02, 1)}
    (request,) = rig.stored
    assert request.recipes.calibration_id == "known"
    book = recipe_book_from(request.recipes)
    assert book.degauss_steps == 100
    assert set(rig.bench.degauss_steps) == {100}
    for recipe, curvature in zip(book.recipes, (-0.01, 0.02), strict=True):
        assert (recipe.curvature, recipe.conic_constant) == (curvature, 0.0)
        sag = rig.bench.plant.sag(recipe.effective)
        left = rig.bench.plant.fit_terms(sag) - FocusTarget(curvature).coefficients(RADIUS)
        assert np.abs(left[3:]).max() < 1e-9
    assert result.max_zernike == max(recipe.max_zernike for recipe in book.recipes)
    assert not rig.bench.signals.any()
    assert "back at mid range" in result.message


def test_recipes_know_what_their_maps_have_taught_the_calibration(rig: Rig) -> None:
    _, future = rig.send(recipes(0.02))
    wait_until(lambda: len(rig.bench.measured) >= 2, 60)
    taught = calibration(held_out_rms=1e-10, held_out_max_zernike=1e-10)
    taught.zernike_offset[4] += 50e-9
    rig.host.focus.use(taught, mirror_info())
    wait_until(lambda: future.done(), 60)
    assert rig.host.focus.active is not None
    (recipe,) = recipe_book_from(rig.stored[0].recipes).recipes
    now = rig.host.focus.active.mirror.command(FocusTarget(0.02))[0]
    np.testing.assert_allclose(recipe.by_model, now)


def test_a_cancel_keeps_whole_recipes_and_rests_the_mirror(rig: Rig) -> None:
    result = rig.run_cancelled(recipes(-0.02, 0.0, 0.01, 0.02, 0.03), maps=5)
    assert 1 <= result.recipes < 5
    assert len(rig.stored[0].recipes.recipes) == result.recipes
    assert not rig.bench.signals.any()


def test_a_bench_that_fails_keeps_whole_recipes(rig: Rig) -> None:
    _, future = rig.send(recipes(-0.02, 0.0, 0.02))
    wait_until(lambda: len(rig.bench.measured) >= 4, 60)
    rig.bench.failures = 1000
    result = wait_until(lambda: future.done() and future.result(), 60).result
    assert result.error_code == ErrorCode.MAP_TIMEOUT
    assert result.recipes == len(rig.stored[0].recipes.recipes) >= 1
    assert not rig.bench.signals.any()


def test_what_the_store_refuses_is_told(rig: Rig) -> None:
    rig.store_answer = (ErrorCode.STORAGE_FAILED, "calibration known was not stored: No space left on device")
    status, result = rig.run(recipes(0.01))
    assert status == GoalStatus.STATUS_ABORTED
    assert (result.error_code, result.recipes) == (ErrorCode.STORAGE_FAILED, 0)
    assert "No space left on device" in result.message


def test_recipes_beyond_the_tolerance_are_stored_and_named(rig: Rig) -> None:
    _, result = rig.run(recipes(0.02, tolerance=1e-14))
    assert (result.error_code, result.recipes) == (ErrorCode.NOT_CONVERGED, 1)
    assert "not within the tolerance of 0.00 nm: +0.0200 1/m" in result.message
    assert rig.stored[0].recipes.recipes[0].max_zernike == result.max_zernike > 1e-14


@pytest.mark.parametrize("maps", [0, 2])
def test_maps_of_a_mirror_whose_history_was_lost_make_no_recipe(rig: Rig, maps: int) -> None:
    """The electronics lose power in a map, and are back before the next shape: on another branch of the loops."""
    measured = rig.bench.plant.sag

    def cut(signals: Any) -> Any:
        if len(rig.bench.measured) >= maps:
            rig.bench.history_known = False
            rig.bench.publish_state()
        return measured(signals)

    rig.bench.plant.sag = cut  # type: ignore[method-assign,assignment]
    status, result = rig.run(recipes(0.01))
    assert status == GoalStatus.STATUS_ABORTED and result.error_code == ErrorCode.DRIVER_UNAVAILABLE
    assert "no longer knows the history of the actuators" in result.message and not rig.stored
