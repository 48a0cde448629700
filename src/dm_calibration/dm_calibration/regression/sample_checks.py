"""Whether samples can be regressed at all: shapes, finite numbers, freedom, candidates that can be told apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from dm_common.errors import ErrorCode

Floats = NDArray[np.float64]

#: Share of a candidate's variation not explained by those selected, below which it brings nothing of its own.
TOLERANCE = 1e-8
#: Spread of values, relative to their size, below which they count as constant.
CONSTANT = 1e-12


class CollinearError(ValueError):
    """Candidates that cannot be told apart, or from the constant; the message names them."""

    error_code = ErrorCode.TOO_FEW_MAPS


class TooFewSamplesError(ValueError):
    """Fewer samples than a regression needs."""

    error_code = ErrorCode.TOO_FEW_MAPS


def checked(
    candidates: ArrayLike, response: ArrayLike, names: Sequence[str], weights: ArrayLike | None
) -> tuple[Floats, Floats, Floats]:
    x, y = np.asarray(candidates, dtype=float), np.asarray(response, dtype=float)
    if x.ndim != 2 or y.shape != (len(x),) or x.shape[1] != len(names):
        raise ValueError(
            f"candidates {x.shape}, response {y.shape}, {len(names)} names: must be (n, C), (n,) and C names"
        )
    if len(set(names)) != len(names):
        raise ValueError("names of candidates must be unique")
    bad = np.argwhere(~np.isfinite(x))
    if len(bad):
        raise ValueError(f"candidate {names[bad[0, 1]]}, sample {bad[0, 0] + 1}: not finite; leave the sample out")
    if not np.isfinite(y).all():
        raise ValueError(f"response of sample {int(np.argmin(np.isfinite(y))) + 1}: not finite; leave the sample out")
    if not y.size or np.ptp(y) <= CONSTANT * np.abs(y).max():
        raise ValueError(
            "the response is the same for all samples, so there is nothing to explain: use samples that differ"
        )
    return x, y, np.ones(len(y)) if weights is None else checked_weights(weights, len(y))


def checked_weights(weights: ArrayLike, n: int) -> Floats:
    w = np.asarray(weights, dtype=float)
    if w.shape != (n,) or not (np.isfinite(w) & (w > 0.0)).all():
        raise ValueError(f"weights: must be {n} finite numbers above 0, one per sample")
    return w


def check_freedom(n: int, freedom_min: int) -> None:
    needed = freedom_min + 2
    if n < needed:
        raise TooFewSamplesError(
            f"{n} samples: a constant, one variable and {freedom_min} degrees of freedom for the residual need "
            f"at least {needed}; measure more surfaces"
        )


def check_collinear(x: Floats, names: Sequence[str]) -> None:
    if not x.shape[1]:
        return
    centred = x - x.mean(axis=0)
    size = np.linalg.norm(centred, axis=0)
    constant = np.flatnonzero(size <= CONSTANT * np.maximum(np.linalg.norm(x, axis=0), np.finfo(float).tiny))
    if constant.size:
        raise CollinearError(
            f"candidate {names[constant[0]]} is the same for all samples, which the constant says already: "
            "leave it out, or add samples in which it differs"
        )
    unit = centred / size
    likeness = np.triu(np.abs(unit.T @ unit), 1)
    alike = np.argwhere(likeness > 1.0 - 0.5 * TOLERANCE)
    if len(alike):
        one, other = alike[0]
        raise CollinearError(
            f"candidates {names[one]} and {names[other]} are proportional over all samples: leave one of them out, or "
            "add samples in which they differ"
        )
    if len(x) > x.shape[1] + 1:
        _, r, order = linalg.qr(unit, mode="economic", pivoting=True)
        diagonal = np.abs(np.diag(r))
        dependent = order[diagonal < np.sqrt(TOLERANCE)]
        if dependent.size:
            listed = ", ".join(sorted(names[column] for column in dependent))
            raise CollinearError(
                f"the other candidates determine {listed}: leave out as many, or add samples that tell them apart"
            )
