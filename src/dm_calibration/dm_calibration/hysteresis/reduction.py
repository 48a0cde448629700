"""A map in few numbers of like meaning: coefficients beyond tilt, and patterns of the sag beyond the terms."""

import numpy as np
from numpy.typing import NDArray

from dm_common.optics.piston_tilt import remove_piston_tilt
from dm_common.optics.sampling import SamplePoints
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS, basis

Floats = NDArray[np.float64]

#: Patterns weaker than this share of the strongest are noise.
WEAKEST_PATTERN = 0.03


class Reduction:
    """Between K coefficients with sag at P points, and R = K - 3 + B values in m rms.

    The first K - 3 values are coefficients beyond tilt, each as the rms sag of its term; the others are amplitudes of
    the B patterns that a mirror's N actuators show beyond the terms, strongest first.

    Args:
        influence_sag: (P, N) m per unit signal.
        terms: K.
    """

    def __init__(self, points: SamplePoints, influence_sag: Floats, terms: int) -> None:
        self._points = points
        self._weight = np.sqrt(points.weight)
        self._modes = basis(points.x, points.y)[:, PISTON_TILT:terms]
        self._terms = np.linalg.qr(self._weight[:, None] * basis(points.x, points.y))[0]
        self._scale = TERM_RMS[PISTON_TILT:terms]
        _, strength, patterns = np.linalg.svd(self._beyond(influence_sag.T), full_matrices=False)
        self._patterns = patterns[strength > WEAKEST_PATTERN * strength[0]]

    @property
    def coefficients(self) -> int:
        """K - 3."""
        return len(self._scale)

    @property
    def size(self) -> int:
        """R."""
        return len(self._scale) + len(self._patterns)

    def _beyond(self, sag: Floats) -> Floats:
        """(..., P) weighted sag without the terms."""
        weighted = sag * self._weight
        return np.asarray(weighted - (weighted @ self._terms) @ self._terms.T)

    def reduce(self, coefficients: Floats, sag: Floats) -> Floats:
        """(..., R) m rms of coefficients (..., K) m and sag (..., P) m."""
        low = coefficients[..., PISTON_TILT:] * self._scale
        return np.concatenate((low, self._beyond(sag) @ self._patterns.T), axis=-1)

    def expand(self, values: Floats) -> tuple[Floats, Floats]:
        """Coefficients (K,) m and sag (P,) m of `values` (R,), without piston and tilt."""
        low, high = values[: self.coefficients] / self._scale, values[self.coefficients :]
        sag = self._modes @ low + (high @ self._patterns) / self._weight
        coefficients = np.concatenate((np.zeros(PISTON_TILT), low))
        return coefficients, remove_piston_tilt(sag[None], self._points)[0]
