"""The error of an instrument from maps of flats against each other: three-flat test, rotation test, or any mixture.

A map shows the flat in the instrument (as it is seen from behind) plus the part in front of it, which appears mirrored
in the instrument and may be turned. In Zernike terms, Re(c (x + iy)^m P), a turn by a multiplies the complex
coefficient c of the part by exp(-ima), and the mirror image is (-1)^m times its conjugate. So for each angular order m
the maps give one small set of linear equations for the flats. Undetermined orders are reported and left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dm_calibration.optics.aperture import InsufficientDataError, find_aperture
from dm_common import Floats
from dm_common.optics.zernike import MAX_ORDER

#: Highest radial order of the flats' errors that is fitted.
ORDER = 12
#: Approximate number of pixels to which the terms are fitted.
FITTED = 20_000
#: Fewest pixels per term: with fewer, noise and higher orders leak into the terms, which the bound does not include.
PIXELS_A_TERM = 4
#: Singular values, relative to the largest, below which the maps, turned almost alike, do not determine a direction.
DETERMINED = 0.1
#: 95 % bound, in standard deviations, on the largest error among the 18 coefficients of a calibration.
LARGEST_SIGMAS = 3.0


@dataclass(frozen=True)
class FlatTest:
    """A map of two flats.

    Attributes:
        sag: (height, width) m.
        reference: name of the flat in the instrument.
        part: name of the flat in front of it.
        turn: rotation of the part, counter-clockwise as the camera sees it, rad.
    """

    sag: Floats
    reference: str
    part: str
    turn: float = 0.0


@dataclass(frozen=True)
class FlatError:
    """The error of the instrument's flat, that is, of the reference of the first test.

    Attributes:
        sag: (height, width) m, as the instrument shows it; NaN outside the aperture.
        bound: m, 95 % bound on the largest error of its coefficients; NaN if the maps are not redundant.
        left: m rms, residual of the maps up to the order, after fitting all flats.
        open_orders: angular orders that the maps do not determine; they are left out.
    """

    sag: Floats
    bound: float
    left: float
    open_orders: tuple[int, ...]


def reference_from_flats(tests: Sequence[FlatTest]) -> FlatError:
    """Separate the error of the instrument's flat from those of the parts.

    Raises:
        ValueError: no tests, maps of different sizes, or maps that determine no angular order.
        InsufficientDataError: the maps share no aperture, or too few of its pixels for the terms.
    """
    sizes = sorted({"{1} x {0}".format(*test.sag.shape) for test in tests})
    if len(sizes) != 1:
        found = f", not of {', '.join(sizes)}" if sizes else ""
        raise ValueError(f"{len(tests)} maps: must be some, all of one size in pixels{found}")
    shared = np.logical_and.reduce([np.isfinite(test.sag) for test in tests])
    aperture = find_aperture(shared)
    disc = aperture.disc(shared.shape)
    every = max(int(disc.sum()) // FITTED, 1)
    fitted = tuple(index[::every] for index in np.nonzero(shared & disc))
    orders = [(n, m) for n in range(ORDER + 1) for m in range(n % 2, n + 1, 2)]
    turning = [m > 0 for _, m in orders]
    place = aperture.places(*fitted)
    values = np.column_stack([_term(place, n, m) for n, m in orders])
    design = np.hstack((values.real, -values.imag[:, turning]))
    if len(design) < PIXELS_A_TERM * design.shape[1]:
        raise InsufficientDataError(
            f"the maps share {len(design)} valid pixels: must be {PIXELS_A_TERM * design.shape[1]} or more, for "
            f"{design.shape[1]} terms"
        )
    heights = np.array([test.sag[fitted] for test in tests]).T
    measured = np.linalg.lstsq(design, heights, rcond=None)[0]
    seen = np.zeros((len(orders), 2, len(tests)))
    seen[:, 0], seen[turning, 1] = measured[: len(orders)], measured[len(orders) :]
    flats = list(dict.fromkeys(name for test in tests for name in (test.reference, test.part)))
    sag, everywhere = np.where(disc, 0.0, np.nan), aperture.places(*np.nonzero(disc))
    squares = judged = worst = 0.0
    freedom = 0
    open_orders: set[int] = set()
    for (n, m), coefficients in zip(orders, seen, strict=True):
        if n < 2:  # piston and tilt depend on the mounts
            continue
        matrix = _equations(tests, flats, m)
        inverse = np.linalg.pinv(matrix, rcond=DETERMINED)
        resolved = inverse @ matrix  # a projection; its trace is the rank
        determined = np.isclose(np.diag(resolved), 1.0)[: 2 if m else 1]
        solution = inverse @ coefficients.T.ravel()
        apart = float(np.square(coefficients.T.ravel() - matrix @ solution).sum())
        squares += apart / ((n + 1) * (2 if m else 1))  # mean square over the disc
        if n <= MAX_ORDER:  # retrace error and vibration affect these more than higher orders
            judged += apart
            freedom += (2 if m else 1) * len(tests) - round(np.trace(resolved))
        worst = max(worst, *np.linalg.norm(inverse[: len(determined)], axis=1)[determined], 0.0)
        if not determined.all():
            open_orders.add(m)
        known = complex(*np.where(determined, solution[: len(determined)], 0.0))
        sag[disc] += np.real(known * _term(everywhere, n, m))
    if len(open_orders) == ORDER + 1:
        raise ValueError(f"{len(tests)} maps of {', '.join(flats)} do not distinguish the flats: exchange or turn them")
    sigma = np.sqrt(judged / freedom) if freedom else np.nan
    left = np.sqrt(squares / len(tests))
    return FlatError(sag, float(LARGEST_SIGMAS * worst * sigma), float(left), tuple(sorted(open_orders)))


def _term(place: NDArray[np.complex128], n: int, m: int) -> NDArray[np.complex128]:
    """The Zernike term of radial order n and angular order m, 1 at the edge; its real part is the cosine term."""
    from scipy.special import eval_jacobi

    return np.asarray(eval_jacobi((n - m) // 2, 0, m, 2.0 * np.abs(place) ** 2 - 1.0) * place**m)


def _equations(tests: Sequence[FlatTest], flats: Sequence[str], m: int) -> Floats:
    """(2 T, 2 F) matrix from real and imaginary coefficients of flats, seen in the instrument, to those of maps."""
    matrix = np.zeros((2 * len(tests), 2 * len(flats)))
    for number, test in enumerate(tests):
        at, part = slice(2 * number, 2 * number + 2), 2 * flats.index(test.part)
        reference = 2 * flats.index(test.reference)
        matrix[at, reference : reference + 2] += np.eye(2)
        cosine, sine = np.cos(m * test.turn), np.sin(m * test.turn)
        turned = np.array([[cosine, sine], [-sine, cosine]]) @ np.diag((1.0, -1.0))
        matrix[at, part : part + 2] += (-1) ** m * turned
    return matrix if m else matrix * np.tile((1.0, 0.0), len(flats))  # m = 0: rotation has no effect, no sine terms
