"""The surface control errors of the sample surfaces of a calibration, and their weights ([1], sections 2.2 and 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.influence.surfaces import TABLE_1
from dm_calibration.influence.weights import region_weights, surface_control_error
from dm_common.optics.sample_regions import regional_rms

Floats = NDArray[np.float64]

#: p01 to p58; the Zernike surfaces are not part of the regression.
SURFACES = tuple(name for name in TABLE_1 if not name.startswith("pz"))


@dataclass(frozen=True, eq=False)
class SurfaceErrors:
    """The sample surfaces of a calibration with their errors.

    Attributes:
        rows: (S,) their places among the maps.
        labels: (S,) of p01-p58.
        signals: (S, N) as applied.
        regional: (S, R) m, rms surface control error inside concentric regions, the whole aperture last.
    """

    rows: NDArray[np.int64]
    labels: tuple[str, ...]
    signals: Floats
    regional: Floats

    @property
    def response(self) -> Floats:
        """(S,) m, rms surface control error over the whole aperture."""
        return np.asarray(self.regional[:, -1])


def surface_errors(maps: MapSet, fit: InfluenceFit) -> SurfaceErrors:
    """Errors of the surfaces p01-p58 among `maps` that entered `fit`, from their sag samples.

    Raises:
        EmptyRegionError: a surface has no sample in some region.
        TooFewMapsError: there is none of these surfaces.
        ValueError: other than 21 terms.
    """
    rows = np.array([k for k, label in enumerate(maps.label) if label in SURFACES and fit.used[k]], dtype=np.int64)
    if not rows.size:
        raise TooFewMapsError("none of the surfaces p01 to p58 is among the good maps: calibrate with the plan FULL")
    labels = tuple(maps.label[row] for row in rows)
    error = surface_control_error(maps.sag[rows], maps.applied[rows], fit.influence_zernike, maps.points)
    return SurfaceErrors(rows, labels, maps.applied[rows], regional_rms(error, maps.points, labels=labels))


def surface_weights(errors: SurfaceErrors) -> Floats:
    """(S,) weights of the surfaces for AZWreg: Eq. (8) with r the variance of a surface's regional errors, m^2.

    Scaled such that a surface of weight 1 has the average variance: that is what a new one, whose regional errors
    nobody has measured, counts as.

    Raises:
        ValueError: the errors of all surfaces are the same in all regions, so that Eq. (8) gives no weights.
    """
    variance = errors.regional.var(axis=1, ddof=1)
    epsilon = float(np.median(variance))
    if epsilon <= 0.0:
        raise ValueError("the errors do not differ from region to region: Eq. (8) gives no weights; use AZreg")
    weights = region_weights(variance, epsilon)
    return weights * np.mean(1.0 / weights)
