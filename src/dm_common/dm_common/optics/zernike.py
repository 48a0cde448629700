"""The 21 Zernike terms to order 5 in Born & Wolf's convention, and conversion from Noll's, OSA/ANSI's and Fringe's.

Born & Wolf ([2], section 9.2.1): peak-normalised, the maximum of every term on the unit disc is 1. The order is that of
[1]: n rising, m rising, cosine before sine. x points right, y up, the angle counts from x to y. Coefficients have the
unit of the sag they describe (m).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dm_common import Floats

MAX_ORDER = 5

#: Number of leading terms that no interferometer can attribute to the mirror: piston and the two tilts.
PISTON_TILT = 3
#: Number of even powers (0, 2, ...) of an actuator's distance from the centre that describe the tilt it makes.
TILT_ORDERS = 3


#: What opticians call the terms of radial order n and azimuthal order m.
_SPOKEN = {
    (0, 0): "piston",
    (1, 1): "tilt",
    (2, 0): "defocus",
    (2, 2): "astigmatism",
    (3, 1): "coma",
    (3, 3): "trefoil",
    (4, 0): "spherical aberration",
    (4, 2): "secondary astigmatism",
    (4, 4): "tetrafoil",
    (5, 1): "secondary coma",
    (5, 3): "secondary trefoil",
    (5, 5): "pentafoil",
}


class Term(NamedTuple):
    """R_n^m(r) cos(m theta) or R_n^m(r) sin(m theta)."""

    n: int
    m: int
    kind: str  # "" for m = 0, else "cos" or "sin"

    @property
    def name(self) -> str:
        """For example `Z_2^0` or `Z_2^2 cos`."""
        return f"Z_{self.n}^{self.m} {self.kind}".strip()

    @property
    def spoken(self) -> str:
        """What opticians call it, for example `defocus` or `astigmatism cos`."""
        return f"{_SPOKEN[self.n, self.m]} {self.kind}".strip()

    @property
    def rms(self) -> float:
        """Root mean square over the unit disc of the peak-normalised term."""
        return 1 / math.sqrt((self.n + 1) * (1 if self.m == 0 else 2))

    @property
    def noll_index(self) -> int:
        """Noll's index j = 1, 2, 3, ... [3]: cosine terms are even, sine terms odd."""
        first = self.n * (self.n + 1) // 2 + self.m  # for m > 0 the lower index of the pair
        if self.m == 0:
            return first + 1
        return first + (first % 2 != (0 if self.kind == "cos" else 1))

    @property
    def ansi_index(self) -> int:
        """OSA/ANSI index j = 0, 1, 2, ... [4]: sine terms have negative azimuthal order."""
        azimuthal = -self.m if self.kind == "sin" else self.m
        return (self.n * (self.n + 2) + azimuthal) // 2

    @property
    def fringe_index(self) -> int:
        """Fringe (University of Arizona) index j = 1, 2, 3, ...: sorted by n + m, then by falling m."""
        return ((self.n + self.m) // 2 + 1) ** 2 - 2 * self.m + (self.kind == "sin")


TERMS: tuple[Term, ...] = tuple(
    Term(n, m, kind)
    for n in range(MAX_ORDER + 1)
    for m in range(n % 2, n + 1, 2)
    for kind in (("",) if m == 0 else ("cos", "sin"))
)

NAMES: tuple[str, ...] = tuple(term.name for term in TERMS)

#: What opticians call each term.
SPOKEN: tuple[str, ...] = tuple(term.spoken for term in TERMS)
DEFOCUS = TERMS.index(Term(2, 0, ""))

#: Root mean square of each term over the unit disc.
TERM_RMS: Floats = np.array([term.rms for term in TERMS])
TERM_RMS.flags.writeable = False


def _radial_factor(n: int, m: int) -> list[float]:
    """Coefficients of P in R_n^m(r) = r^m P(r^2), lowest power first."""
    top = (n - m) // 2
    return [(-1) ** s * math.comb(n - s, s) * math.comb(n - 2 * s, top - s) for s in range(top, -1, -1)]


def basis(x: ArrayLike, y: ArrayLike) -> Floats:
    """Evaluate all terms, in the order of TERMS: S + (21,).

    Args:
        x, y: of any one shape S, in units of the aperture's radius. Outside the unit disc the polynomials continue.
    """
    z = np.asarray(x, dtype=float) + 1j * np.asarray(y, dtype=float)
    r2 = z.real**2 + z.imag**2
    result = np.empty((*z.shape, len(TERMS)))
    angular = [z**m for m in range(MAX_ORDER + 1)]  # r^m (cos m theta + i sin m theta)
    for k, (n, m, kind) in enumerate(TERMS):
        radial = np.polynomial.polynomial.polyval(r2, _radial_factor(n, m))
        result[..., k] = radial * (angular[m].imag if kind == "sin" else angular[m].real)
    return result


def curvature_of_defocus(coefficient: float, radius: float) -> float:
    """Curvature c (1/m, positive = concave) of the paraboloid c r^2 / 2 that has a defocus of `coefficient` (m) over an
    aperture of `radius` (m).
    """
    return 4.0 * coefficient / radius**2


def rms_beyond_tilt(coefficients: ArrayLike, residual: float = 0.0) -> float:
    """Rms sag over the aperture without piston and tilt, m: of coefficients (21,), m, together with the part of the
    surface that the terms do not describe, of rms `residual`, m.
    """
    return float(np.hypot(np.linalg.norm((_checked(coefficients) * TERM_RMS)[PISTON_TILT:]), residual))


def _checked(coefficients: ArrayLike, count: int = len(TERMS), more: bool = False) -> Floats:
    """Coefficients as an array, with `count` terms on the last axis, or at least as many if `more`."""
    values = np.asarray(coefficients, dtype=float)
    if values.ndim < 1 or not (values.shape[-1] == count or (more and values.shape[-1] > count)):
        least = "at least " if more else ""
        raise ValueError(f"coefficients of shape {values.shape}: the last axis must have {least}{count} terms")
    return values


#: Order and normalisation of coefficients here, by its name in dm_msgs/ZernikeCoefficients.
BORN_WOLF = "born_wolf"
#: By name: index of each term in the convention's order, and the rms of the term where it is rms-normalised (else 1).
CONVENTIONS: dict[str, tuple[NDArray[np.intp], Floats | float]] = {
    BORN_WOLF: (np.arange(len(TERMS)), 1.0),
    "noll": (np.array([term.noll_index - 1 for term in TERMS]), TERM_RMS),
    "ansi": (np.array([term.ansi_index for term in TERMS]), TERM_RMS),
    "fringe": (np.array([term.fringe_index - 1 for term in TERMS]), 1.0),
}


def to_born_wolf(coefficients: ArrayLike, convention: str) -> Floats:
    """Convert coefficients in one of the CONVENTIONS to (..., 21) of Born & Wolf's; terms beyond order 5 are dropped.

    Args:
        coefficients: (..., 21) of Born & Wolf's; (..., 21) or more of Noll's from index 1 on, or of OSA/ANSI's from
            index 0 on, both rms-normalised; (..., 27) or more of Fringe's.
    """
    place, rms = CONVENTIONS[convention]
    return _checked(coefficients, int(place.max()) + 1, more=convention != BORN_WOLF)[..., place] / rms


def tilt_influence(measured: Floats, places: Floats, response: Floats) -> Floats:
    """The tilt that each actuator makes, (2, N) m per unit signal, from maps that include the instrument's own tilt.

    The instrument is aligned differently in each map: with 0.3 um of tilt at the edge, 159 maps leave an error of 0.12
    um per unit signal. The positions of the actuators and their responses are known far better. An actuator tilts the
    plate towards itself, by its response times a smooth function of its distance from the centre. The few coefficients
    of this function are fitted to the tilts in all maps. For spheres, tilts matter only if a command is not symmetric.

    Args:
        measured: (2, N) m per unit signal, as found from the maps.
        places: (2, N) x and y of the actuators, in aperture radii.
        response: (N,) m rms per unit signal of each actuator, piston and tilt removed.
    """
    lever = places * response
    square = np.square(places).sum(axis=0)
    shapes = np.column_stack([(lever * square**order).ravel() for order in range(TILT_ORDERS)])
    weights = np.linalg.lstsq(shapes, measured.ravel(), rcond=None)[0]
    fitted: Floats = (shapes @ weights).reshape(places.shape)
    return fitted
