"""Least-squares fit of the 21 Zernike terms to every valid pixel of a map, through moments.

On a Cartesian grid the moments of a map Z against products of Legendre polynomials are two thin matrix products,
L^T Z L (see :mod:`~dm_calibration.optics.map_moments`). The 21 products P_a(x) P_b(y) with a + b <= 5 span the same
polynomials as the 21 Zernike terms, and their masked Gram matrix follows from moments of the mask to degree 10, because
a product of two Legendre polynomials is a short sum of others. Solving the 21 x 21 system gives the exact least-squares
answer.
"""

import math
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.polynomial import legendre
from scipy import linalg

from dm_calibration.optics.aperture import Aperture, InsufficientDataError
from dm_calibration.optics.map_moments import MaskedMoments, mask_moments
from dm_common import Bools, Floats
from dm_common.optics.zernike import MAX_ORDER, TERM_RMS, TERMS, basis

#: Exponents (a, b) of the products P_a(x) P_b(y).
_PRODUCTS = [(a, b) for a in range(MAX_ORDER + 1) for b in range(MAX_ORDER + 1 - a)]
_A = np.array([a for a, _b in _PRODUCTS])
_B = np.array([b for _a, b in _PRODUCTS])

#: Ratio of the extreme eigenvalues of the normalised Gram matrix below which the pixels do not determine the terms.
_SINGULAR = 1e-8

#: Share of the map's energy below which the residual is computed pixel by pixel: as the difference of two large sums it
#: would lose its digits.
_CANCELLATION = 1e-8


@dataclass(frozen=True, eq=False)
class MapFit:
    """Result of a fit, in the unit of the sag.

    Attributes:
        coefficients: (21,), Born & Wolf.
        sigma: (21,), one standard deviation each, estimated from the residual as if it were independent from pixel to
            pixel. Print-through and air turbulence are correlated, so the true uncertainty is larger.
        residual_rms: rms, over the valid pixels, of the map less the terms.
        valid_fraction: valid pixels / pixels inside the aperture.
    """

    coefficients: Floats
    sigma: Floats
    residual_rms: float
    valid_fraction: float
    valid_pixels: int


@cache
def _linearisation() -> Floats:
    """(11, 6, 6): coefficients c of P_a P_b = sum over k of c[k, a, b] P_k."""
    degree = MAX_ORDER + 1
    result = np.zeros((2 * MAX_ORDER + 1, degree, degree))
    unit = np.eye(degree)
    for a in range(degree):
        for b in range(degree):
            product = legendre.legmul(unit[a], unit[b])
            result[: len(product), a, b] = product
    return result


@cache
def _zernike_from_products() -> Floats:
    """(21, 21) matrix T with Zernike = T times products, exact for polynomials of this degree."""
    nodes = np.cos(np.pi * (np.arange(12) + 0.5) / 12)
    x, y = (grid.ravel() for grid in np.meshgrid(nodes, nodes))
    products = legendre.legvander(x, MAX_ORDER)[:, _A] * legendre.legvander(y, MAX_ORDER)[:, _B]
    return np.linalg.lstsq(products, basis(x, y), rcond=None)[0].T


@lru_cache(maxsize=4)
def _disc(aperture: Aperture, shape: tuple[int, int]) -> Bools:
    """Pixels of the aperture, cached: they often stay the same from map to map while the valid pixels change."""
    disc = aperture.disc(shape)
    disc.flags.writeable = False
    return disc


