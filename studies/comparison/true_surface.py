"""The true surface of a simulation against targets, many at once: `compare.true_error` as matrix products."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dm_common import Floats
from dm_common.bounded import BoundedProgramme
from dm_common.limits import Limits
from dm_common.optics.zernike import PISTON_TILT, basis
from dm_controller.planning.target import FocusTarget
from studies.comparison.simulated_bench import SimulatedBench


class TrueSurface:
    """Errors of the true surface for displacements of one simulation; for judging only."""

    def __init__(self, bench: SimulatedBench) -> None:
        self._influence, self._figure = bench.true_influence()
        aperture = bench.aperture
        rows, columns = np.nonzero(np.isfinite(bench.true_map()))
        self._x = (columns.astype(float) - aperture.centre_x_px) / aperture.radius_px
        self._y = (aperture.centre_y_px - rows.astype(float)) / aperture.radius_px
        self._radius = aperture.radius_px * bench.pitch
        modes = basis(self._x, self._y)
        self._fit = np.linalg.solve(modes.T @ modes, modes.T)[PISTON_TILT:]
        self._plane = np.linalg.qr(modes[:, :PISTON_TILT])[0]
        self._stroke, self._limits = bench.true_stroke, bench.limits

    def _difference(self, displacements: Floats, targets: Sequence[FocusTarget]) -> Floats:
        """(V, R) true less wanted sag, piston and tilt removed, m."""
        wanted = np.column_stack([target.sag(self._x, self._y, self._radius) for target in targets])
        error = self._influence @ displacements.T + self._figure[:, None] - wanted
        return np.asarray(error - self._plane @ (self._plane.T @ error))

    def errors(self, displacements: Floats, targets: Sequence[FocusTarget]) -> tuple[Floats, Floats]:
        """Errors of the surfaces of `displacements` (R, N) m against the R `targets`.

        Returns:
            (R, K - 3) coefficient errors beyond tilt and (R,) rms sag error without piston and tilt, m.
        """
        error = self._difference(displacements, targets)
        return (self._fit @ error).T, np.sqrt(np.mean(np.square(error), axis=0))

    def limits(self, targets: Sequence[FocusTarget]) -> Floats:
        """(R,) m, rms sag error of the best displacements inside the stroke, see `compare.fitting_limits`."""
        matrix = self._influence * self._stroke
        matrix = matrix - self._plane @ (self._plane.T @ matrix)
        box = Limits(self._limits.low, self._limits.high, self._limits.pairs, self._limits.neighbour_difference)
        # No command reaches the part outside the span of the matrix: the small projected problem has the same solution.
        axes, triangle = np.linalg.qr(matrix)
        programme = BoundedProgramme(triangle, box, ridge=1e-26 * len(matrix))
        misses = -self._difference(np.zeros((len(targets), matrix.shape[1])), targets)
        inside = axes.T @ misses
        best = np.column_stack([programme.solve(column) for column in inside.T])
        return np.sqrt(np.mean(np.square(matrix @ best - misses), axis=0))
