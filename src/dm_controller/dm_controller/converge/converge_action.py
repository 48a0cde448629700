"""The action `converge`: bring the surface to a request in closed loop on the interferometer, or build recipes there.

To be hosted by the focus controller, which judges the request as for an open-loop move and knows calibration and
mirror. The loop itself is `dm_controller.converge.closed_loop`, recipes are `dm_controller.converge.recipe_action`; driver and
interferometer are reached through the services that a calibration uses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from dm_msgs.action import Converge
from dm_msgs.msg import Calibration, ErrorCode, MirrorInfo
from dm_msgs.srv import Degauss
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from dm_common.hysteresis.model import HysteresisState
from dm_common.measurement import BenchError, Cancelled, Measurement, MeasurementError
from dm_common.messages import doubles
from dm_common.names import UnknownNameError
from dm_common.ros.bench_services import BenchServices
from dm_common.ros.parameters import Parameter
from dm_common.ros.worker import WorkerActionServer, wait_for_clock
from dm_controller.converge.closed_loop import Creep, LoopOptions, LoopResult, LoopStep, StoppedLoop, converge
from dm_controller.converge.recipe_action import RECIPE_PARAMETERS, RecipeRun
from dm_controller.conversions import limits_of, model_of
from dm_controller.solvers.base import Solver
from dm_controller.solvers.registry import MirrorFacts, make_solver
from dm_controller.target import FocusTarget, TargetError

#: Parameters that the hosting node declares beside its own.
CONVERGE_PARAMETERS = (
    Parameter(
        "converge.tolerance", float, 2e-9, "largest coefficient error at which a closed loop ends", "m", 1e-11, 1e-5,
        live=True,
    ),
    Parameter("converge.max_maps", int, 5, "maps that a closed loop may take", "", 1, 100, live=True),
    Parameter("converge.settle_time", float, 0.5, "wait between command and map, in ROS time", "s", 0.0, 600.0),
    Parameter(
        "converge.creep", float, 0.01, "growth of a move per decade of time that the loop foresees; 0 = none", "", 0.0,
        0.2, live=True,
    ),
    Parameter("converge.driver_timeout", float, 30.0, "longest wait for the driver to set a shape", "s", 0.1, 600.0),
    Parameter("converge.measure_timeout", float, 60.0, "longest wait for one map", "s", 0.1, 3600.0),
    Parameter("converge.measure_retries", int, 1, "further tries after a map that failed", "", 0, 20, live=True),
    *RECIPE_PARAMETERS,
)  # fmt: skip


class _Bench(BenchServices):
    """Driver and interferometer of one loop, with further tries of a map that failed."""

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        names = ("settle_time", "driver_timeout", "measure_timeout")
        own = {name: values[f"converge.{name}"] for name in names}
        super().__init__(node, own | {"degauss_timeout": values["recipes.degauss_timeout"]})
        self._degauss_steps = int(values["recipes.degauss_steps"])
        self.retries: Callable[[], int] = lambda: int(values["converge.measure_retries"])

    def degauss(self) -> None:
        """The condition that recipes begin with: the driver's own number of steps may be another."""
        request = Degauss.Request(steps=self._degauss_steps)
        self._call(self._degauss, request, self._values["degauss_timeout"], ErrorCode.DRIVER_UNAVAILABLE)

    def measure(self, label: str) -> Measurement:
        """One map. Raises MeasurementError after all tries, or BenchError when no other try can succeed."""
        left = self.retries()
        while True:
            try:
                return super().measure(label)
            except MeasurementError:
                if left == 0 or self.cancelled():
                    raise
                left -= 1


