"""The residual to expect of a focus command, with an interval that includes hysteresis of the actuators.

An influence function predicts a residual as if actuators had no hysteresis. The service `predict_error` of the
calibration node gives the error of a command over many histories. Its answers for some commands over the reachable
range are fetched once per calibration, in the background. Their excess over the influence function's own error is the
share of hysteresis, which then only has to be looked up.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from dm_msgs.srv import PredictError
from rclpy.node import Node

from dm_common import Floats
from dm_common.errors import ErrorCode
from dm_common.messages import doubles
from dm_common.optics.zernike import basis
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.mirror_model import InfluenceModel, response
from dm_controller.planning.target import FocusTarget, Shape

#: Number of curvatures over the reachable range for which the share of hysteresis is fetched.
GRID = 11
#: Answers that have not come within this time are asked for again, s: the node that was asked may have died.
RETRY_S = 10.0
#: Final answers: asking again would not change them.
FINAL = (ErrorCode.TOO_FEW_MAPS, ErrorCode.NOT_SUPPORTED)


@dataclass(frozen=True, eq=False)
class HysteresisShare:
    """Mean square residual that the actuators' hysteresis adds, over curvature.

    Attributes:
        curvature: (K,) 1/m, rising.
        square: (K, 2) m^2: lower and upper end of the 95 % interval.
    """

    curvature: Floats
    square: Floats

    def interval(self, curvature: float, model_rms: float) -> tuple[float, float]:
        """95 % interval of the rms residual, m: by the influence function (`Plan.rms`, m) and by hysteresis."""
        lower, upper = (np.interp(curvature, self.curvature, column) + model_rms**2 for column in self.square.T)
        return float(np.sqrt(lower)), float(np.sqrt(upper))


def surface_control_error_rms(model: InfluenceModel, signals: Floats) -> float:
    """Rms surface control error, m, from figure and influence function alone: sag minus nominal surface G s."""
    from dm_controller.solvers.base import rms_sag  # not needed at the start

    moved = response(model, signals)
    nominal = basis(model.points.x, model.points.y) @ moved.coefficients
    return rms_sag(Shape(model.zernike_offset, model.sag_offset + moved.sag - nominal), model)


class ForecastClient:
    """Keeps the share of hysteresis for the calibration in use; nothing here waits.

    Attributes:
        share: None until all answers have come, and where the calibration has no sample surfaces.
    """

    def __init__(self, node: Node) -> None:
        self.share: HysteresisShare | None = None
        self._node = node
        self._client = node.create_client(PredictError, "predict_error")
        self._calibration_id = ""
        self._requested_at = -float("inf")
        self._refused, self._last_message = False, ""
        self._pending: list[Any] = []

    def use(self, active: ActiveCalibration | None, tolerance: float) -> None:
        """Fetch the share for a calibration that has no hysteresis model itself.

        Call it with every calibration and regularly: it returns at once, and if the calibration node does not answer, a
        later call asks again.

        Args:
            tolerance: m, largest coefficient error at which a curvature counts as reachable.
        """
        if active is not None and active.planner.hysteresis is not None:
            active = None
        calibration_id = active.calibration.id if active is not None else ""
        if calibration_id != self._calibration_id:
            self._calibration_id, self._refused, self.share = calibration_id, False, None
            self._requested_at = -float("inf")
        if active is None or self.share is not None or self._refused or not self._client.service_is_ready():
            return
        if time.monotonic() < self._requested_at + RETRY_S:
            return
        mirror, curvatures = active.mirror, active.reachable_range(FocusTarget(0.0), tolerance)
        if not np.isfinite(curvatures).all():
            return
        self._requested_at = time.monotonic()
        for future in self._pending:
            self._client.remove_pending_request(future)
        self._pending = []
        grid = np.linspace(*curvatures, GRID)
        commands = [mirror.plan(FocusTarget(float(curvature))).signals for curvature in grid]
        modelled = np.array([surface_control_error_rms(mirror.model, signals) for signals in commands])
        answers = np.full((GRID, 2), np.nan)
        for row, signals in enumerate(commands):
            future = self._client.call_async(PredictError.Request(signals=doubles(signals)))
            self._pending.append(future)
            future.add_done_callback(
                lambda done, row=row: self._on_answer(calibration_id, row, done, grid, answers, modelled)
            )

    def _on_answer(
        self, calibration_id: str, row: int, future: Any, grid: Floats, answers: Floats, modelled: Floats
    ) -> None:
        if calibration_id != self._calibration_id or future.cancelled() or future.exception() is not None:
            return
        answer = future.result()
        if answer.error_code != ErrorCode.OK:
            if answer.message != self._last_message:
                self._last_message = answer.message
                self._node.get_logger().info(f"no prediction of the surface error: {answer.message}")
            self._refused = self._refused or answer.error_code in FINAL
            return
        answers[row] = answer.lower, answer.upper
        if self.share is None and np.isfinite(answers).all():
            square = np.square(answers) - np.square(modelled)[:, np.newaxis]
            self.share = HysteresisShare(grid, np.maximum(square, 0.0))
