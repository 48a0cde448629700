"""Adjusted R^2 and p from F and the numbers of samples and variables, to check published tables.

Table 2 in [1] gives adjusted R^2, F and p(F) without n and k. Only n = 50, k = 6 fits its AZreg and n = 49, k = 17
its AZWreg.
"""

from __future__ import annotations

import math

from scipy import stats


def adjusted_r2_of_f(f_statistic: float, n: int, k: int) -> float:
    """Adjusted R^2 of a model of k variables and a constant on n samples that has this F: R^2 = kF / (kF + n - k - 1).

    Raises:
        ValueError: F negative or not finite, k below 1, or n not above k + 1.
    """
    freedom = _freedom(f_statistic, n, k)
    r2 = k * f_statistic / (k * f_statistic + freedom)
    return 1.0 - (1.0 - r2) * (n - 1) / freedom


def p_of_f(f_statistic: float, n: int, k: int) -> float:
    """Probability of this F or a larger one by chance, for a model of k variables chosen beforehand, on n samples.

    Raises:
        ValueError: as :func:`adjusted_r2_of_f`.
    """
    return float(stats.f.sf(f_statistic, k, _freedom(f_statistic, n, k)))


def _freedom(f_statistic: float, n: int, k: int) -> int:
    if k < 1:
        raise ValueError(f"k = {k}: must be at least 1, the constant not counted")
    if n <= k + 1:
        raise ValueError(f"n = {n}: must be above k + 1 = {k + 1}, or no freedom is left for the residual")
    if not 0.0 <= f_statistic < math.inf:
        raise ValueError(f"F = {f_statistic:g}: must be 0 or more and finite")
    return n - k - 1
