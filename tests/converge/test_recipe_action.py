"""The action `build_recipes` over DDS, and how they reach the calibration node."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from dm_msgs.action import BuildRecipes
from dm_msgs.msg import ErrorCode
from dm_msgs.srv import StoreRecipes
from rclpy.parameter import Parameter

import converge_stand_in
from calibration_stand_in import StandIn
from converge_stand_in import Host
from dm_common.messages import recipe_book_from
from dm_common.ros.executor import BackgroundExecutor
from dm_common.ros.worker import WorkerService
from dm_controller.planning.target import FocusTarget
from linear_mirror import RADIUS
from support import Observer, wait_until


class Store:
    """The calibration node's service `store_recipes`."""

    def __init__(self, observer: Observer) -> None:
        self.requests: list[Any] = []
        self.answer = (ErrorCode.OK, "")
        WorkerService(observer.node, StoreRecipes, "store_recipes", self._on_request)

    def _on_request(self, request: Any, response: Any) -> Any:
        self.requests.append(request)
        response.error_code, response.message = self.answer
        return response


@pytest.fixture
def host(observer: Observer) -> Iterator[Host]:
    node = Host()
    background = BackgroundExecutor(node)
    yield node
    background.destroy_node()


@pytest.fixture
def bench(observer: Observer) -> StandIn:
    return converge_stand_in.bench(observer.node)


@pytest.fixture
def store(observer: Observer) -> Store:
    return Store(observer)


def goal(*curvatures: float, **fields: Any) -> BuildRecipes.Goal:
    return BuildRecipes.Goal(curvatures=list(curvatures), max_maps=fields.pop("max_maps", 4), **fields)


def run(observer: Observer, wanted: BuildRecipes.Goal) -> tuple[int, Any]:
    ended = observer.run_goal(BuildRecipes, "build_recipes", wanted, timeout_s=60.0)
    return ended.status, ended.result


def test_what_is_reachable_is_what_requests_go_by(observer: Observer, host: Host, bench: StandIn, store: Store) -> None:
    edge = host.active_calibration().planner.mirror.reachable_range(FocusTarget(0.0), 2e-8)[1]
    assert run(observer, goal(1.02 * edge))[1].error_code == ErrorCode.UNREACHABLE
    host.set_parameters([Parameter("reachable_tolerance", value=1e-5)])
    assert run(observer, goal(1.02 * edge))[1].recipes == 1


def test_recipes_are_built_and_stored(observer: Observer, host: Host, bench: StandIn, store: Store) -> None:
    feedback: list[Any] = []
    _, future = observer.send_goal(
        BuildRecipes,
        "build_recipes",
        goal(0.02, -0.01, max_maps=16, tolerance=1e-9),
        lambda message: feedback.append(message.feedback),
    )
    wait_until(future.done, 60)
    result = future.result().result
    assert (result.error_code, result.recipes) == (ErrorCode.OK, 2), result.message
    assert result.maps == len(bench.measured)
    assert [step.step for step in feedback] == list(range(1, result.maps + 1))
    assert [step.curvature for step in feedback] == sorted(step.curvature for step in feedback)
    assert {(step.curvature, step.recipes) for step in feedback} == {(-0.01, 0), (0.02, 1)}
    (request,) = store.requests
    assert request.recipes.calibration_id == "known"
    book = recipe_book_from(request.recipes)
    assert book.degauss_steps == 100
    assert set(bench.degauss_steps) == {100}
    for recipe, curvature in zip(book.recipes, (-0.01, 0.02), strict=True):
        assert (recipe.curvature, recipe.conic_constant) == (curvature, 0.0)
        sag = bench.plant.sag(recipe.effective)
        left = bench.plant.fit_terms(sag) - FocusTarget(curvature).coefficients(RADIUS)
        assert np.abs(left[3:]).max() < 1e-9
    assert result.max_zernike == max(recipe.max_zernike for recipe in book.recipes)
    assert not bench.signals.any()
    assert "back at mid range" in result.message


