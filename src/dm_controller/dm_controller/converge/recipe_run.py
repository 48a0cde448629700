"""A goal of the action `build_recipes`: a list of curvatures becomes recipes, stored with the calibration.

Complete recipes are stored however the goal ends: after a failure of the bench or a cancel, those built before it.
The mirror goes back to mid range.
"""

import time
from contextlib import suppress
from typing import Any

import numpy as np
from dm_msgs.action import BuildRecipes
from dm_msgs.srv import StoreRecipes
from rclpy.client import Client

from dm_common.errors import EXPECTED, ErrorCode, Refusal, error_code
from dm_common.messages import recipe_book_message
from dm_common.recipes import GOES_ON_WITHOUT, shape_text
from dm_common.ros.clients import ServiceCallError, call
from dm_common.ros.qos import Liveliness
from dm_common.ros.worker import WorkerGoal
from dm_common.values import fill_with_nan
from dm_controller.converge.recipe_building import BuildOptions, BuildStep, RecipeBuilder, recipe_book
from dm_controller.loop_actions import LoopBench
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.planner import Planner
from dm_controller.planning.recipes import recipe_targets

#: Longest wait for the answer of the calibration node, which stores the recipes, and for its return after a crash, s.
STORE_TIMEOUT_S = 10.0
RETURN_S = 120.0
#: Time for the calibration node to judge the last map, half a second after its stamp, and to publish the result, s.
UPDATE_S = 2.0


class RecipeRun:
    """Carries out one goal; blocks, in the worker thread of the action.

    Args:
        store: client of the service `store_recipes`, which the node `calibration` serves.
    """

    def __init__(self, bench: LoopBench, store: Client, calibration: Liveliness) -> None:
        self._bench, self._values = bench, bench.parameters
        self._store, self._calibration = store, calibration

    def run(self, handle: WorkerGoal) -> tuple[str, Any]:
        """Outcome and result of the goal."""
        feedback = fill_with_nan(BuildRecipes.Feedback())
        result = fill_with_nan(BuildRecipes.Result())

        def body() -> tuple[int, str]:
            return self._build_and_store(handle, feedback, result)

        outcome, result.error_code, result.message = self._bench.run(
            "build_recipes", handle, feedback, handle.request, body, self._calibration, history=True
        )
        return outcome, result

    def _build_and_store(
        self, handle: WorkerGoal, feedback: BuildRecipes.Feedback, result: BuildRecipes.Result
    ) -> tuple[int, str]:
        """Build and store; fills the figures of `result`, and returns an ErrorCode and a sentence.

        Raises:
            Refusal, ValueError: refused before anything moved.
        """
        goal, bench = handle.request, self._bench
        options = self._options(goal)
        active = bench.active_calibration()
        planner, calibration = active.planner, active.calibration
        without = next((text for text in calibration.known_limitations if text.startswith(GOES_ON_WITHOUT)), "")
        if without:
            raise Refusal(
                ErrorCode.NOT_SUPPORTED,
                f"calibration {calibration.id} withholds recipes: {without.rstrip('.')}: `./dm calibrate` measures "
                "the mirror as it is, `./dm check --forget` uses the actuators again",
            )
        targets = recipe_targets(goal.curvatures, goal.conic_constant, goal.zernike, planner, options.reachable)
        steps = self._values["recipes.degauss_steps"]
        active.recipes.check_condition(steps)
        bench.check_ready()

        def report(step: BuildStep) -> None:
            feedback.step, feedback.curvature, feedback.recipes = builder.maps, step.curvature, step.recipes
            feedback.residual_rms, feedback.max_zernike = step.rms, step.max_zernike
            handle.publish_feedback(feedback)

        builder = RecipeBuilder(
            planner, bench, bench.now, options, state=bench.hysteresis(), on_step=report, cancelled=bench.cancelled
        )
        code, text = int(ErrorCode.OK), ""
        try:
            for target in targets:
                builder.build(target)
        except EXPECTED as error:  # also a cancel; complete recipes are kept
            code, text = error_code(error), str(error)
        recipes, result.maps = builder.recipes, builder.maps
        rest = bench.rest(np.full(calibration.actuators, active.middle))
        if recipes:
            result.residual_rms = max(recipe.rms for recipe in recipes)
            result.max_zernike = max(recipe.max_zernike for recipe in recipes)
            time.sleep(UPDATE_S)
            now = self._planner_now(active)
            book = recipe_book(recipes, now, steps, round(1e9 * bench.now()), active.recipes)
            result.interpolation_error = book.interpolation_error
            request = StoreRecipes.Request(recipes=recipe_book_message(book, calibration.id))
            stored, reason = self._stored(handle, request)
            if stored == ErrorCode.OK:
                result.recipes = len(recipes)
            else:
                code = stored if code == ErrorCode.OK else code
                text = "; ".join(filter(None, (text, f"the recipes were not stored: {reason}")))
        missed = [shape_text(r) for r in recipes if r.max_zernike > options.tolerance]
        if code == ErrorCode.OK and missed:
            code = ErrorCode.NOT_CONVERGED
            text = f"not within the tolerance of {options.tolerance * 1e9:.2f} nm: {' and '.join(missed)}"
        figures = (
            f"{result.recipes} of {len(targets)} recipes stored with calibration {calibration.id}, largest coefficient "
            f"error {result.max_zernike * 1e9:.2f} nm re-measured, {result.interpolation_error * 1e9:.2f} nm more "
            "between them"
            if result.recipes
            else "no recipe was stored"
        )
        if builder.left_out:
            figures += f"; left out {builder.left_out} of {result.maps} maps that contradicted the rest of their round"
        return code, "; ".join(filter(None, (text, figures, rest)))

    def _planner_now(self, active: ActiveCalibration) -> Planner:
        """The present planner of the recipes' calibration, which their maps may have updated meanwhile."""
        with suppress(Refusal):
            now = self._bench.active_calibration()
            if now.calibration.id == active.calibration.id:
                return now.planner
        return active.planner

    def _options(self, goal: Any) -> BuildOptions:
        """The options of the goal, in which 0 = as configured."""
        values = self._values
        maps = goal.max_maps or values["recipes.max_maps"]
        # At least four rounds: without a model, hysteresis makes each correction miss by some share of itself.
        average = min(values["recipes.average"], max(maps // 4, 2))
        tolerance = goal.tolerance or values["recipes.tolerance"]
        return BuildOptions(
            tolerance, maps, average, float(values["converge.settle_time"]), values["reachable_tolerance"]
        )

    def _stored(self, handle: WorkerGoal, request: Any) -> tuple[int, str]:
        """Ask the calibration node to store the recipes; returns its ErrorCode and sentence.

        Waits for a node that has died to return and to load its calibration. Repeats a request without an answer: a
        node that has just started loses answers to clients that it has not discovered yet.
        """
        deadline = time.monotonic() + RETURN_S
        while True:
            self._calibration.wait_for_return(lambda: bool(handle.is_cancel_requested))
            lost_reason = self._calibration.since_now(self._store.service_is_ready)
            try:
                response = call(self._store, request, STORE_TIMEOUT_S, lost_reason)
                code, text = response.error_code, response.message
                wait = code == ErrorCode.NOT_CALIBRATED
            except ServiceCallError as error:
                code, text = ErrorCode.TIMEOUT, lost_reason() or str(error)
                wait = True
            lost = self._bench.hold.lost is not None  # somebody else has taken the mirror over: end the wait
            if not wait or lost or handle.is_cancel_requested or time.monotonic() > deadline:
                return code, text
            self._bench.waiting(f"waiting: {text}")
            time.sleep(0.1)
