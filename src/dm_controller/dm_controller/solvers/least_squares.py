"""The methods that closed loops offer: least squares, with and without the limits of the actuators."""

import numpy as np
from numpy.typing import ArrayLike

from dm_common import Floats
from dm_common.bounded import BoundedProgramme
from dm_common.limits import Limits
from dm_common.optics.piston_tilt import remove_piston_tilt
from dm_common.optics.sample_regions import AREA_FRACTIONS, command_row_weights
from dm_common.optics.zernike import PISTON_TILT
from dm_controller.planning.mirror_model import CalibratedMirror, InfluenceModel, reduced
from dm_controller.planning.target import FocusTarget
from dm_controller.solvers.base import Command, Shape, Solver, miss_rows, normalised_terms

#: Singular values below this share of the largest are left out: they would turn noise into signals.
CUTOFF = 1e-3
#: β relative to the squared largest singular value of G: the price of a signal change.
BETA = 1e-3
#: Ridge of a correction, m per unit signal: only for actuators without any influence, which stay where they are.
TINY = 1e-12


class PseudoInverse(Solver):
    """Δs = G⁺ Δc by singular value decomposition ([1], introduction, its reference 18).

    The shortest of all signals that give the wanted coefficients beyond tilt. It is not kept inside the range ("severe
    overflow of the control voltage", section 1), so it is clipped and reports by how much; the sag beyond the terms is
    not minimised.
    """

    name = "pseudo_inverse"

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


class IterativeLearning(PseudoInverse):
    """s_{k+1} = s_k + L e_k, L = (GᵀG + β)⁻¹Gᵀ (iterative learning control, references 12 and 13 of [1]).

    [1] names the method, its about three iterations and the effect of β ("by decreasing β, we increase the convergence
    speed", section 2.2), but gives no formula. Norm-optimal learning, min ‖e - GΔs‖² + β‖Δs‖² in each repetition [12],
    is the form in which a β has just that effect. It lies between steepest descent (large β) and the pseudo-inverse
    (β = 0): weak modes are learned over several maps, so that noise and a wrong G disturb them less.
    """

    name = "iterative_learning"

    def __init__(self, model: InfluenceModel, limits: Limits, beta: float = BETA) -> None:
        if not (np.isfinite(beta) and beta > 0.0):
            raise ValueError(f"beta = {beta:g}: must be above 0 and finite; 0.001 is the default")
        super().__init__(model, limits)
        left, singular, right = np.linalg.svd(normalised_terms(model)[0], full_matrices=False)
        self._inverse = (right.T * (singular / (singular**2 + beta * singular[0] ** 2))) @ left.T


class AZWreg(Solver):
    """min over Δs of ‖W(Δz - HΔs)‖ on the sag points, W of Eq. (8); place (b) of `dm_calibration.influence.weights`.

    On the coefficient vector W would cancel or act on coefficients, not regions; on the sag points, which outnumber
    the actuators, a smaller weight lets a region keep more of the error. Piston and tilt are free: three columns of
    their own in the weighted problem. Least squares as in Eq. (7), so the result is clipped and reports the overflow.
    Corrections also weigh the expected misses of the actuators, see `miss_rows`.
    """

    name = "AZWreg"

    def __init__(self, model: InfluenceModel, limits: Limits, region_weights: ArrayLike | None = None) -> None:
        """`region_weights`: (10,) Eq. (8), from the centre outwards; None = all equal."""
        super().__init__(model, limits)
        weights = np.ones(len(AREA_FRACTIONS)) if region_weights is None else np.asarray(region_weights, dtype=float)
        points = model.points
        self._row = command_row_weights(points, weights)
        plane = self._row[:, None] * np.column_stack([np.ones(len(points)), points.x, points.y])
        self._plane = np.linalg.qr(plane)[0]
        influence = remove_piston_tilt(model.influence_sag.T, points).T
        matrix = reduced(influence, self._row, self._plane)
        if not matrix.any():
            raise ValueError("influence_sag is zero: no actuator moves the surface; calibrate first")
        self._inverse = np.linalg.pinv(matrix, rcond=CUTOFF)
        self._correction = np.linalg.pinv(np.vstack([matrix, miss_rows(matrix)]))[:, : len(matrix)]

    def _signals(self, start: Floats, change: Shape) -> Floats:
        step: Floats = self._inverse @ reduced(change.sag, self._row, self._plane)
        return start + step

    def _corrected(self, signals: Floats, error: Shape) -> Floats:
        """Weighs moves by the expected misses of the actuators."""
        better: Floats = signals - self._correction @ reduced(error.sag, self._row, self._plane)
        return better


class Bounded(Solver):
    """Least squares inside the box ([9], chapter 23): `CalibratedMirror` for shapes and corrections of any kind.

    The coefficients beyond tilt weigh so much that they act as equalities, the sag beyond the 21 terms is as small as
    possible, and the limits hold by construction: nothing is ever clipped. Corrections also weigh the expected misses
    of the actuators, see `miss_rows`.
    """

    name = "bounded"

    def __init__(self, model: InfluenceModel, limits: Limits, mirror: CalibratedMirror | None = None) -> None:
        """`mirror`: for that model and those limits; it knows whether tilt is held and about which axis."""
        super().__init__(model, limits)
        self._mirror = mirror or CalibratedMirror(model, limits)
        # A correction must not change signals that have no effect on the error: its rows weigh moves, not signals.
        self._miss = miss_rows(self._mirror.matrix)
        self._correction = BoundedProgramme(np.vstack([self._mirror.matrix, self._miss]), limits, ridge=TINY**2)

    def command(self, target: FocusTarget) -> Command:
        """Includes the tilt of the target; corrections leave the tilt as it is."""
        return Command(self._mirror.command(target)[0])

    def _signals(self, start: Floats, change: Shape) -> Floats:
        # The programme bounds the signals themselves, so a change is expressed as the surface it leads to.
        mirror = self._mirror
        return mirror.solve(mirror.matrix @ start + mirror.rows(change))

    def _corrected(self, signals: Floats, error: Shape) -> Floats:
        """Weighs moves by the expected misses of the actuators."""
        wanted = self._mirror.matrix @ signals - self._mirror.rows(error)
        return self._correction.solve(np.concatenate([wanted, self._miss @ signals]))
