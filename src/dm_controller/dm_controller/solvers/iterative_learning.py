"""Iterative learning control in its norm-optimal form."""

from __future__ import annotations

import numpy as np

from dm_common.limits import Limits
from dm_common.optics.zernike import PISTON_TILT
from dm_controller.planning.mirror_model import InfluenceModel
from dm_controller.solvers.base import Floats, Shape, Solver, normalised_terms

#: β relative to the squared largest singular value of G: the price of a signal change.
BETA = 1e-3


class IterativeLearning(Solver):
    """s_{k+1} = s_k + L e_k, L = (GᵀG + β)⁻¹Gᵀ (iterative learning control, references 12 and 13 of [1]).

    [1] names the method, its about three iterations and what β does ("by decreasing β, we increase the convergence
    speed", section 2.2), but no formula. Norm-optimal learning, min ‖e - GΔs‖² + β‖Δs‖² in each repetition [12], is the
    form of it in which a β does just that. Between steepest descent (large β) and the pseudo-inverse (β = 0): weak
    modes are learned over several maps, so that noise and a wrong G disturb them less.
    """

    name = "iterative_learning"
    source = "iterative learning control, references 12 and 13 of [1]"

    def __init__(self, model: InfluenceModel, limits: Limits, beta: float = BETA) -> None:
        if not (np.isfinite(beta) and beta > 0.0):
            raise ValueError(f"beta = {beta:g}: must be above 0 and finite; 0.001 is the default")
        super().__init__(model, limits)
        matrix, self._factors = normalised_terms(model)
        left, singular, right = np.linalg.svd(matrix, full_matrices=False)
        self._learning = (right.T * (singular / (singular**2 + beta * singular[0] ** 2))) @ left.T

    def _signals(self, start: Floats, change: Shape) -> Floats:
        step: Floats = self._learning @ (self._factors * change.coefficients[PISTON_TILT:])
        return start + step
