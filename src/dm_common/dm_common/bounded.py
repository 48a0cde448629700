"""Least squares inside the actuator limits: the range of every signal and the difference between neighbours.

    minimise   |M s - b|^2 + ridge |s|^2
    subject to low <= s_i <= high,   |s_i - s_j| <= d for neighbours i, j

M is factored once (M = Q R), so a solve works on N x N numbers, however many rows M has. The unconstrained solution is
taken if it lies inside all limits. Otherwise block principal pivoting [10] guesses which signals are at an end of their
range, solves for the others, and exchanges all signals on the wrong side at once; a few rounds usually reach the
optimum, where no signal is on the wrong side. If pivoting does not settle, or if the limit between neighbours can bind,
non-negative least squares solve the equivalent least-distance problem ([9], chapter 23), and the result is checked
against the optimality conditions. One signal enters per round, so time grows with saturation. If that check fails,
which happens only at condition numbers above 1e4, bounded-variable least squares (BVLS [11]) take over. BVLS alone take
many times longer, and with SciPy's default number of iterations they stop far from the optimum (measured on a PDM30-37:
13 nm rms instead of 6).

Clipping the unconstrained solution instead can double the residual of a saturated sphere.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dgels, dtrtrs
from scipy.optimize import lsq_linear, nnls

from dm_common import Bools, Floats
from dm_common.limits import SLACK, Limits

#: A signal (normalised) this close to an end of its range counts as bound there.
NEAR_LIMIT = 1e-5
#: Optimality: a gradient counts as zero up to this share of the largest gradient at zero signals.
OPTIMALITY = 1e-9
#: Maximum rounds of block pivoting, and rounds without progress (at least as many signals on the wrong side as in the
#: best round so far) after which the least-distance method takes over. Pivoting may cycle otherwise.
PIVOT_ROUNDS = 12
PIVOT_SETBACKS = 3
#: Gradient tolerance, as OPTIMALITY, for signals that are exactly at an end. Stricter: with condition numbers of 1e5 a
#: gradient of 1e-9 still leaves the wrong signals at an end (measured: 1 % of the range).
ROUNDING = 1e-13


class BoundedProgramme:
    """The quadratic programme of this module for one matrix and one set of limits.

    Args:
        matrix: (M, N), M >= N rows, or fewer with `ridge` > 0.
        limits: what the signals must satisfy.
        ridge: weight of |s|^2, in the squared unit of `matrix`.

    Raises:
        ValueError: the matrix is not finite or does not determine the signals.
    """

    def __init__(self, matrix: ArrayLike, limits: Limits, ridge: float = 0.0) -> None:
        rows = np.asarray(matrix, dtype=float)
        if rows.ndim != 2 or not np.isfinite(rows).all():
            raise ValueError(f"matrix of shape {rows.shape}: must be two-dimensional and finite")
        count = rows.shape[1]
        # Normalised by the largest entry, so that metres and nanometres give the same numerics.
        self._scale = float(np.abs(rows).max()) or 1.0
        stacked = np.vstack([rows / self._scale, np.sqrt(ridge) / self._scale * np.eye(count)])
        orthogonal, self._triangle = np.linalg.qr(stacked)
        self._projection = orthogonal[: len(rows)].T / self._scale
        diagonal = np.abs(np.diag(self._triangle))
        if len(stacked) < count or diagonal.min() <= 1e-12 * diagonal.max():
            raise ValueError("the matrix does not determine every signal; an actuator has no influence: use a ridge")
        self.limits = limits
        self._constraints, self._constraint_limits = self._linear_constraints(count)

    def _linear_constraints(self, count: int) -> tuple[Floats, Floats]:
        """The pair (C, c) of the constraints C y >= c - C q on y = R s - q, where q = Q^T b; see `_least_distance`."""
        limits, identity = self.limits, np.eye(count)
        pairs = limits.pairs if limits.neighbours_can_bind else limits.pairs[:0]
        differences = identity[pairs[:, 0]] - identity[pairs[:, 1]]
        constraints = np.vstack([identity, -identity, differences, -differences])
        bounds = np.concatenate(
            [
                np.full(count, limits.low),
                np.full(count, -limits.high),
                np.full(2 * len(differences), -limits.neighbour_difference),
            ]
        )
        return solve_triangular(self._triangle, constraints.T, trans="T").T, bounds

    def unlimited(self, wanted: Floats) -> Floats:
        """The best signals (N,) or (N, K) for right-hand sides (M,) or (M, K), as if there were no limits."""
        return np.asarray(solve_triangular(self._triangle, self._projection @ wanted))

    def solve(self, wanted: ArrayLike) -> Floats:
        """Return the best signals (N,) for the right-hand side `wanted` (M,).

        Raises:
            ValueError: `wanted` has another length than the matrix has rows, or is not finite.
        """
        target = np.asarray(wanted, dtype=float)
        if target.shape != (self._projection.shape[1],) or not np.isfinite(target).all():
            raise ValueError(f"right-hand side: must be {self._projection.shape[1]} finite numbers")
        projected = self._projection @ target
        # The triangle is known to be regular: the checks of `solve_triangular` would take longer than this.
        signals: Floats = dtrtrs(self._triangle, projected)[0]
        if self.limits.allow(signals):
            return signals
        if not self.limits.neighbours_can_bind:
            pivoted = self._pivoted(signals, projected)
            if pivoted is not None:
                return pivoted
        signals = self._least_distance(projected)
        if self.limits.neighbours_can_bind:
            # An ill-conditioned problem leaves signals up to 1e-8 beyond a limit, which the driver would refuse.
            return self.limits.scaled(signals)[0]
        signals = np.clip(signals, self.limits.low, self.limits.high)
        signals = self._polished(signals, projected)
        if not self._optimal(signals, projected):
            ends = (self.limits.low, self.limits.high)
            signals = lsq_linear(self._triangle, projected, ends, "bvls", tol=1e-14, max_iter=50 * len(signals)).x
        return np.clip(signals, self.limits.low, self.limits.high)

    def _pivoted(self, unconstrained: Floats, projected: Floats) -> Floats | None:
        """The optimum inside the range by block principal pivoting; None when it does not settle."""
        low, high, triangle = self.limits.low, self.limits.high, self._triangle
        tolerance = ROUNDING * np.abs(triangle.T @ projected).max()
        at_low, at_high = unconstrained < low, unconstrained > high
        fewest, setbacks = len(unconstrained) + 1, 0
        for _round in range(PIVOT_ROUNDS):
            signals = self._with_bound(at_low, at_high, projected)
            gradient = triangle.T @ (triangle @ signals - projected)
            # A bound signal stays bound while the gradient pushes it outwards; a free one stays free inside the range.
            below = np.where(at_low, gradient > -tolerance, signals < low - SLACK)
            above = np.where(at_high, gradient < tolerance, signals > high + SLACK)
            wrong = int(np.count_nonzero(below != at_low) + np.count_nonzero(above != at_high))
            if wrong == 0:
                return np.clip(signals, low, high)
            setbacks += wrong >= fewest
            if setbacks == PIVOT_SETBACKS:
                return None
            fewest = min(fewest, wrong)
            at_low, at_high = below, above
        return None

    def _with_bound(self, at_low: Bools, at_high: Bools, projected: Floats) -> Floats:
        """Signals (N,) with the marked ones at an end of the range and the least-squares solution for the others."""
        signals = np.where(at_low, self.limits.low, np.where(at_high, self.limits.high, 0.0))
        free = ~(at_low | at_high)
        count = int(np.count_nonzero(free))
        if count:
            # Columns of a regular triangle are independent, so plain QR does; `lstsq` takes several times as long.
            _factors, solution, _info = dgels(self._triangle[:, free], projected - self._triangle @ signals)
            signals[free] = solution[:count]
        return signals

    def _optimal(self, signals: Floats, projected: Floats) -> bool:
        """Whether the gradient vanishes for signals inside the range, and pushes outwards for those at an end."""
        gradient = self._triangle.T @ (self._triangle @ signals - projected)
        inward = np.where(signals <= self.limits.low, -gradient, np.where(signals >= self.limits.high, gradient, 0.0))
        inside = (signals > self.limits.low) & (signals < self.limits.high)
        worst = np.abs(gradient[inside]).max(initial=inward.max(initial=0.0))
        return bool(worst <= OPTIMALITY * np.abs(self._triangle.T @ projected).max())

    def _polished(self, signals: Floats, projected: Floats) -> Floats:
        """Put the signals that are at an end of the range exactly there and solve for the others once more.

        `_least_distance` finds the multipliers only to the accuracy of an ill-conditioned problem. Once the set of
        bound signals is known, the rest is ordinary least squares.
        """
        middle = self.limits.middle
        ends = np.where(signals < middle, self.limits.low, self.limits.high)
        bound = np.abs(signals - ends) < NEAR_LIMIT
        result = self._with_bound(bound & (signals < middle), bound & (signals >= middle), projected)
        return result if self.limits.allow(result) else signals

    def _least_distance(self, projected: Floats) -> Floats:
        """Problem LDP of [9]: the shortest y = R s - q that satisfies all constraints; `projected` is q = Q^T b."""
        right = self._constraint_limits - self._constraints @ projected
        size = max(float(np.abs(right).max()), 1.0)  # scaled, so that a distant target does not cost digits
        system = np.vstack([self._constraints.T, right / size])
        unit = np.zeros(len(system))
        unit[-1] = 1.0
        multipliers, _norm = nnls(system, unit, maxiter=20 * len(right))
        residual = system @ multipliers - unit
        signals: Floats = solve_triangular(self._triangle, projected - size * residual[:-1] / residual[-1])
        return signals
