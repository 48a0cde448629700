"""Least-squares weights of the features of each actuator, drawn towards weights that all actuators share.

The weight of a feature is a common value plus a deviation of the actuator. Both have normal priors; the ratio of their
standard deviations is estimated from the maps.
"""

from inspect import signature
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import LinearOperator, cg

from dm_common import Floats

#: Relative residual at which the iterative solution for the weights stops.
SOLVED = 1e-5
#: Name of this tolerance as an argument of `cg`: SciPy 1.11, in Ubuntu 24.04, differs from later versions.
_RELATIVE = "rtol" if "rtol" in signature(cg).parameters else "tol"
#: Candidates for the standard deviation between actuators, relative to that of the common weights. The likeliest one is
#: 0.1 or 0.2 for mirrors whose densities of relays agree to 15 %, up to 0.8 if each actuator has a density of its own.
SPREADS = (0.05, 0.1, 0.2, 0.4, 0.8)
#: The value used before the likeliest is known, and if the maps are too few to find it.
SPREAD = 0.1
#: Largest number of actuators, evenly chosen, that decide between SPREADS (of 37, every second one). The time that this
#: takes grows with the third power of their number.
SPREAD_ACTUATORS = 20


class Known(NamedTuple):
    """What is known of each actuator's weights besides maps and prior: normal equations, (N, F, F) and (N, F)."""

    precision: Floats
    pull: Floats


def alike(actuators: int, spread: float) -> tuple[float, float]:
    """`between` of :func:`weights_of` for a standard deviation `spread` between actuators, see SPREADS."""
    own = spread**-2.0
    return own, own / (actuators + spread**2)


def weights_of(
    features: Floats,
    left: Floats,
    gains: Floats,
    between: tuple[float, float],
    begin: Floats,
    known: Known | None = None,
) -> Floats:
    """Least-squares weights w (F, N) of the features x (M, F, N): sum_fn w_fn x_mfn gains_nd = left_md.

    The inverse of the prior covariance over actuators is own I - common 1 1'; different features are independent.
    Solved by conjugate gradients with a preconditioner that ignores the overlap of the actuators' responses.

    Args:
        between: own and common of the prior above.
        begin: (F, N) weights to begin with.
        known: what is known besides; None = nothing.
    """
    own, common = between
    count, actuators = features.shape[1:]
    columns, rows = (np.ascontiguousarray(features.transpose(axes)) for axes in ((2, 0, 1), (2, 1, 0)))
    seen = gains @ gains.T
    beforehand = own * np.eye(count) + (known.precision if known else 0.0)
    alone = np.linalg.inv(np.diag(seen)[:, None, None] * (rows @ columns) + beforehand)
    together = common * np.linalg.inv(np.eye(count) - common * alone.sum(axis=0))

    def normal(flat: Floats) -> Floats:
        unknown = flat.reshape(actuators, count, 1)
        shown = (rows @ (seen @ (columns @ unknown)[..., 0])[..., None])[..., 0]
        if known:
            shown = shown + (known.precision @ unknown)[..., 0]
        return np.asarray(shown + own * unknown[..., 0] - common * unknown[..., 0].sum(axis=0)).ravel()

    def nearly_solved(flat: Floats) -> Floats:
        solved = (alone @ flat.reshape(actuators, count, 1))[..., 0]
        return np.asarray(solved + alone @ (together @ solved.sum(axis=0))).ravel()

    right = (rows @ (gains @ left.T)[..., None]).ravel()
    if known:
        right = right + known.pull.ravel()
    shape = (right.size, right.size)
    preconditioner = LinearOperator(shape, nearly_solved, dtype=np.float64)
    tolerance = {_RELATIVE: SOLVED, "atol": 0.0}
    operator = LinearOperator(shape, normal, dtype=np.float64)
    weights, _ = cg(operator, right, begin.T.ravel(), M=preconditioner, **tolerance)
    return np.asarray(weights.reshape(actuators, count).T)


def likeliest_spread(features: Floats, left: Floats, gains: Floats, weights: Floats) -> float:
    """The one of SPREADS that makes `left` likeliest, integrated over all weights (the "evidence" in [39]).

    Args:
        features, left, gains: as :func:`weights_of`; `left` in standard deviations.
        weights: (F, N) so far; those of the actuators beyond SPREAD_ACTUATORS are kept fixed.
    """
    chosen = np.arange(features.shape[2]) % -(-features.shape[2] // SPREAD_ACTUATORS) == 0
    left = left - np.einsum("mfn,fn->mn", features[..., ~chosen], weights[:, ~chosen]) @ gains[~chosen]
    features, gains = features[..., chosen], gains[chosen]
    count, actuators = features.shape[1:]
    right = np.einsum("mfn,mn->nf", features, left @ gains.T).ravel()
    flat = features.transpose(0, 2, 1).reshape(len(left), -1)
    shown = flat.T @ flat * np.kron(gains @ gains.T, np.ones((count, count)))

    def evidence(spread: float) -> float:
        own, common = alike(actuators, spread)
        between = own * np.eye(actuators) - common
        factor = cho_factor(shown + np.kron(between, np.eye(count)), lower=True, overwrite_a=True)
        size = 2.0 * np.log(np.diag(factor[0])).sum()
        return float(right @ cho_solve(factor, right) - size + count * np.linalg.slogdet(between)[1])

    return max(SPREADS, key=evidence)
