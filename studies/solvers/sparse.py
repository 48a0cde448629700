"""Sparse sampling, Eqs. (4) and (5): few control patterns that make up the wanted change."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from dm_common import Floats
from dm_common.limits import Limits
from dm_common.optics.zernike import PISTON_TILT
from dm_controller.planning.mirror_model import InfluenceModel
from dm_controller.solvers.base import Command, Shape, Solver, normalised_terms

#: Cost of a unit of coefficient error (in units of the strongest pattern) relative to a unit of θ. An L1 penalty is
#: exact: above a certain price the coefficients are met exactly whenever the limits permit.
ERROR_PRICE = 1e4


class SparseSampling(Solver):
    """Δs = φθ with θ sparse, s_{N+1} = s_N + φθ_N (Eqs. 4 and 5), by basis pursuit.

    [1] leaves open what φ is. Two readings: the unit matrix (few actuators move) or patterns of all actuators
    (few patterns move). The first moves 18 single actuators, whose print-through ruins the surface; the second is
    taken. The patterns are the right singular vectors of the sag influence function, strongest first, each scaled to
    the same rms sag, so that the sparsest θ is also one of strong, smooth patterns.

    θ minimises ‖θ‖₁ + price ‖Δc - Gφθ‖₁ inside the limits: a linear programme (basis pursuit [13]) solved by HiGHS. It
    is always feasible, and meets Δc exactly where the limits permit.
    """

    name = "sparse_sampling"

    def __init__(self, model: InfluenceModel, limits: Limits) -> None:
        super().__init__(model, limits)
        matrix, self._factors = normalised_terms(model)
        weighted = np.sqrt(model.points.weight)[:, None] * model.influence_sag
        _, singular, right = np.linalg.svd(weighted, full_matrices=False)
        if not singular[0] > 0.0:
            raise ValueError("influence_sag is zero: no actuator moves the surface; calibrate first")
        self._scale = singular[0]
        #: (N, J) the patterns in columns, in signals per unit of θ.
        used = singular > 1e-6 * singular[0]
        self.patterns: Floats = right[used].T * (singular[0] / singular[used])
        count, actuators = self.patterns.shape[1], self.patterns.shape[0]
        terms = len(matrix)
        # Unknowns: θ+ , θ- , and positive and negative coefficient errors, all at least 0.
        response = matrix @ self.patterns / self._scale
        identity = np.eye(terms)
        self._equality = np.hstack([response, -response, identity, -identity])
        inside = [self.patterns]
        pairs = limits.pairs
        self._neighbours = limits.neighbours_can_bind
        if self._neighbours:
            inside.append(self.patterns[pairs[:, 0]] - self.patterns[pairs[:, 1]])
        rows = np.vstack(inside)
        one_side = np.hstack([rows, -rows, np.zeros((len(rows), 2 * terms))])
        self._inequality = np.vstack([one_side, -one_side])
        self._cost = np.concatenate([np.ones(2 * count), np.full(2 * terms, ERROR_PRICE)])
        self._sizes = (count, actuators)

    def _room(self, start: Floats) -> Floats:
        """Right-hand side of the inequalities: by how much each signal and difference may still rise, then fall."""
        limits = self.limits
        up, down = limits.high - start, start - limits.low
        if self._neighbours:
            differences = start[limits.pairs[:, 0]] - start[limits.pairs[:, 1]]
            up = np.concatenate([up, limits.neighbour_difference - differences])
            down = np.concatenate([down, limits.neighbour_difference + differences])
        return np.maximum(np.concatenate([up, down]), 0.0)

    def theta(self, start: Floats, change: Shape) -> Floats:
        """(J,) the sparse θ of Eq. (4) for `change`, from the signals `start` (N,)."""
        wanted = self._factors * change.coefficients[PISTON_TILT:] / self._scale
        # Scaled to its own answer: otherwise the solver's absolute tolerances would cut off small corrections.
        size = float(np.abs(wanted).max())
        if size == 0.0:
            return np.zeros(self._sizes[0])
        found = linprog(
            self._cost,
            A_ub=self._inequality,
            b_ub=self._room(start) / size,
            A_eq=self._equality,
            b_eq=wanted / size,
            method="highs",
        )
        if not found.success:
            raise ValueError(f"sparse sampling found no signals: {found.message}")
        count = self._sizes[0]
        return np.asarray(size * (found.x[:count] - found.x[count : 2 * count]))

    def _signals(self, start: Floats, change: Shape) -> Floats:
        inside: Command = self.limited(start)
        step: Floats = self.patterns @ self.theta(inside.signals, change)
        return inside.signals + step
