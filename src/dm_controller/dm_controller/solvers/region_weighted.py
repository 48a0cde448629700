"""AZWreg: the command solve with region weights, where they act."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dm_common.limits import Limits
from dm_common.optics.piston_tilt import remove_piston_tilt
from dm_common.optics.sample_regions import AREA_FRACTIONS, command_row_weights
from dm_controller.planning.mirror_model import InfluenceModel
from dm_controller.solvers.base import Command, Floats, Shape, Solver, miss_rows, points_of

#: Singular values of the weighted sag influence function below this share of the largest are left out.
CUTOFF = 1e-3


class AZWreg(Solver):
    """min over Δs of ‖W(Δz - HΔs)‖ on the sag points, W of Eq. (8); place (b) of `dm_calibration.influence.weights`.

    On the coefficient vector W would cancel or act on coefficients, not regions; on the sag points, which outnumber
    the actuators, a smaller weight lets a region keep more of the error. Piston and tilt are free: three columns of
    their own in the weighted problem. Least squares as in Eq. (7), so the result is clipped and reports the overflow.
    Corrections also weigh what actuators miss of their moves, see `miss_rows`.
    """

    name = "AZWreg"
    source = "Eqs. (7) and (8), region-weighted least squares on the sag points"

    def __init__(self, model: InfluenceModel, limits: Limits, region_weights: ArrayLike | None = None) -> None:
        """`region_weights`: (10,) Eq. (8), from the centre outwards; None = all equal."""
        super().__init__(model, limits)
        weights = np.ones(len(AREA_FRACTIONS)) if region_weights is None else np.asarray(region_weights, dtype=float)
        points = points_of(model)
        self._row = command_row_weights(points, weights)
        plane = self._row[:, None] * np.column_stack([np.ones(len(points)), points.x, points.y])
        self._plane = np.linalg.qr(plane)[0]
        influence = remove_piston_tilt(model.influence_sag.T, points).T
        matrix = self._reduce(influence)
        if not matrix.any():
            raise ValueError("influence_sag is zero: no actuator moves the surface; calibrate first")
        self._inverse = np.linalg.pinv(matrix, rcond=CUTOFF)
        self._correction = np.linalg.pinv(np.vstack([matrix, miss_rows(matrix)]))[:, : len(matrix)]

    def _reduce(self, sag: Floats) -> Floats:
        """Weighted sag (P,) or (P, N) without what a weighted plane explains."""
        weighted = (sag.T * self._row).T
        result: Floats = weighted - self._plane @ (self._plane.T @ weighted)
        return result

    def _signals(self, start: Floats, change: Shape) -> Floats:
        step: Floats = self._inverse @ self._reduce(change.sag)
        return start + step

    def correct(self, signals: Floats, error: Shape) -> Command:
        """As in the base class, with moves priced by what the actuators miss of them."""
        self._check(error)
        self._check_signals(signals)
        return self.limited(signals - self._correction @ self._reduce(error.sag))
