"""Zernike polynomials, orthonormal over the unit disc (mean square 1), as the basis of the plate model.

Z = N Re or Im[(x + iy)^m] P_k^(0,m)(2 r^2 - 1) with k = (n - m)/2, P the Jacobi polynomials, N = sqrt(n + 1) for m = 0
and sqrt(2 (n + 1)) otherwise ([2], section 9.2, with another norm). Jacobi polynomials keep their accuracy at order 36,
where sums of powers of r lose digits.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import eval_jacobi

Array = NDArray[np.float64]


class Term(NamedTuple):
    """Radial order n, azimuthal order m >= 0, and whether the azimuthal factor is a sine."""

    n: int
    m: int
    sine: bool


def terms_to_order(order: int) -> tuple[Term, ...]:
    """All terms with n <= order: n rising, then m rising, cosine before sine; (order + 1)(order + 2)/2 of them."""
    return tuple(
        Term(n, m, sine)
        for n in range(order + 1)
        for m in range(n % 2, n + 1, 2)
        for sine in ((False,) if m == 0 else (False, True))
    )


def norm(n: int, m: int) -> float:
    """Peak value of the orthonormal polynomial at the edge of the disc."""
    return float(np.sqrt((n + 1) * (1 if m == 0 else 2)))


def evaluate(x: Array, y: Array, terms: tuple[Term, ...]) -> Array:
    """Values of `terms` at points x, y (any shape, in units of the disc radius): shape x.shape + (len(terms),)."""
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    s = x * x + y * y
    rotor = x + 1j * y
    powers = {0: np.ones_like(rotor)}
    for m in range(1, max(term.m for term in terms) + 1):
        powers[m] = powers[m - 1] * rotor
    values = np.empty((*x.shape, len(terms)))
    radial: dict[tuple[int, int], Array] = {}
    for j, (n, m, sine) in enumerate(terms):
        if (n, m) not in radial:
            radial[n, m] = norm(n, m) * eval_jacobi((n - m) // 2, 0, m, 2 * s - 1)
        values[..., j] = radial[n, m] * (powers[m].imag if sine else powers[m].real)
    return values
