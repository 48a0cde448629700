"""The bounded programme as a solver: coefficients first, least sag beyond them, inside the limits."""

from __future__ import annotations

import numpy as np

from dm_calibration.influence.sag import remove_piston_tilt
from dm_calibration.optics.zernike import basis
from dm_controller.model import COEFFICIENT_WEIGHT, RIDGE_SHARE, InfluenceModel
from dm_controller.solvers.base import FREE, Command, Floats, Shape, Solver, miss_rows, points_of
from dm_controller.solvers.bounded import BoundedProgramme, Limits

#: Ridge of a correction, m per unit signal: only for actuators without any influence, which stay where they are.
TINY = 1e-12


class Bounded(Solver):
    """Least squares inside the box: `dm_controller.model.CalibratedMirror` for shapes and corrections of any kind.

    The coefficients beyond tilt weigh so much that they act as equalities, the sag beyond the 21 terms is as small as
    possible, and the limits hold by construction: nothing is ever clipped. Corrections also weigh what
    actuators miss of their moves, see `miss_rows`.
    """

    name = "bounded"
    source = "bounded quadratic programme (Lawson & Hanson 1974, ch. 23)"

    def __init__(self, model: InfluenceModel, limits: Limits) -> None:
        super().__init__(model, limits)
        self._weights = np.sqrt(model.sample_weight)
        self._terms = np.linalg.qr(self._weights[:, None] * basis(model.sample_x, model.sample_y))[0]
        self._matrix = self._rows(model.influence_zernike, model.influence_sag)
        tilt_free = self._weights[:, None] * remove_piston_tilt(model.influence_sag.T, points_of(model)).T
        ridge = RIDGE_SHARE * float(np.median(np.linalg.norm(tilt_free, axis=0)))
        self._programme = BoundedProgramme(self._matrix, limits, ridge=ridge**2)
        # A correction must not pull at signals that the error says nothing of: its rows price moves, not signals.
        self._miss = miss_rows(self._matrix)
        self._correction = BoundedProgramme(np.vstack([self._matrix, self._miss]), limits, ridge=TINY**2)

    def _rows(self, coefficients: Floats, sag: Floats) -> Floats:
        """Weighted coefficients beyond tilt over weighted sag beyond the terms, for one shape or a column each."""
        weighted = (sag.T * self._weights).T
        beyond = weighted - self._terms @ (self._terms.T @ weighted)
        return np.concatenate([COEFFICIENT_WEIGHT * coefficients[FREE:], beyond])

    def _signals(self, start: Floats, change: Shape) -> Floats:
        # The programme bounds the signals themselves, so a change is asked for as the surface it leads to.
        return self._programme.solve(self._matrix @ start + self._rows(change.coefficients, change.sag))

    def correct(self, signals: Floats, error: Shape) -> Command:
        """As in the base class, with moves priced by what the actuators miss of them."""
        self._check(error)
        self._check_signals(signals)
        wanted = self._matrix @ signals - self._rows(error.coefficients, error.sag)
        return self.limited(self._correction.solve(np.concatenate([wanted, self._miss @ signals])))
