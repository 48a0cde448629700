"""The service `store_recipes` of the real calibration node."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from dm_msgs.action import Calibrate
from dm_msgs.msg import ErrorCode
from dm_msgs.msg import RecipeBook as RecipeBookMsg
from dm_msgs.srv import StoreRecipes

from calibration_stand_in import StandIn
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.messages import recipe_book_from, recipe_book_message
from dm_common.recipes import Recipe, RecipeBook
from dm_common.ros import qos
from linear_mirror import LinearMirror, make_mirror
from support import NodeProcess, Observer, wait_until


def book(actuators: int) -> RecipeBook:
    values = np.linspace(-0.5, 0.5, actuators)
    return RecipeBook((Recipe(0.02, 0.0, values, values, 3e-10, 2e-9, 24),), 100, 1e-10)


def test_recipes_are_stored_and_published_again(
    start: Callable[..., NodeProcess], observer: Observer, tmp_path: Path
) -> None:
    mirror = make_mirror(rings=1)
    bench = StandIn(observer.node, mirror, LinearMirror(mirror.x, mirror.y, noise=1e-9))
    received = observer.record(RecipeBookMsg, "recipes", qos.LATCHED)
    parameters = {"calibration_folder": str(tmp_path / "c"), "settle_time": 0.01, "write_report": False}
    node = start("dm_calibration", "calibration", parameters)
    wait_until(lambda: received, 60, node.output)
    bench.publish_info(mirror)

    def store(calibration_id: str, actuators: int) -> Any:
        recipes = recipe_book_message(book(actuators), calibration_id)
        return observer.call(StoreRecipes, "store_recipes", StoreRecipes.Request(recipes=recipes))

    assert store("x", mirror.actuators).error_code == ErrorCode.NOT_CALIBRATED
    goal = Calibrate.Goal(plan=Calibrate.Goal.PLAN_POKES, activate=True)
    made = observer.run_goal(Calibrate, "calibrate", goal, 60).result
    assert made.error_code == ErrorCode.OK, made.message
    wait_until(lambda: received[-1].calibration_id == made.id, 60)

    refused = store("another", mirror.actuators)
    assert refused.error_code == ErrorCode.CALIBRATION_MISMATCH
    assert f"the calibration in use is '{made.id}'" in refused.message
    assert store(made.id, 37).error_code == ErrorCode.INVALID_LENGTH
    assert not CalibrationStore(tmp_path / "c").load(made.id).recipes.recipes

    answer = store(made.id, mirror.actuators)
    assert answer.error_code == ErrorCode.OK, answer.message
    wait_until(lambda: received[-1].recipes, 60)
    for stored in (recipe_book_from(received[-1]), CalibrationStore(tmp_path / "c").load(made.id).recipes):
        assert stored.degauss_steps == 100
        np.testing.assert_array_equal(stored.recipes[0].effective, book(mirror.actuators).recipes[0].effective)
