"""The defect of a model, measured minus predicted surface, as a field over effective signals, found from maps.

Neighbouring shapes have nearly the same defect, so the defect of a shape is estimated from all rounds of maps
(`planning.recipes.Kriging`), each weighted by the noise of its maps.
"""

import math
from collections.abc import Sequence

import numpy as np

from dm_common import Floats
from dm_common.optics.zernike import PISTON_TILT
from dm_controller.planning.mirror_model import InfluenceModel
from dm_controller.planning.recipes import Kriging
from dm_controller.solvers.base import Shape

#: Lower bound of the standard deviation of a mean of maps, m.
SIGMA_MIN = 1e-12
#: A map farther from the median of its round than FAR times the median distance and than FAR_MIN (m) is an outlier: a
#: door slammed, or it shows an earlier surface. Rounds of fewer than FEW maps keep all.
FAR, FAR_MIN, FEW = 4.0, 2e-9, 4


def mean_of(shapes: Sequence[Shape]) -> Shape:
    """The mean of surfaces."""
    return Shape(
        np.mean([shape.coefficients for shape in shapes], axis=0), np.mean([shape.sag for shape in shapes], axis=0)
    )


def agreeing_maps(maps: Sequence[Shape]) -> list[Shape]:
    """The maps of one round without outliers."""
    coefficients = np.array([shape.coefficients[PISTON_TILT:] for shape in maps])
    away = np.linalg.norm(coefficients - np.median(coefficients, axis=0), axis=1)
    limit = max(FAR * float(np.median(away)), FAR_MIN)
    return [shape for shape, distance in zip(maps, away, strict=True) if distance <= limit or len(maps) < FEW]


class Defects:
    """The defects of `model` found in the rounds of one run."""

    def __init__(self, model: InfluenceModel) -> None:
        self._none = Shape(np.zeros_like(model.zernike_offset), np.zeros_like(model.sag_offset))
        self._aims: list[Floats] = []
        self._means: list[Shape] = []
        self._maps: list[int] = []
        # Sums of squares (K - 3,) of the deviations of maps from their round's mean, and their degrees of freedom.
        self._scatter, self._freedom = np.zeros(len(model.zernike_offset) - PISTON_TILT), 0

    def add(self, aim: Floats, maps: Sequence[Shape]) -> None:
        """Take a round: the defects that its maps show at the effective signals `aim` (N,)."""
        self._scatter, self._freedom = self._scattered(maps)
        self._aims.append(aim)
        self._means.append(mean_of(maps))
        self._maps.append(len(maps))

    def spread(self, maps: Sequence[Shape]) -> float:
        """Standard deviation, m, of the worst coefficient of the mean of a round, from the scatter of all maps."""
        scatter, freedom = self._scattered(maps)
        return math.sqrt(scatter.max() / max(freedom, 1) / len(maps))

    def _scattered(self, maps: Sequence[Shape]) -> tuple[Floats, int]:
        coefficients = np.array([shape.coefficients[PISTON_TILT:] for shape in maps])
        squares = np.square(coefficients - coefficients.mean(axis=0)).sum(axis=0)
        return self._scatter + squares, self._freedom + len(maps) - 1

    def at(self, aim: Floats) -> Shape:
        """The defect to expect at the effective signals `aim` (N,); none before the first round."""
        if not self._means:
            return self._none
        coefficients = np.array([shape.coefficients for shape in self._means])
        size = max(float(np.mean(np.square(coefficients[:, PISTON_TILT:]))), SIGMA_MIN**2)
        noise = self._scatter.mean() / max(self._freedom, 1) / np.array(self._maps) + SIGMA_MIN**2
        weights, _ = Kriging(np.array(self._aims), noise / size).at(aim)
        return Shape(weights @ coefficients, weights @ np.array([shape.sag for shape in self._means]))
