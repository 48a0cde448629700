"""What all solvers have in common: shapes, commands, limits, and one correction step.

A solver knows a mirror by its influence function and does two things: it finds signals for a shape without measuring
(`solve`, open loop), and it improves signals by a measured error (`correct`, one step of a closed loop). Both need the
signals that change the surface by a given amount from a given start, so that is all that a method implements.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dm_common import Floats
from dm_common.limits import SLACK, Limits
from dm_common.optics.piston_tilt import remove_piston_tilt, rms
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS, basis
from dm_common.values import check_array
from dm_controller.planning.mirror_model import InfluenceModel, target_shape
from dm_controller.planning.target import FocusTarget, Shape

#: Share by which an actuator may miss a move: hysteresis of such piezos ([1], section 1: about 10 %).
MISS = 0.10


@dataclass(frozen=True, eq=False)
class Command:
    """Signals inside all limits.

    Attributes:
        signals: (N,) normalised.
        overflow: how far the signals that the method asked for lay outside the limits, normalised; 0 = nowhere. What
            was cut off is missing from the surface.
    """

    signals: Floats
    overflow: float = 0.0


def measured_shape(coefficients: Floats, sag: Floats, model: InfluenceModel) -> Shape:
    """A measured surface; sampling points without data take the sag of the 21 terms.

    Raises:
        ValueError: other numbers of terms or points than the model has.
    """
    if coefficients.shape != model.zernike_offset.shape or sag.shape != model.sag_offset.shape:
        raise ValueError(
            f"the map has {coefficients.size} terms and {sag.size} sampling points, the calibration has "
            f"{model.zernike_offset.size} and {model.sag_offset.size}: it was made with another interferometer node or "
            "version, calibrate anew"
        )
    terms = basis(model.points.x, model.points.y) @ coefficients
    return Shape(coefficients, np.where(np.isfinite(sag), sag, terms))


def rms_sag(shape: Shape, model: InfluenceModel) -> float:
    """Area-weighted rms sag of a shape, piston and tilt removed, m."""
    return float(rms(remove_piston_tilt(shape.sag[None, :], model.points), model.points.weight)[0])


class Solver(ABC):
    """One method on one mirror. See `dm_controller.solvers.registry` for all of them by name."""

    #: Name in messages, tables and files.
    name: ClassVar[str]

    def __init__(self, model: InfluenceModel, limits: Limits) -> None:
        """Prepare for a mirror.

        Raises:
            ValueError: the method cannot work on the model; the message says why.
        """
        self.model = model
        self.limits = limits
        self.offset = model.offset

    def solve(self, wanted: Shape) -> Command:
        """Signals for a surface, without measuring (open loop): from zero signals, which give the model's offset.

        Raises as `correct`.
        """
        self._check(wanted)
        return self.limited(self._signals(np.zeros(self.model.influence_zernike.shape[1]), wanted - self.offset))

    def command(self, target: FocusTarget) -> Command:
        """Signals for `target`, without measuring. Raises TargetError when no such surface exists over the aperture."""
        return self.solve(target_shape(target, self.model))

    def correct(self, signals: Floats, error: Shape) -> Command:
        """Better signals after `signals` were seen to leave `error` = measured minus wanted (one closed-loop step).

        Raises:
            ValueError: signals or a shape of other size than the model's, or not finite.
        """
        self._check(error)
        check_array("signals", signals, self.model.influence_zernike.shape[1:])
        return self.limited(self._corrected(signals, error))

    def _corrected(self, signals: Floats, error: Shape) -> Floats:
        """Better signals (N,), inside the limits or not."""
        return self._signals(signals, -error)

    @abstractmethod
    def _signals(self, start: Floats, change: Shape) -> Floats:
        """Signals (N,), inside the limits or not, that change the surface by `change` from where `start` holds it."""

    def _check(self, shape: Shape) -> None:
        check_array("coefficients", shape.coefficients, self.model.zernike_offset.shape)
        check_array("sag", shape.sag, self.model.sag_offset.shape)

    def limited(self, signals: Floats) -> Command:
        """Cut signals to the range, then draw them together about their mean until neighbours keep their limit."""
        limits = self.limits
        result = np.clip(signals, limits.low, limits.high)
        if not limits.allow_neighbours(result):
            result, _factor = limits.scaled(result)
        overflow = float(np.abs(signals - result).max())
        return Command(result, overflow if overflow > SLACK else 0.0)


def normalised_terms(model: InfluenceModel) -> tuple[Floats, Floats]:
    """The influence function without piston and tilt in rms-normalised terms, (K - 3, N), and the factors (K - 3,).

    A unit of each term is then the same rms sag, so that a norm of coefficients is an rms error.

    Raises:
        ValueError: no actuator moves any of these terms.
    """
    factors = TERM_RMS[PISTON_TILT : len(model.zernike_offset)]
    matrix = factors[:, None] * model.influence_zernike[PISTON_TILT:]
    if not matrix.any():
        raise ValueError("influence_zernike is zero: no actuator moves the surface; calibrate first")
    return matrix, factors


def miss_rows(matrix: Floats) -> Floats:
    """(N, N) rows that keep least squares from moves whose miss would cost more than they gain.

    When each actuator misses its move Δs_i by an independent share of MISS, the expected squared error of min|MΔs - b|²
    grows by MISS² Σ |M_i|² Δs_i², M_i the columns: rows MISS |M_i| under M. Without them a correction pursues sag that
    only large, opposed moves of neighbours can correct, and their misses disturb the low orders by more than is gained.
    """
    return np.diag(MISS * np.linalg.norm(matrix, axis=0))
