"""The part of the action `converge` that builds recipes: goal to targets, build, store with the calibration.

Recipes that are whole are stored however the goal ends: on a failure of the bench or a cancel, those built before it.
The mirror goes back to mid range.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from dm_msgs.action import Converge
from dm_msgs.msg import Calibration, ErrorCode, MirrorInfo
from dm_msgs.srv import StoreRecipes
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.hysteresis.tracker import Applied, HysteresisTracker
from dm_common.measurement import BenchError, Cancelled
from dm_common.messages import doubles, recipe_book_message
from dm_common.recipes import Recipe, RecipeError
from dm_common.ros.bench_services import BenchServices
from dm_common.ros.parameters import Parameter
from dm_common.ros.worker import ServiceCallError, call, wait_for_clock
from dm_controller.converge.recipe_building import (
    BuildOptions,
    BuildStep,
    RecipeBuilder,
    recipe_book,
)
from dm_controller.converge.recipe_targets import UnreachableError, recipe_targets
from dm_controller.conversions import hysteresis_figures_of, limits_of, model_of
from dm_controller.mirror_model import CalibratedMirror
from dm_controller.planner import Planner
from dm_controller.target import FocusTarget, TargetError

RECIPE_PARAMETERS = (
    Parameter(
        "recipes.tolerance", float, 6.3e-10, "largest re-measured coefficient error of a recipe", "m", 1e-11, 1e-5,
        live=True,
    ),
    Parameter("recipes.max_maps", int, 32, "maps that one recipe may take", "", 4, 100, live=True),
    Parameter("recipes.average", int, 8, "maps averaged after each degauss of a recipe", "", 2, 50, live=True),
    Parameter("recipes.degauss_steps", int, 100, "half-swings of the degauss that recipes begin with", "", 1, 10000),
    Parameter("recipes.degauss_timeout", float, 120.0, "longest wait for a degauss", "s", 1.0, 3600.0),
)  # fmt: skip

#: A model that leaves a larger coefficient error of a curvature, m, cannot reach it.
UNREACHABLE_ERROR = 2e-8
#: Longest wait for the calibration node to store recipes, s.
STORE_TIMEOUT_S = 30.0


class RecipeRun:
    """Carries out goals with `curvatures`; blocks, in the worker thread of the action.

    Args:
        values: parameters of the hosting node, RECIPE_PARAMETERS among them.
        known: calibration and mirror in use.
        standing: what the host knows of the mirror's memory; None = nothing.
    """

    def __init__(
        self,
        node: Node,
        values: Mapping[str, Any],
        bench: BenchServices,
        known: Callable[[], tuple[Calibration | None, MirrorInfo | None]],
        standing: Callable[[], HysteresisState | None],
    ) -> None:
        self._node, self._values, self._bench = node, values, bench
        self._known, self._standing = known, standing
        self._store = node.create_client(StoreRecipes, "store_recipes")

    def run(self, handle: ServerGoalHandle, target: FocusTarget) -> tuple[str, Any]:
        """Build and store. The curvature of `target` does not count.

        Raises:
            BenchError, ValueError: refused before anything moved.
        """
        goal, bench = handle.request, self._bench
        calibration, mirror = self._known()
        if calibration is None or mirror is None:
            raise BenchError(ErrorCode.NOT_CALIBRATED, "no calibration: run `./dm calibrate` or load_calibration")
        options = self._options(goal)
        loop = Planner(
            CalibratedMirror(model_of(calibration), limits_of(mirror)),
            hysteresis_figures_of(calibration),
            mirror.slew_rate_max if mirror.slew_rate_max > 0.0 else math.inf,
        )
        targets = self._targets(goal, target, loop)
        bench.check_ready()
        clock = self._node.get_clock()
        wait_for_clock(clock)
        bench.settle_time = options.settle_time

        def now() -> float:
            return float(clock.now().nanoseconds * 1e-9)

        def report(step: BuildStep) -> None:
            handle.publish_feedback(
                Converge.Feedback(
                    step=builder.maps, curvature=step.curvature, residual_rms=step.rms, max_zernike=step.max_zernike
                )
            )

        builder = RecipeBuilder(
            loop, bench, now, options, state=self._standing() or self._guess(loop.law, now()), on_step=report,
            cancelled=bench.cancelled,
        )  # fmt: skip
        recipes, code, words = self._build(builder, targets)
        result = Converge.Result(maps=builder.maps, residual_rms=math.nan, max_zernike=math.nan)
        rest = bench.rest(np.full(calibration.actuators, 0.5 * (mirror.signal_min + mirror.signal_max)))
        if recipes:
            result.signals = doubles(recipes[-1].signals)
            result.residual_rms = max(recipe.rms for recipe in recipes)
            result.max_zernike = max(recipe.max_zernike for recipe in recipes)
            book = recipe_book(recipes, loop, self._values["recipes.degauss_steps"], clock.now().nanoseconds)
            result.interpolation_error = book.interpolation_error
            stored, reason = self._stored(
                StoreRecipes.Request(calibration_id=calibration.id, recipes=recipe_book_message(book))
            )
            if stored == ErrorCode.OK:
                result.recipes = len(recipes)
            else:
                code = stored if code == ErrorCode.OK else code
                words = "; ".join(filter(None, (words, f"the recipes were not stored: {reason}")))
        missed = [f"{r.curvature:+.4f}" for r in recipes if r.max_zernike > options.tolerance]
        if code == ErrorCode.OK and missed:
            code = ErrorCode.NOT_CONVERGED
            words = f"not within the tolerance of {options.tolerance * 1e9:.2f} nm: {', '.join(missed)} 1/m"
        figures = (
            f"{result.recipes} of {len(targets)} recipes stored with calibration {calibration.id}, largest coefficient "
            f"error {result.max_zernike * 1e9:.2f} nm re-measured, {result.interpolation_error * 1e9:.2f} nm more "
            "between them"
            if result.recipes
            else "no recipe was stored"
        )
        result.error_code, result.message = code, "; ".join(filter(None, (words, figures, rest)))
        return {ErrorCode.OK: "succeed", ErrorCode.CANCELED: "canceled"}.get(code, "abort"), result

    def _build(self, builder: RecipeBuilder, targets: list[FocusTarget]) -> tuple[list[Recipe], int, str]:
        """Whole recipes, and what ended the work: an ErrorCode and words."""
        recipes: list[Recipe] = []
        try:
            for target in targets:
                recipe = builder.build(target)
                recipes.append(recipe)  # one by one: what is whole stays when the next fails
        except Cancelled as error:
            return recipes, ErrorCode.CANCELED, str(error)
        except BenchError as error:
            return recipes, error.code, str(error)
        except UnreachableError as error:
            return recipes, ErrorCode.UNREACHABLE, str(error)
        except ValueError as error:
            return recipes, ErrorCode.INVALID_ARGUMENT, str(error)
        return recipes, ErrorCode.OK, ""

    def _options(self, goal: Any) -> BuildOptions:
        """What the goal asks for, 0 = configured. Raises ValueError naming the field."""
        if goal.method:
            raise ValueError(
                f"method = {goal.method!r}: recipes are corrected by the bounded programme; leave it empty"
            )
        values = self._values
        maps = goal.max_maps or values["recipes.max_maps"]
        # At least four rounds: without a memory law, hysteresis makes each correction miss by some share of itself.
        average = min(values["recipes.average"], max(maps // 4, 2))
        tolerance = goal.tolerance or values["recipes.tolerance"]
        return BuildOptions(tolerance, maps, average, float(values["converge.settle_time"]))

    def _targets(self, goal: Any, target: FocusTarget, loop: Planner) -> list[FocusTarget]:
        if any(target.zernike):
            raise ValueError("request.zernike: recipes are of plain conics; leave it empty")
        try:
            return recipe_targets(list(goal.curvatures), target.conic_constant, loop, UNREACHABLE_ERROR)
        except UnreachableError as error:
            raise BenchError(ErrorCode.UNREACHABLE, str(error)) from error
        except (RecipeError, TargetError) as error:
            finite = all(math.isfinite(curvature) for curvature in goal.curvatures)
            raise BenchError(ErrorCode.INVALID_ARGUMENT if finite else ErrorCode.NOT_FINITE, str(error)) from error

    def _guess(self, law: HysteresisModel, now: float) -> HysteresisState | None:
        """The mirror long rested where the driver says it stands; None when it does not say."""
        state = self._bench.state
        if state is None or not len(state.applied) or not np.isfinite(state.applied).all():
            return None
        tracker = HysteresisTracker(law)
        tracker.observe(Applied(now, np.array(state.applied, dtype=float), 0, None, 0, False))
        return tracker.state

    def _stored(self, request: Any) -> tuple[int, str]:
        """What the calibration node answers: an ErrorCode and words."""
        try:
            response = call(self._store, request, STORE_TIMEOUT_S)
        except ServiceCallError as error:
            return ErrorCode.TIMEOUT, str(error)
        return response.error_code, response.message