def test_a_cancel_keeps_whole_recipes_and_rests_the_mirror(
    observer: Observer, host: Host, bench: StandIn, store: Store
) -> None:
    handle, future = observer.send_goal(BuildRecipes, "build_recipes", goal(-0.02, 0.0, 0.01, 0.02, 0.03))
    wait_until(lambda: len(bench.measured) >= 5, 60)
    bench.pause = 0.3
    handle.cancel_goal_async()
    wait_until(future.done, 60)
    ended = future.result()
    assert ended.status == GoalStatus.STATUS_CANCELED
    assert ended.result.error_code == ErrorCode.CANCELED
    assert 1 <= ended.result.recipes < 5
    assert len(store.requests[0].recipes.recipes) == ended.result.recipes
    assert not bench.signals.any()


def test_a_bench_that_fails_keeps_whole_recipes(observer: Observer, host: Host, bench: StandIn, store: Store) -> None:
    _, future = observer.send_goal(BuildRecipes, "build_recipes", goal(-0.02, 0.0, 0.02))
    wait_until(lambda: len(bench.measured) >= 4, 60)
    bench.failures = 1000
    wait_until(future.done, 60)
    result = future.result().result
    assert result.error_code == ErrorCode.MAP_TIMEOUT
    assert result.recipes == len(store.requests[0].recipes.recipes) >= 1
    assert not bench.signals.any()


def test_what_the_store_refuses_is_told(observer: Observer, host: Host, bench: StandIn, store: Store) -> None:
    store.answer = (ErrorCode.STORAGE_FAILED, "calibration known was not stored: No space left on device")
    status, result = run(observer, goal(0.01))
    assert status == GoalStatus.STATUS_ABORTED
    assert (result.error_code, result.recipes) == (ErrorCode.STORAGE_FAILED, 0)
    assert "No space left on device" in result.message


def test_recipes_beyond_the_tolerance_are_stored_and_named(
    observer: Observer, host: Host, bench: StandIn, store: Store
) -> None:
    _, result = run(observer, goal(0.02, tolerance=1e-14))
    assert (result.error_code, result.recipes) == (ErrorCode.NOT_CONVERGED, 1)
    assert "not within the tolerance of 0.00 nm: +0.0200 1/m" in result.message
    assert store.requests[0].recipes.recipes[0].max_zernike == result.max_zernike > 1e-14


@pytest.mark.parametrize(
    ("fields", "code", "words"),
    [
        ({"curvatures": [0.01, float("nan")]}, ErrorCode.NOT_FINITE, "curvatures[1] = nan: must be a finite float"),
        ({"curvatures": [0.01, 0.01]}, ErrorCode.INVALID_ARGUMENT, "+0.0100 1/m is there twice"),
        ({"curvatures": [0.0, 5.0]}, ErrorCode.UNREACHABLE, "curvature = +5.0000 1/m"),
        ({"curvatures": []}, ErrorCode.INVALID_LENGTH, "curvatures has 0 values: must have 1 to 1000"),
        ({"curvatures": [0.0], "max_maps": 3}, ErrorCode.OUT_OF_RANGE, "max_maps = 3: must be int, 4 to 100"),
        ({"curvatures": [0.0], "tolerance": -1.0}, ErrorCode.OUT_OF_RANGE, "tolerance = -1.0: must be"),
        ({"curvatures": [0.0], "max_maps": 101}, ErrorCode.OUT_OF_RANGE, "max_maps = 101"),
        ({"curvatures": [0.0], "zernike": [0.0, 1e-7]}, ErrorCode.INVALID_LENGTH, "zernike has 2 values"),
        ({"curvatures": [0.0], "conic_constant": float("inf")}, ErrorCode.NOT_FINITE, "conic_constant = inf"),
    ],
)
def test_bad_goals_are_refused_and_nothing_moves(
    observer: Observer, host: Host, bench: StandIn, store: Store, fields: dict[str, Any], code: int, words: str
) -> None:
    status, result = run(observer, BuildRecipes.Goal(**fields))
    assert status == GoalStatus.STATUS_ABORTED
    assert (result.error_code, words in result.message) == (code, True), result.message
    assert not (bench.measured or bench.degauss_steps or store.requests)
