"""Maps reduced to values of similar uncertainty: Zernike coefficients, and sag beyond them in a few modes.

Coefficients come from all pixels of a map and are accurate to a fraction of a nanometre; sag at the sampling points is
less accurate, since a point with missing neighbours is the mean of the others. Beyond the coefficients, a mirror of N
actuators shows at most N patterns, so the sag is projected onto those. Each kind of value is divided by its scatter.
"""

from dataclasses import dataclass

import numpy as np

from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.influence.screening import unusable
from dm_common import Bools, Floats
from dm_common.optics.piston_tilt import fill_gaps, remove_piston_tilt
from dm_common.optics.sampling import SamplePoints
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS, basis

#: Least uncertainty of a response, m, for data without noise.
SCATTER_MIN = 1e-11
#: Patterns weaker than this share of the strongest are noise.
WEAKEST_PATTERN = 0.03
#: Outliers: a map whose residual exceeds OUTLIER medians contradicts the law (the mirror was touched, a door slammed,
#: or the map is of another mirror). If more than the share OUTLIERS_MAX of the maps do, none counts as an outlier.
OUTLIER, OUTLIERS_MAX = 8.0, 0.1
#: Least share of points with data from which modes are fitted to fill the gaps; ridge on the amplitudes of these modes,
#: relative to the information of a map without gaps.
FILLED_MIN, FILL_RIDGE = 0.9, 1e-3


class Reduction:
    """Converts between K coefficients with sag at P points and R = K - 3 + B values in m rms.

    The first K - 3 values are coefficients beyond tilt, each as the rms sag of its term; the others are amplitudes of
    the B patterns beyond the terms that the N actuators make, strongest first.

    Args:
        influence_sag: (P, N) m per unit signal.
        terms: K.

    Attributes:
        coefficients, size: K - 3 and R.
    """

    def __init__(self, points: SamplePoints, influence_sag: Floats, terms: int) -> None:
        self._points = points
        self._weight = np.sqrt(points.weight)
        self._modes = basis(points.x, points.y)[:, PISTON_TILT:terms]
        self._terms = np.linalg.qr(self._weight[:, None] * basis(points.x, points.y))[0]
        self._scale = TERM_RMS[PISTON_TILT:terms]
        _, strength, patterns = np.linalg.svd(self._beyond(influence_sag.T), full_matrices=False)
        self._patterns = patterns[strength > WEAKEST_PATTERN * strength[0]]
        self.coefficients = len(self._scale)
        self.size = self.coefficients + len(self._patterns)

    def _beyond(self, sag: Floats) -> Floats:
        """(..., P) weighted sag without the terms."""
        weighted = sag * self._weight
        return np.asarray(weighted - (weighted @ self._terms) @ self._terms.T)

    def reduce(self, coefficients: Floats, sag: Floats) -> Floats:
        """(..., R) m rms of coefficients (..., K) m and sag (..., P) m."""
        low = coefficients[..., PISTON_TILT:] * self._scale
        return np.concatenate((low, self._beyond(sag) @ self._patterns.T), axis=-1)

    def fill(self, sag: Floats) -> Floats:
        """`sag` (P,) m less piston and tilt; NaN is replaced by the terms and patterns fitted to the other points.

        A wide gap leaves too many of these undetermined, so it is filled with a plane.
        """
        known = np.isfinite(sag)
        if known.mean() < FILLED_MIN:
            sag = fill_gaps(sag[None], np.zeros((1, len(sag))), self._points)[0]
        elif not known.all():
            modes = np.column_stack((self._terms, self._patterns.T))
            drawn = np.where(np.arange(modes.shape[1]) < PISTON_TILT, 0.0, FILL_RIDGE)
            shown = modes[known]
            amplitudes = np.linalg.solve(shown.T @ shown + np.diag(drawn), shown.T @ (self._weight * sag)[known])
            sag = np.where(known, sag, modes @ amplitudes / self._weight)
        return remove_piston_tilt(sag[None], self._points)[0]

    def expand(self, values: Floats) -> tuple[Floats, Floats]:
        """Coefficients (K,) m and sag (P,) m of `values` (R,), without piston and tilt."""
        low, high = values[: self.coefficients] / self._scale, values[self.coefficients :]
        sag = self._modes @ low + (high @ self._patterns) / self._weight
        coefficients = np.concatenate((np.zeros(PISTON_TILT), low))
        return coefficients, remove_piston_tilt(sag[None], self._points)[0]


@dataclass(frozen=True, eq=False)
class Responses:
    """Measured values of M maps.

    Attributes:
        values: (M, K - 3 + B) m rms: coefficients beyond tilt, as rms sag each, and patterns beyond them.
        coefficients: K - 3.
        usable: (M,) maps that can be fitted; rows of the others are 0.
    """

    values: Floats
    coefficients: int
    usable: Bools

    def scatter(self, size: Floats) -> Floats:
        """(D,) m, uncertainty of each response from the `size` (D,) of residuals; one value for all coefficients."""
        scatter = np.maximum(size, SCATTER_MIN)
        scatter[: self.coefficients] = np.median(scatter[: self.coefficients])
        return np.asarray(scatter)


def responses_of(maps: MapSet) -> Responses:
    """Reduce `maps`, with patterns and missing points from a linear influence function that is fitted to them.

    Raises:
        TooFewMapsError: no map can be used.
    """
    usable: Bools = np.array([not reason for reason in unusable(maps, 0.0)])
    if not usable.any():
        raise TooFewMapsError(f"none of the {len(maps)} maps holds data")
    sag = remove_piston_tilt(maps.sag[usable], maps.points)
    modes = basis(maps.points.x, maps.points.y)
    design = np.column_stack((np.ones(len(maps)), maps.applied))[usable]
    model: Floats = maps.coefficients[usable] @ modes.T
    for _ in range(4):  # the influence of the gaps vanishes within some rounds
        filled = fill_gaps(sag, model, maps.points)
        solution = np.asarray(np.linalg.lstsq(design, filled, rcond=None)[0], dtype=np.float64)
        model = design @ solution
    reduction = Reduction(maps.points, solution[1:].T, maps.terms)
    values = np.zeros((len(maps), reduction.size))
    values[usable] = reduction.reduce(maps.coefficients[usable], filled)
    return Responses(values, reduction.coefficients, usable)


def agreeing(used: Bools, residual: Floats, outlier_from: float = OUTLIER) -> Bools:
    """(M,) rows in `used` whose `residual` (M, D) is not an outlier; all rows in `used` if outliers are too many."""
    size = np.linalg.norm(residual, axis=1)
    outlier = used & (size > outlier_from * np.median(size[used]))
    return used if outlier.sum() > OUTLIERS_MAX * used.sum() else used & ~outlier
