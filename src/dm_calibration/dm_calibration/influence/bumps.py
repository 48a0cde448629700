"""The bump that one actuator raises, as far as it is known beforehand, and responses in the form compared with it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dm_common import Floats
from dm_common.optics.piston_tilt import remove_piston_tilt, rms, weighted_fit
from dm_common.optics.sampling import SamplePoints
from dm_common.optics.zernike import basis

#: Places in the plane as complex numbers, x + iy.
Places = NDArray[np.complex128]

#: Rms share of the responses beyond the Zernike terms, below which the maps count as consisting of terms only.
ONLY_TERMS = 1e-6


class Bump(NamedTuple):
    """Shape of the surface that one actuator raises.

    A plate on actuators rises as a Gaussian. A membrane, and a bimorph whose edge is held, follow the Poisson equation
    [30]: the surface over a patch is about Green's function of the disc, blunted, and leans towards the middle.

    Attributes:
        width: standard deviation of the Gaussian, or radius within which Green's function is blunted.
        edge: radius at which a membrane is held; infinite = a plate.
    """

    width: float
    edge: float = np.inf

    def scaled(self, factor: float) -> "Bump":
        """The same shape with lengths in another unit."""
        return Bump(factor * self.width, factor * self.edge)


def bumps(places: Places, bump: Bump, points: SamplePoints, terms: Floats | None = None) -> tuple[Floats, Floats]:
    """Bumps at `places` (N,), in radii of the aperture as is `bump`: see :func:`unit_responses`.

    Args:
        terms: (P, K) the terms to which the sensor reduces a surface; None = it shows everything.
    """
    at, blunt = points.x + 1j * points.y, bump.width**2
    distance = np.square(np.abs(places[:, None] - at))
    if np.isinf(bump.edge):
        sag = np.exp(-0.5 * distance / blunt)
    else:  # by an image of the opposite sign, which makes it 0 at the edge
        image = np.square(np.abs(bump.edge - places.conj()[:, None] * at / bump.edge))
        sag = 0.5 * np.log((image + blunt) / (distance + blunt))
    return unit_responses(sag if terms is None else weighted_fit(sag, terms, points.weight) @ terms.T, points)


def only_terms(unit: Floats, points: SamplePoints) -> Floats | None:
    """(P, 21) Zernike terms if the responses (A, P) contain nothing else, as those of a sensor; None = they do."""
    terms = basis(points.x, points.y)
    left = rms(unit - weighted_fit(unit, terms, points.weight) @ terms.T, points.weight)
    return terms if np.max(left) < ONLY_TERMS else None


def unit_responses(sag: Floats, points: SamplePoints) -> tuple[Floats, Floats]:
    """Rows of `sag` (N, P) without piston and tilt, scaled to unit rms, and the rms (N,) of each before."""
    left = remove_piston_tilt(sag, points)
    size = rms(left, points.weight)
    return np.asarray(left / np.maximum(size, np.finfo(float).tiny)[:, None]), np.asarray(size)
