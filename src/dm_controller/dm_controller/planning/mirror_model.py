"""A calibrated mirror: predicts the surface of a command and finds the command of a surface, before anything moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from dm_common import SIGMAS_95, Bools, Floats
from dm_common.bounded import BoundedProgramme
from dm_common.limits import Limits
from dm_common.optics.conic import reachable_range
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS, TERMS, basis, curvature_of_defocus, tilt_influence
from dm_common.values import check_array
from dm_controller.planning.target import FocusTarget, Shape, TargetError

if TYPE_CHECKING:
    from dm_common.optics.sampling import SamplePoints

#: Weight of a coefficient relative to the sag beyond the terms. Large enough to act as an equality while the limits
#: permit one (coefficients match to 1e-4 of the rest), small enough to stay well conditioned when they do not.
COEFFICIENT_WEIGHT = 100.0
#: Combinations of coefficients that actuators move less than this, relative to the best one, are not made equal: with
#: 19 actuators 3 of 18 are below 2e-4, the others above 0.09; with 37 all are above 0.1.
LEAST_AUTHORITY = 0.01
#: Ridge on the signals, as a share of a typical actuator's rms response. On a simulated PDM30-37 it costs less than
#: 1 % of the predicted residual and cuts the largest signal of a 0.02 1/m sphere from 1.0 to 0.3.
RIDGE_SHARE = 0.01
#: The same if an actuator has no effect: otherwise all others on its side of the mirror go to their limits to hide it.
RIDGE_SHARE_STUCK = 0.1
#: Weight of held tilt relative to the sag beyond the terms: less than that of the coefficients, so that the shape has
#: precedence where a limit binds.
TILT_WEIGHT = 10.0
#: Tilt at the edge, as a share of the largest response, below which the maps hold none; an actuator makes 1.5.
LEAST_TILT = 0.05


@dataclass(frozen=True)
class InfluenceModel:
    """The description of a mirror by its calibration; see dm_msgs/Calibration for the fields.

    Shapes: N actuators, K Zernike terms, P sampling points.

    Raises:
        ValueError: shapes disagree or a number is not finite.
    """

    aperture_radius: float
    influence_zernike: Floats  # (K, N) m per unit signal
    zernike_offset: Floats  # (K,) m
    points: SamplePoints
    influence_sag: Floats  # (P, N) m per unit signal
    sag_offset: Floats  # (P,) m
    held_out_rms: float  # m
    held_out_max_zernike: float  # m
    actuator_x: Floats | None = None  # (N,) m; None = tilt cannot be held
    actuator_y: Floats | None = None

    def __post_init__(self) -> None:
        terms, points, actuators = len(TERMS), len(self.points), self.influence_zernike.shape[1]
        expected = {
            "influence_zernike": (terms, actuators),
            "zernike_offset": (terms,),
            "influence_sag": (points, actuators),
            "sag_offset": (points,),
        }
        for axis in ("x", "y", "weight"):
            check_array(f"calibration: sample_{axis}", getattr(self.points, axis), (points,))
        for name, shape in expected.items():
            check_array(f"calibration: {name}", getattr(self, name), shape)
        if not self.aperture_radius > 0:
            raise ValueError(f"calibration: aperture_radius = {self.aperture_radius:g}: must be positive")

    @property
    def offset(self) -> Shape:
        """The surface at zero signals."""
        return Shape(self.zernike_offset, self.sag_offset)


def response(model: InfluenceModel, change: Floats) -> Shape:
    """Change of the surface, by the model, due to a change of effective signals (N,)."""
    return Shape(model.influence_zernike @ change, model.influence_sag @ change)


def target_shape(target: FocusTarget, model: InfluenceModel) -> Shape:
    """The wanted surface over the aperture of `model`.

    Raises:
        TargetError: no such surface exists over the aperture.
    """
    radius = model.aperture_radius
    return Shape(target.coefficients(radius), target.sag(model.points.x, model.points.y, radius))


@dataclass(frozen=True)
class Plan:
    """A command and its expected result.

    Lengths in m; `lower` and `upper` are 95 % bounds that include the calibration's held-out error.
    """

    signals: Floats
    rms: float
    rms_lower: float
    rms_upper: float
    max_zernike: float
    max_zernike_upper: float
    saturated: Bools
    most: str = ""  # main source of the bound, where that is much more than the calibration's own error


def rms_bounds(rms: float, spread: float) -> tuple[float, float]:
    """95 % interval of an rms, m, when an independent error with the rms `spread` (m) is added in squares."""
    reach = (SIGMAS_95 * spread) ** 2
    return math.sqrt(max(rms**2 - reach, 0.0)), math.sqrt(rms**2 + reach)


def coefficient_rows(influence: Floats) -> Floats:
    """(K - 3, K - 3) rows that weigh coefficients beyond tilt: COEFFICIENT_WEIGHT where the actuators have authority.

    Args:
        influence: (K - 3, N) m per unit signal.
    """
    rms = TERM_RMS[PISTON_TILT : PISTON_TILT + len(influence)]
    modes, authority, _ = np.linalg.svd(rms[:, None] * influence)
    weak = np.ones(len(influence), dtype=np.bool_)
    weak[: len(authority)] = authority < LEAST_AUTHORITY * authority[0]
    if not weak.any():
        return COEFFICIENT_WEIGHT * np.eye(len(influence))
    # Without authority a unit is the rms sag that it stands for, as in the sag rows below.
    rows: Floats = np.where(weak, 1.0, COEFFICIENT_WEIGHT)[:, None] * modes.T * rms
    return rows


def reduced(sag: Floats, weights: Floats, removed: Floats) -> Floats:
    """Sag (P,) or (P, N) times `weights` (P,), with the span of `removed` (P, k, orthonormal) projected out."""
    weighted = (sag.T * weights).T
    result: Floats = weighted - removed @ (removed.T @ weighted)
    return result


class CalibratedMirror:
    """Solves focus targets on an influence model inside limits.

    The command makes the coefficients beyond tilt equal to the wanted ones, makes the sag beyond the terms as small as
    possible, leaves piston free, and keeps all limits. With `hold_tilt` it keeps the tilt at its value at zero signals,
    so that the picture of a camera stands still while the focus changes; otherwise tilt is free too. A target's own
    tilt is added. A camera whose axis meets the mirror beside the middle sees the slope of a sphere there; the opposite
    tilt puts the vertex on the axis. Where the limits forbid equality the command is the closest in the weighted
    least-squares sense. A mirror of few actuators moves fewer combinations of coefficients than there are; the others
    are weighted as the sag they are (measured with 19 actuators: 8 nm rms are left instead of 97, and no signal
    saturates). A small ridge keeps actuators that the aperture hardly sees from running to their limits for nothing.

    Args:
        hold_tilt: hold the tilt, if the model has the actuators' positions and its maps show their tilt.
        axis: (2,) m, x and y of where the camera's axis meets the mirror.

    Attributes:
        matrix: (R, N), `rows` of the influence function.
        tilt: (2, N) m per unit signal, of the two tilts that are held; None = they are free.
        ridge: weight of the squared signals relative to the squared rows.
        sag_root: (N, N), m: the norm of its product with signals is their rms sag, piston and tilt removed.
    """

    def __init__(
        self, model: InfluenceModel, limits: Limits, hold_tilt: bool = True, axis: Sequence[float] = (0.0, 0.0)
    ) -> None:
        self.model, self.limits, self.axis = model, limits, np.array(axis, dtype=float)
        self._weights = np.sqrt(model.points.weight)
        self._terms = np.linalg.qr(self._weights[:, None] * basis(model.points.x, model.points.y))[0]
        self._coefficient_rows = coefficient_rows(model.influence_zernike[PISTON_TILT:])
        bent = reduced(model.influence_sag, self._weights, self._terms[:, :PISTON_TILT])
        self.sag_root: Floats = np.linalg.qr(bent)[1]
        response = np.linalg.norm(bent, axis=0)
        self.tilt = None
        if hold_tilt and model.actuator_x is not None and model.actuator_y is not None:
            places = np.array([model.actuator_x, model.actuator_y]) / model.aperture_radius
            tilt = tilt_influence(model.influence_zernike[1:PISTON_TILT], places, response)
            self.tilt = tilt if np.abs(tilt).max() > LEAST_TILT * response.max() else None
        self.matrix = self.rows(Shape(model.influence_zernike, model.influence_sag), self.tilt)
        if not (moving := response[response > 0.0]).size:
            raise ValueError("calibration: no actuator moves the surface")
        share = RIDGE_SHARE if len(moving) == len(response) else RIDGE_SHARE_STUCK
        self.ridge = (share * float(np.median(moving))) ** 2
        self._programme = BoundedProgramme(self.matrix, limits, ridge=self.ridge)
        self._range_cached = lru_cache(maxsize=64)(self._find_range)

    def rows(self, shape: Shape, tilt: Floats | None = None) -> Floats:
        """Rows of a surface in the programme: weighted coefficients beyond tilt, then weighted sag beyond the terms.

        If tilt is held, two rows for the wanted tilt come first, whatever tilt was measured.

        Args:
            shape: the surface, or one in each column.
            tilt: (2,) or (2, N) m, wanted; None = as it is at zero signals.

        Returns:
            (R,) or (R, N); R = K - 3 + P, and 2 more where tilt is held.
        """
        weighted = self._coefficient_rows @ shape.coefficients[PISTON_TILT:]
        tilt_rows = np.zeros((0 if self.tilt is None else 2, *weighted.shape[1:]))
        if tilt is not None and self.tilt is not None:
            tilt_rows = TILT_WEIGHT * tilt
        return np.concatenate([tilt_rows, weighted, reduced(shape.sag, self._weights, self._terms)])

    def solve(self, rows: Floats) -> Floats:
        """The signals (N,) inside the limits whose `matrix @ signals` comes nearest to `rows`.

        Raises:
            ValueError: another number of rows than `matrix` has, or not finite.
        """
        return self._programme.solve(rows)

    def plan(self, target: FocusTarget) -> Plan:
        """Find the command for `target` and predict its error. Raises as `target_shape`."""
        return self.predict(target, self.command(target)[0])

    def command(self, target: FocusTarget) -> tuple[Floats, float]:
        """The command (N,) for `target`, and the largest coefficient error it leaves, m. Raises as `target_shape`."""
        wanted, tilt = self.wanted(target)
        signals = self.solve(self.rows(wanted, tilt))
        return signals, (response(self.model, signals) - wanted).max_zernike

    def unlimited(self, shape: Shape, tilt: Floats) -> Floats:
        """Commands (N, M) for `rows` of a surface in each of M columns and of tilt (2, M), m, without any limit."""
        return self._programme.unlimited(self.rows(shape, tilt))

    def predict(self, target: FocusTarget, signals: Floats) -> Plan:
        """What `signals` (N,) are expected to do when `target` is wanted. Raises as `target_shape`."""
        model = self.model
        error = response(model, signals) - self.wanted(target)[0]
        rms = float(np.linalg.norm(reduced(error.sag, self._weights, self._terms[:, :PISTON_TILT])))
        lower, upper = rms_bounds(rms, model.held_out_rms)
        return Plan(
            signals=signals,
            rms=rms,
            rms_lower=lower,
            rms_upper=upper,
            max_zernike=error.max_zernike,
            max_zernike_upper=error.max_zernike + model.held_out_max_zernike,
            saturated=self.limits.at_limit(signals),
        )

    def wanted(self, target: FocusTarget) -> tuple[Shape, Floats]:
        """The surface of `target` minus that at zero signals; its tilt minus that of its sphere on the axis, (2,) m.

        Raises as `target_shape`.
        """
        model = self.model
        own = np.array(target.zernike[1:PISTON_TILT]) if target.zernike else np.zeros(2)
        return target_shape(target, model) - model.offset, own - target.curvature * model.aperture_radius * self.axis

    def reachable_range(self, target: FocusTarget, tolerance: float) -> tuple[float, float]:
        """Smallest and largest curvature [1/m] with the target's conic constant and added terms that the limits permit.

        Reachable means: the model's largest coefficient error stays below `tolerance` [m]. Returns (nan, nan) when
        neither curvature 0 nor that in mid range is (for example with large added terms).
        """
        return self._range_cached(target.with_curvature(0.0), tolerance)

    def _find_range(self, target: FocusTarget, tolerance: float) -> tuple[float, float]:
        model = self.model
        defocus = model.zernike_offset[3] + self.limits.middle * model.influence_zernike[3].sum()
        middle = curvature_of_defocus(float(defocus), model.aperture_radius)
        swing = (self.limits.high - self.limits.low) * np.abs(model.influence_zernike[3]).sum()
        stroke = curvature_of_defocus(float(swing), model.aperture_radius)

        def reached(curvature: float) -> bool:
            try:
                return self.command(target.with_curvature(curvature))[1] <= tolerance
            except TargetError:  # a conic of this curvature ends before the edge of the aperture
                return False

        return reachable_range(reached, middle, stroke, 1e-5)
