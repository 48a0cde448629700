"""The bounded programme as a solver: coefficients first, least sag beyond them, inside the limits."""

from __future__ import annotations

import numpy as np

from dm_common.bounded import BoundedProgramme
from dm_common.limits import Limits
from dm_controller.planning.mirror_model import CalibratedMirror, InfluenceModel
from dm_controller.solvers.base import Command, Floats, Shape, Solver, miss_rows

#: Ridge of a correction, m per unit signal: only for actuators without any influence, which stay where they are.
TINY = 1e-12


class Bounded(Solver):
    """Least squares inside the box: `CalibratedMirror` for shapes and corrections of any kind.

    The coefficients beyond tilt weigh so much that they act as equalities, the sag beyond the 21 terms is as small as
    possible, and the limits hold by construction: nothing is ever clipped. Corrections also weigh what
    actuators miss of their moves, see `miss_rows`.
    """

    name = "bounded"
    source = "bounded quadratic programme ([9], chapter 23)"

    def __init__(self, model: InfluenceModel, limits: Limits) -> None:
        super().__init__(model, limits)
        self._mirror = CalibratedMirror(model, limits)
        # A correction must not pull at signals that the error says nothing of: its rows price moves, not signals.
        self._miss = miss_rows(self._mirror.matrix)
        self._correction = BoundedProgramme(np.vstack([self._mirror.matrix, self._miss]), limits, ridge=TINY**2)

    def _signals(self, start: Floats, change: Shape) -> Floats:
        # The programme bounds the signals themselves, so a change is asked for as the surface it leads to.
        mirror = self._mirror
        return mirror.solve(mirror.matrix @ start + mirror.rows(change.coefficients, change.sag))

    def correct(self, signals: Floats, error: Shape) -> Command:
        """As in the base class, with moves priced by what the actuators miss of them."""
        self._check(error)
        self._check_signals(signals)
        wanted = self._mirror.matrix @ signals - self._mirror.rows(error.coefficients, error.sag)
        return self.limited(self._correction.solve(np.concatenate([wanted, self._miss @ signals])))
