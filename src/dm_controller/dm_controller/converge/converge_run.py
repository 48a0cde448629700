"""A goal of the action `converge`: bring the surface to a request in closed loop on the interferometer.

The request is judged as for an open-loop move. The loop itself is `dm_controller.converge.closed_loop`; driver and
interferometer are reached through services.
"""

import math
from collections.abc import Callable
from typing import Any

from dm_msgs.action import Converge

from dm_common.errors import ErrorCode, Refusal
from dm_common.limits import Limits
from dm_common.messages import doubles
from dm_common.ros.worker import WorkerGoal
from dm_common.values import without_figures
from dm_controller.converge.closed_loop import Creep, LoopOptions, LoopResult, LoopStep, StoppedLoop, converge
from dm_controller.loop_actions import LoopBench
from dm_controller.solvers.base import Solver
from dm_controller.solvers.registry import make_solver


class ConvergeRun:
    """Carries out one goal; blocks, in the worker thread of the action.

    Args:
        bench: judges requests and knows the calibration in use.
    """

    def __init__(self, bench: LoopBench) -> None:
        self._values, self._bench = bench.parameters, bench

    def run(self, handle: WorkerGoal) -> tuple[str, Any]:
        """Outcome and result of the goal."""
        steps: list[LoopStep] = []
        feedback = without_figures(Converge.Feedback())
        feedback.curvature = handle.request.request.curvature

        def report(step: LoopStep) -> None:
            steps.append(step)
            feedback.step, feedback.residual_rms, feedback.max_zernike = step.map, step.rms, step.max_zernike
            handle.publish_feedback(feedback)

        def body() -> tuple[int, str]:
            return self._judge(*self._loop(handle.request, report))

        asked = handle.request.request
        outcome, error_code, message = self._bench.run("converge", handle, feedback, asked, body)
        if outcome == "canceled":
            message = str(StoppedLoop(tuple(steps)))
        return outcome, _result(steps, error_code, message)

    def _loop(self, goal: Any, report: Callable[[LoopStep], None]) -> tuple[LoopResult, Limits]:
        bench, values = self._bench, self._values
        options = LoopOptions(  # 0 = as configured
            goal.tolerance or values["converge.tolerance"], goal.max_maps or values["converge.max_maps"]
        )
        target = bench.target(goal.request)
        solver = self._solver(goal.method)
        bench.check_ready()
        try:
            found = converge(
                solver, target, bench, options, creep=self._creep(), on_step=report, cancelled=bench.cancelled
            )
        except Refusal as error:
            raise Refusal(error.error_code, f"{error}; the mirror holds the last command") from error
        return found, solver.limits

    def _creep(self) -> Creep | None:
        """By the law in use and what is known of the actuators; without a law of creep, by the configured rate."""
        bench, law = self._bench, self._bench.active_calibration().planner.law
        if law.creep_rate:
            state = bench.hysteresis()
            return Creep(law, state, bench.now) if state is not None else None
        # A mirror that is not known to stand somewhere gives no move to foresee creep from.
        applied = bench.applied()
        return None if applied is None else Creep.of_rate(self._values["converge.creep"], applied, bench.now)

    def _solver(self, method: str) -> Solver:
        active = self._bench.active_calibration()
        mirror, weights = active.mirror, active.calibration.region_weights
        return make_solver(method, mirror.model, mirror.limits, weights if len(weights) else None, mirror)

    def _judge(self, outcome: LoopResult, limits: Limits) -> tuple[int, str]:
        best = outcome.best
        figures = (
            f"{best.max_zernike * 1e9:.2f} nm largest coefficient error, {best.rms * 1e9:.1f} nm rms sag after "
            f"{outcome.maps} maps"
        )
        if outcome.converged:
            return ErrorCode.OK, figures
        limited = "; actuators stand at their limits" if limits.at_limit(best.signals).any() else ""
        restored = "; the best command was written again" if outcome.restored else ""
        return ErrorCode.NOT_CONVERGED, f"not within the tolerance: {figures}{limited}{restored}"


def _result(steps: list[LoopStep], error_code: int, message: str) -> Converge.Result:
    """With the best of what was measured."""
    result = Converge.Result(
        error_code=error_code, message=message, maps=len(steps), residual_rms=math.nan, max_zernike=math.nan
    )
    if steps:
        best = min(steps, key=lambda step: step.max_zernike)
        result.signals = doubles(best.signals)
        result.residual_rms, result.max_zernike = best.rms, best.max_zernike
    return result
