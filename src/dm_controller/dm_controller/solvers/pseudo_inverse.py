"""The SVD pseudo-inverse of the influence function, clipped; and AZreg, the same solve on the fit of [1]."""

from __future__ import annotations

import numpy as np

from dm_common.limits import Limits
from dm_common.optics.zernike import PISTON_TILT
from dm_controller.planning.mirror_model import InfluenceModel
from dm_controller.solvers.base import Floats, Shape, Solver, normalised_terms

#: Singular values below this share of the largest are left out: they would turn noise into signals.
CUTOFF = 1e-3


class PseudoInverse(Solver):
    """Δs = G⁺ Δc by singular value decomposition ([1], introduction, its reference 18).

    The shortest of all signals that give the wanted coefficients beyond tilt. Nothing holds it inside the range
    ("severe overflow of the control voltage", section 1), so it is clipped and reports by how much; and nothing holds
    down the sag beyond the terms.
    """

    name = "pseudo_inverse"
    source = "SVD pseudo-inverse of the influence matrix, reference 18 of [1]"

    def __init__(self, model: InfluenceModel, limits: Limits) -> None:
        super().__init__(model, limits)
        matrix, self._factors = normalised_terms(model)
        self._inverse = np.linalg.pinv(matrix, rcond=CUTOFF)

    def _signals(self, start: Floats, change: Shape) -> Floats:
        step: Floats = self._inverse @ (self._factors * change.coefficients[PISTON_TILT:])
        return start + step


class AZreg(PseudoInverse):
    """Eq. (6): the least-squares solution Δs of Δc = GΔs with G fitted to all sample surfaces.

    [1] gives no other command solve than this equation, so it differs from the pseudo-inverse only in the
    influence function it is given: the regression on all surfaces of Table 1 in place of single pokes. Its way of
    starting from a measured state (section 3.2: c_ini, s_ini of p55 or p56) is `correct(s_ini, c_ini - c)`.
    """

    name = "AZreg"
    source = "Eq. (6), least squares on the 21 coefficients"