class ConvergeAction:
    """Serves `converge`, one goal at a time; a newer goal is refused while one runs.

    Args:
        node: the hosting node.
        values: its parameters, CONVERGE_PARAMETERS among them.
        decide: judges a FocusRequest; returns an object with the `target` and raises an exception with an `error_code`
            when the request cannot be carried out at all (no calibration, a stale request, no such surface).
        known: the calibration and the mirror in use.
        standing: what the host knows of the mirror's memory when a goal begins; None = nothing.
    """

    def __init__(
        self,
        node: Node,
        values: Mapping[str, Any],
        decide: Callable[[Any], Any],
        known: Callable[[], tuple[Calibration | None, MirrorInfo | None]],
        standing: Callable[[], HysteresisState | None] = lambda: None,
    ) -> None:
        self._node, self._values, self._decide, self._known = node, values, decide, known
        self._bench = _Bench(node, values)
        self._recipes = RecipeRun(node, values, self._bench, known, standing)
        self._server = WorkerActionServer(node, Converge, "converge", self._run)

    @property
    def busy(self) -> bool:
        """Whether a loop is running: other commands would disturb it."""
        return self._server.busy

    def _run(self, handle: ServerGoalHandle) -> tuple[str, Any]:
        result = Converge.Result()
        steps: tuple[LoopStep, ...] = ()

        def end(outcome: str, error_code: int, message: str) -> tuple[str, Any]:
            result.error_code, result.message = error_code, message
            _fill(result, steps)
            return told(outcome, result)

        def told(outcome: str, result: Any) -> tuple[str, Any]:
            # One line per severity: rclpy ties a severity to the line that logs.
            if outcome == "succeed":
                self._node.get_logger().info(f"converge: {result.message}")
            else:
                self._node.get_logger().warning(f"converge: {result.message}")
            return outcome, result

        taken: list[LoopStep] = []

        def report(step: LoopStep) -> None:
            taken.append(step)
            handle.publish_feedback(
                Converge.Feedback(step=step.map, residual_rms=step.rms, max_zernike=step.max_zernike)
            )

        try:
            if handle.request.curvatures:
                return told(*self._build_recipes(handle))
            outcome = self._loop(handle, report)
            steps = outcome.steps
            return end(*self._judge(outcome))
        except StoppedLoop as error:
            steps = error.steps
            return end("canceled", ErrorCode.CANCELED, str(error))
        except Cancelled:
            steps = tuple(taken)
            return end("canceled", ErrorCode.CANCELED, str(StoppedLoop(steps)))
        except BenchError as error:
            steps = tuple(taken)
            return end("abort", error.code, f"{error}; the mirror holds the last command")
        except UnknownNameError as error:
            return end("abort", ErrorCode.UNKNOWN_NAME, str(error))
        except (TargetError, ValueError) as error:
            steps = tuple(taken)
            return end("abort", ErrorCode.INVALID_ARGUMENT, str(error))
        except TimeoutError as error:
            steps = tuple(taken)
            return end("abort", ErrorCode.TIMEOUT, str(error))
        except Exception as error:  # the host's refusals carry a code; anything else is a defect
            if not hasattr(error, "error_code"):
                raise
            return end("abort", error.error_code, str(error))

    def _build_recipes(self, handle: ServerGoalHandle) -> tuple[str, Any]:
        self._check_figures(handle.request)
        target: FocusTarget = self._decide(handle.request.request).target
        self._bench.cancelled = lambda: bool(handle.is_cancel_requested)
        return self._recipes.run(handle, target)

    def _loop(self, handle: ServerGoalHandle, report: Callable[[LoopStep], None]) -> LoopResult:
        goal, bench = handle.request, self._bench
        options = self._options(goal)
        target: FocusTarget = self._decide(goal.request).target
        solver = self._solver(goal.method)
        bench.check_ready()
        state = bench.state
        clock = self._node.get_clock()
        wait_for_clock(clock)
        bench.settle_time = float(self._values["converge.settle_time"])
        bench.cancelled = lambda: bool(handle.is_cancel_requested)
        creep = None
        count = solver.model.influence_zernike.shape[1]
        # A mirror that is not known to stand somewhere gives no move to foresee creep from.
        if state is not None and len(state.applied) == count and np.isfinite(state.applied).all():
            before = np.asarray(state.applied, dtype=float)
            creep = Creep(self._values["converge.creep"], before, lambda: clock.now().nanoseconds * 1e-9)
        return converge(solver, target, bench, options, creep=creep, on_step=report, cancelled=bench.cancelled)

    def _check_figures(self, goal: Any) -> None:
        """Raise ValueError naming the field that makes no sense."""
        if not (math.isfinite(goal.tolerance) and goal.tolerance >= 0.0):
            raise ValueError(f"tolerance = {goal.tolerance} m: must be 0 (= configured) or above, and finite")
        if goal.max_maps > 100:
            raise ValueError(f"max_maps = {goal.max_maps}: must be 0 (= configured) to 100")

    def _options(self, goal: Any) -> LoopOptions:
        """What the goal asks for, 0 = configured. Raises ValueError naming the field."""
        self._check_figures(goal)
        return LoopOptions(
            goal.tolerance or self._values["converge.tolerance"], goal.max_maps or self._values["converge.max_maps"]
        )

    def _solver(self, method: str) -> Solver:
        calibration, mirror = self._known()
        if calibration is None or mirror is None:
            raise BenchError(ErrorCode.NOT_CALIBRATED, "no calibration: run `./dm calibrate` or load_calibration")
        facts = MirrorFacts(
            np.asarray(mirror.actuator_x, dtype=float),
            np.asarray(mirror.actuator_y, dtype=float),
            np.asarray(calibration.region_weights, dtype=float) if len(calibration.region_weights) else None,
        )
        return make_solver(method, model_of(calibration), limits_of(mirror), facts)

    def _judge(self, outcome: LoopResult) -> tuple[str, int, str]:
        best = outcome.best
        words = (
            f"{best.max_zernike * 1e9:.2f} nm largest coefficient error, {best.rms * 1e9:.1f} nm rms sag after "
            f"{outcome.maps} maps"
        )
        if outcome.converged:
            return "succeed", ErrorCode.OK, words
        limited = "; actuators stand at their limits" if best.overflow > 0.0 else ""
        restored = "; the best command was written again" if outcome.restored else ""
        return "abort", ErrorCode.NOT_CONVERGED, f"not within the tolerance: {words}{limited}{restored}"


def _fill(result: Any, steps: tuple[LoopStep, ...]) -> None:
    """The best of what was measured."""
    result.maps = len(steps)
    result.residual_rms = result.max_zernike = math.nan
    if steps:
        best = min(steps, key=lambda step: step.max_zernike)
        result.signals = doubles(best.signals)
        result.residual_rms, result.max_zernike = best.rms, best.max_zernike
