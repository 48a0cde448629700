"""An analytic plate in place of a calibration: influence functions from mechanics alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from dm_common import Floats
from dm_common.limits import Limits
from dm_common.optics.piston_tilt import remove_piston_tilt, weighted_fit
from dm_common.optics.zernike import PISTON_TILT, basis
from dm_controller.planning.mirror_model import InfluenceModel
from dm_controller.solvers.base import Shape, Solver, normalised_terms
from dm_controller.solvers.least_squares import CUTOFF


@dataclass(frozen=True)
class PlateProperties:
    """Data-sheet values of the faceplate and its actuators; only the ratio of the stiffnesses matters.

    Attributes:
        thickness: m.
        youngs_modulus: Pa (glass).
        poisson_ratio: of the plate.
        actuator_stiffness: N/m, each.
    """

    thickness: float = 2.4e-3
    youngs_modulus: float = 72e9
    poisson_ratio: float = 0.2
    actuator_stiffness: float = 2e7

    def __post_init__(self) -> None:
        for name in ("thickness", "youngs_modulus", "actuator_stiffness"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"plate: {name} = {value:g}: must be above 0 and finite (SI units)")
        if not -1.0 < self.poisson_ratio < 0.5:
            raise ValueError(f"plate: poisson_ratio = {self.poisson_ratio:g}: must be -1 to 0.5")

    @property
    def rigidity(self) -> float:
        """Flexural rigidity D = E h³ / 12(1 - ν²), N m."""
        return self.youngs_modulus * self.thickness**3 / (12.0 * (1.0 - self.poisson_ratio**2))


def _point_load(distance: Floats) -> Floats:
    """r² ln r / 8π, the Green's function of the biharmonic equation."""
    return np.where(distance > 0, distance**2 * np.log(np.maximum(distance, 1e-30)), 0.0) / (8.0 * np.pi)


def plate_influence(at: Floats, actuators: Floats, properties: PlateProperties) -> Floats:
    """Sag of an unbounded thin plate on springs per unit move of each spring's base.

    Each spring presses with F_j = k (d_j - w(x_j)); the plate answers D ∇⁴w = Σ F_j δ(x - x_j), so w is a sum of r² ln
    r / 8πD and a plane, with forces and moments in balance (a thin-plate spline on elastic supports; [8] has it as the
    response of a continuous-faceplate mirror). The edge of a real plate is missing.

    Args:
        at: (P, 2) points, m.
        actuators: (N, 2) positions, m.

    Returns:
        (P, N), m per m.
    """
    count = len(actuators)
    # Lengths in units of the layout keep the system well conditioned.
    unit = float(np.abs(actuators).max()) or 1.0
    springs, points = actuators / unit, at / unit
    compliance = properties.rigidity / (properties.actuator_stiffness * unit**2)
    plane = np.column_stack([np.ones(count), springs])
    system = np.zeros((count + 3, count + 3))
    system[:count, :count] = _point_load(cdist(springs, springs)) + compliance * np.eye(count)
    system[:count, count:] = plane
    system[count:, :count] = plane.T
    right = np.vstack([np.eye(count), np.zeros((3, count))])
    solved = np.linalg.solve(system, right)
    field = np.hstack([_point_load(cdist(points, springs)), np.ones((len(points), 1)), points])
    return np.asarray(field @ solved)


class PlateModel(Solver):
    """Δs from the analytic solution of a simplified mechanical model ([1], introduction, its reference 22).

    Needs no influence function, only the positions of the actuators and one number, the stroke: the best-fitting scale
    to the calibration. The model knows neither the figure of the unpowered mirror nor the gain of each actuator, so
    their errors stay in an open-loop surface ("the surface shape residual is not corrected", section 1).
    """

    name = "plate_model"

    def __init__(
        self,
        model: InfluenceModel,
        limits: Limits,
        actuator_x: Floats,
        actuator_y: Floats,
        properties: PlateProperties | None = None,
    ) -> None:
        """`actuator_x`, `actuator_y`: (N,) m, in the frame of the maps."""
        super().__init__(model, limits)
        count = model.influence_zernike.shape[1]
        if actuator_x.shape != (count,) or actuator_y.shape != (count,):
            raise ValueError(
                f"actuator_x, actuator_y: {actuator_x.size} and {actuator_y.size} values, must be {count} each, one "
                "per actuator of the calibration"
            )
        points = model.points
        places = model.aperture_radius * np.column_stack([points.x, points.y])
        sag = plate_influence(places, np.column_stack([actuator_x, actuator_y]), properties or PlateProperties())
        sag = remove_piston_tilt(sag.T, points).T
        measured = remove_piston_tilt(model.influence_sag.T, points).T
        weight = points.weight[:, None]
        #: m of stroke per unit signal: the best common factor between mechanics and calibration.
        self.stroke = float((weight * sag * measured).sum() / (weight * sag**2).sum())
        #: (K, N) m per unit signal.
        self.influence: Floats = self.stroke * weighted_fit(sag.T, basis(points.x, points.y), points.weight).T
        _, self._factors = normalised_terms(model)
        self._inverse = np.linalg.pinv(self._factors[:, None] * self.influence[PISTON_TILT:], rcond=CUTOFF)
        self.offset = Shape(np.zeros_like(model.zernike_offset), np.zeros_like(model.sag_offset))

    def _signals(self, start: Floats, change: Shape) -> Floats:
        step: Floats = self._inverse @ (self._factors * change.coefficients[PISTON_TILT:])
        return start + step
