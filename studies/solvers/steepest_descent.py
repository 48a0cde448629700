"""Steepest descent on the coefficient error."""

from __future__ import annotations

import numpy as np

from dm_common import Floats
from dm_common.limits import Limits
from dm_common.optics.zernike import PISTON_TILT
from dm_controller.planning.mirror_model import InfluenceModel
from dm_controller.solvers.base import Command, Shape, Solver, normalised_terms

#: Iterations on the model in an open-loop solve: with the condition number of such mirrors (10 to 13) the error of the
#: worst mode falls by 2 % per iteration.
MODEL_ITERATIONS = 200


class SteepestDescent(Solver):
    """s_{k+1} = s_k + g Gᵀ e_k ([1], introduction, its reference 19): the transposed influence matrix, a gain and
    the residual e.

    Robust, never far outside the range, and slow ("the iteration time is relatively long"): the gain is limited by the
    stiffest mode, 2 / (σ_max² + σ_min²) being the best fixed one. Closed loop takes one such step per map. Open loop
    takes MODEL_ITERATIONS steps on the model, cut to the limits after each.
    """

    name = "steepest_descent"

    def __init__(self, model: InfluenceModel, limits: Limits) -> None:
        super().__init__(model, limits)
        self._matrix, self._factors = normalised_terms(model)
        singular = np.linalg.svd(self._matrix, compute_uv=False)
        self._gain = 2.0 / (singular[0] ** 2 + singular[-1] ** 2)

    def _signals(self, start: Floats, change: Shape) -> Floats:
        step: Floats = self._gain * (self._matrix.T @ (self._factors * change.coefficients[PISTON_TILT:]))
        return start + step

    def solve(self, wanted: Shape) -> Command:
        """Solve as in the base class, but by iteration on the model."""
        self._check(wanted)
        change = self._factors * (wanted - self.offset).coefficients[PISTON_TILT:]
        command = Command(np.zeros(self._matrix.shape[1]))
        overflow = 0.0
        for _ in range(MODEL_ITERATIONS):
            residual = change - self._matrix @ command.signals
            command = self.limited(command.signals + self._gain * (self._matrix.T @ residual))
            overflow = max(overflow, command.overflow)
        return Command(command.signals, overflow)