class MapFitter:
    """Fits maps that share one mask of valid pixels and one aperture.

    Creation takes a few times as long as a fit, so keep it as long as the mask repeats. Not thread-safe.
    """

    def __init__(self, mask: Bools, centre_x_px: float, centre_y_px: float, radius_px: float) -> None:
        """Prepare the Gram matrix.

        Args:
            mask: (height, width), True where there is data; pixels outside the aperture are ignored.
            centre_x_px, centre_y_px: from the left and top pixel's centre.
            radius_px: normalisation radius of the terms.

        Raises:
            InsufficientDataError: fewer valid pixels than terms, or their positions do not determine the terms.
        """
        self.aperture = Aperture(centre_x_px, centre_y_px, radius_px)
        self._shape = mask.shape
        self._rows = _span(centre_y_px, radius_px, mask.shape[0])
        self._columns = _span(centre_x_px, radius_px, mask.shape[1])
        self._disc = _disc(self.aperture, self._shape)[self._rows, self._columns]
        self._used = mask[self._rows, self._columns] & self._disc
        self.valid_pixels = int(np.count_nonzero(self._used))
        self.valid_fraction = self.valid_pixels / max(self.aperture.pixels(), 1)
        if self.valid_pixels < len(TERMS):
            raise InsufficientDataError(
                f"{self.valid_pixels} valid pixels inside the aperture (radius {radius_px:.3g} pixels): "
                f"{len(TERMS)} terms need at least {len(TERMS)}"
            )
        x = (np.arange(mask.shape[1])[self._columns] - centre_x_px) / radius_px
        y = (centre_y_px - np.arange(mask.shape[0])[self._rows]) / radius_px
        self._legendre_x = np.ascontiguousarray(legendre.legvander(x, 2 * MAX_ORDER))
        self._legendre_y = np.ascontiguousarray(legendre.legvander(y, 2 * MAX_ORDER))
        self._solve_with(self._gram())
        # Bases for the fit itself: moments[b, a] is the moment with P_b(y) P_a(x).
        self._thin_x = np.ascontiguousarray(self._legendre_x[:, : MAX_ORDER + 1])
        self._thin_y = np.ascontiguousarray(self._legendre_y[:, : MAX_ORDER + 1])
        self._moments = MaskedMoments(self._used, self._thin_y, self._thin_x)

    def _gram(self) -> Floats:
        """Masked Gram matrix of the Zernike terms."""
        moments = mask_moments(self._used, self._legendre_y, self._legendre_x)  # [degree of y, degree of x]
        c = _linearisation()
        in_x = c[:, _A[:, None], _A]  # (11, 21, 21)
        in_y = c[:, _B[:, None], _B]
        products = np.einsum("kij,lij,lk->ij", in_x, in_y, moments, optimize=True)
        transform = _zernike_from_products()
        return transform @ products @ transform.T

    def _solve_with(self, gram: Floats) -> None:
        scale = TERM_RMS * math.sqrt(self.valid_pixels)  # makes the Gram matrix of a full disc the unit matrix
        eigenvalues = np.linalg.eigvalsh(gram / np.outer(scale, scale))
        if eigenvalues[0] < _SINGULAR * eigenvalues[-1]:
            raise InsufficientDataError(
                f"{self.valid_pixels} valid pixels ({100 * self.valid_fraction:.1f} % of the aperture) lie so that "
                f"they cannot separate the {len(TERMS)} terms"
            )
        self._scale = scale
        self._factor = linalg.cho_factor(gram / np.outer(scale, scale))
        inverse = linalg.cho_solve(self._factor, np.eye(len(TERMS)))
        self._sigma_per_pixel_noise = np.sqrt(np.diag(inverse)) / scale

    def fits(self, mask: Bools, aperture: Aperture) -> bool:
        """Whether this fitter was made for this aperture and mask (as far as the mask lies inside the aperture)."""
        if aperture != self.aperture or mask.shape != self._shape:
            return False
        return bool(np.array_equal(mask[self._rows, self._columns] & self._disc, self._used))

    def fit(self, sag: Floats) -> MapFit:
        """Fit the terms to a map.

        Args:
            sag: (height, width), finite wherever the mask is True.

        Raises:
            ValueError: another shape, or a value that is not finite under the mask.
        """
        if sag.shape != self._shape:
            raise ValueError(f"map of shape {sag.shape}: the mask has {self._shape}")
        inner = sag[self._rows, self._columns]
        moments, energy = self._moments.of(inner)
        if not math.isfinite(energy):
            missing = np.count_nonzero(self._used & ~np.isfinite(inner))
            raise ValueError(f"the map has no data in {missing} pixels that the mask marks as valid")
        right = _zernike_from_products() @ moments[_B, _A]
        coefficients = linalg.cho_solve(self._factor, right / self._scale) / self._scale
        squares = energy - float(coefficients @ right)
        if squares < _CANCELLATION * energy:
            left = (inner - self._thin_y @ in_products(coefficients) @ self._thin_x.T)[self._used]
            squares = float(np.vdot(left, left))
        squares = max(squares, 0.0)
        freedom = max(self.valid_pixels - len(TERMS), 1)
        return MapFit(
            coefficients=coefficients,
            sigma=self._sigma_per_pixel_noise * math.sqrt(squares / freedom),
            residual_rms=math.sqrt(squares / self.valid_pixels),
            valid_fraction=self.valid_fraction,
            valid_pixels=self.valid_pixels,
        )


def in_products(coefficients: Floats) -> Floats:
    """(6, 6) coefficients of P_b(y) P_a(x) of the surface with Zernike coefficients (21,)."""
    products = np.zeros((MAX_ORDER + 1, MAX_ORDER + 1))
    products[_B, _A] = coefficients @ _zernike_from_products()
    return products


def _span(centre: float, radius: float, size: int) -> slice:
    """The range of pixels along one axis inside the circle."""
    return slice(max(math.ceil(centre - radius), 0), max(min(math.floor(centre + radius) + 1, size), 0))
