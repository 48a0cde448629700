"""A goal of the action `converge`: bring the surface to a request in closed loop on the interferometer.

The request is judged as for an open-loop move. The loop itself is `dm_controller.converge.closed_loop`; driver and
interferometer are reached through services.
"""

from collections.abc import Callable
from typing import Any

from dm_msgs.action import Converge
from dm_msgs.msg import FocusRequest

from dm_common.errors import ErrorCode, Refusal
from dm_common.messages import doubles
from dm_common.ros.worker import WorkerGoal
from dm_common.values import fill_with_nan
from dm_controller.converge.closed_loop import Creep, LoopOptions, LoopStep, StoppedLoop, converge
from dm_controller.loop_actions import LoopBench
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.solvers.base import Solver
from dm_controller.solvers.registry import make_solver


def run_converge(bench: LoopBench, handle: WorkerGoal) -> tuple[str, Any]:
    """Outcome and result of a goal, with the figures of the best map; blocks, in the worker thread of the action."""
    steps: list[LoopStep] = []
    goal, result = handle.request, fill_with_nan(Converge.Result())
    feedback = fill_with_nan(Converge.Feedback())
    feedback.curvature = goal.request.curvature

    def report(step: LoopStep) -> None:
        steps.append(step)
        feedback.step, feedback.residual_rms, feedback.max_zernike = step.map, step.rms, step.max_zernike
        handle.publish_feedback(feedback)

    def body() -> tuple[int, str]:
        return _loop(bench, goal, report)

    outcome, result.error_code, result.message = bench.run("converge", handle, feedback, goal.request, body)
    if outcome == "canceled":
        result.message = str(StoppedLoop(len(steps)))
    if steps:
        best = min(steps, key=lambda step: step.max_zernike)
        result.signals, result.maps = doubles(best.signals), len(steps)
        result.residual_rms, result.max_zernike = best.rms, best.max_zernike
    return outcome, result


def _loop(bench: LoopBench, goal: Any, report: Callable[[LoopStep], None]) -> tuple[int, str]:
    """Carry out the goal; returns an ErrorCode and a sentence."""
    values = bench.parameters
    options = LoopOptions(  # 0 = as configured
        goal.tolerance or values["converge.tolerance"], goal.max_maps or values["converge.max_maps"]
    )
    bench.move(goal.request)  # an impossible request is refused before any wait
    solver = solver_of(bench.active_calibration(), goal.method)
    bench.check_ready()
    goal.request.mode = FocusRequest.MODE_DIRECT  # from the present state, by the law of the actuators
    move = bench.move(goal.request)
    try:
        found = converge(
            solver,
            move.target,
            bench,
            options,
            start=None if goal.method else move.signals,
            creep=_creep(bench),
            on_step=report,
            cancelled=bench.cancelled,
        )
    except Refusal as error:
        raise Refusal(error.error_code, f"{error}; the mirror holds the last command") from error
    best = found.best
    figures = (
        f"{best.max_zernike * 1e9:.2f} nm largest coefficient error, {best.rms * 1e9:.1f} nm rms sag after "
        f"{found.maps} maps"
    )
    if found.converged:
        return ErrorCode.OK, figures
    limited = "; actuators stand at their limits" if solver.limits.at_limit(best.signals).any() else ""
    restored = "; the best command was written again" if found.restored else ""
    return ErrorCode.NOT_CONVERGED, f"not within the tolerance: {figures}{limited}{restored}"


def _creep(bench: LoopBench) -> Creep | None:
    """Predicts creep by the law in use and the actuators' state; without a law of creep, by the configured rate."""
    law, state = bench.active_calibration().planner.law, bench.hysteresis()
    if state is None:  # there is no move from which to predict creep
        return None
    if law.creep_rate:
        return Creep(law, state, bench.now)
    return Creep.of_rate(bench.parameters["converge.creep"], state.signals, bench.now)


def solver_of(active: ActiveCalibration, method: str) -> Solver:
    """The solver of that name ("" = the default) for a calibration. Raises as `make_solver`."""
    mirror, weights = active.mirror, active.calibration.region_weights
    return make_solver(method, mirror.model, mirror.limits, weights if len(weights) else None, mirror)
