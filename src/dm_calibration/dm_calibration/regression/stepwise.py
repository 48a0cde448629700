"""Forward-backward stepwise selection for a linear regression, ordinary or weighted ([1], section 3.1).

Each round enters the candidate with the smallest p value of its partial F test, if that is below `p_enter`, and then
removes, one by one, those whose p value has risen above `p_remove`. [1] does not name its thresholds. 0.05 and 0.10 are
the defaults of the packages that made the method common ([15], section 15.2); removal must be the milder of the two, or
a candidate could come and go for ever.

The statistics of the result are those of statsmodels for the selected model. They take the selection as if it had been
known beforehand: the best of 58 candidates always looks better than chance, so R^2, F and p are optimistic. What counts
is the error on samples that were not used, :func:`leave_one_out`, where the selection is made anew without each sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, special

from dm_calibration.regression.sample_checks import (
    CONSTANT,
    TOLERANCE,
    check_collinear,
    check_freedom,
    checked,
    checked_weights,
)

Floats = NDArray[np.float64]

P_ENTER = 0.05
P_REMOVE = 0.10
#: Degrees of freedom that must be left for the residual: with more candidates than samples, a selection that runs on
#: until none is left fits anything.
FREEDOM_MIN = 10


@dataclass(frozen=True)
class SelectionOptions:
    """Thresholds of the selection.

    Attributes:
        p_enter: largest p value of a candidate that enters; above 0, below 1.
        p_remove: p value above which a variable leaves again; at least p_enter, below 1.
        freedom_min: degrees of freedom to leave for the residual; at least 1.
    """

    p_enter: float = P_ENTER
    p_remove: float = P_REMOVE
    freedom_min: int = FREEDOM_MIN

    def __post_init__(self) -> None:
        if not 0.0 < self.p_enter < 1.0:
            raise ValueError(f"p_enter = {self.p_enter:g}: must be above 0 and below 1; {P_ENTER:g} is usual")
        if not self.p_enter <= self.p_remove < 1.0:
            raise ValueError(
                f"p_remove = {self.p_remove:g}: must be at least p_enter = {self.p_enter:g} and below 1, or a variable "
                f"could enter and leave for ever; {P_REMOVE:g} is usual"
            )
        if self.freedom_min < 1:
            raise ValueError(f"freedom_min = {self.freedom_min}: must be at least 1")


@dataclass(frozen=True, eq=False)
class StepwiseFit:
    """The selected model y = parameters[0] + sum_j parameters[j] x_j. Units: those of the response, per unit of x_j.

    Attributes:
        variables: (k,) names, in the order in which they entered.
        columns: (k,) their columns among the candidates.
        parameters: (k + 1,) the constant first.
        standard_errors: (k + 1,).
        n: samples.
        k: selected variables.
        r2, adjusted_r2: of the selected model; 0 without variables.
        f_statistic, p_value: of the model against the constant; 0 and 1 without variables. Optimistic: see the module.
        residual_sd: standard deviation of the residual of a sample of weight 1.
        weighted: whether samples had weights (WLS).
        covariance: (k + 1, k + 1) of the parameters, for a residual of standard deviation 1.
    """

    variables: tuple[str, ...]
    columns: tuple[int, ...]
    parameters: Floats
    standard_errors: Floats
    n: int
    k: int
    r2: float
    adjusted_r2: float
    f_statistic: float
    p_value: float
    residual_sd: float
    weighted: bool
    covariance: Floats

    def predict(
        self, candidates: ArrayLike, weights: ArrayLike | None = None, level: float = 0.95
    ) -> tuple[Floats, Floats, Floats]:
        """Mean and prediction interval of new samples.

        Args:
            candidates: (M, C) all candidates, in the order they had in the fit.
            weights: (M,) of the samples, as in the fit; 1 when None.
            level: probability of the interval; it does not include the uncertainty of the selection itself.

        Returns:
            mean, lower, upper: (M,) each, in the unit of the response.

        Raises:
            ValueError: fewer columns than the fit has used, weights not above 0, or a level outside 0 to 1.
        """
        x = np.asarray(candidates, dtype=float)
        needed = max(self.columns, default=-1) + 1
        if x.ndim != 2 or x.shape[1] < needed:
            raise ValueError(f"candidates have the shape {x.shape}: must be (samples, {needed} columns or more)")
        if not 0.0 < level < 1.0:
            raise ValueError(f"level = {level:g}: must be above 0 and below 1; 0.95 is usual")
        design = np.column_stack((np.ones(len(x)), x[:, list(self.columns)]))
        w = np.ones(len(x)) if weights is None else checked_weights(weights, len(x))
        mean = design @ self.parameters
        variance = 1.0 / w + np.einsum("ij,jk,ik->i", design, self.covariance, design)
        reach = special.stdtrit(self.n - self.k - 1, 0.5 + 0.5 * level) * self.residual_sd * np.sqrt(variance)
        return mean, mean - reach, mean + reach


def stepwise(
    candidates: ArrayLike,
    response: ArrayLike,
    names: Sequence[str],
    weights: ArrayLike | None = None,
    options: SelectionOptions | None = None,
) -> StepwiseFit:
    """Select variables among the candidates and fit them.

    Args:
        candidates: (n, C).
        response: (n,).
        names: (C,) unique.
        weights: (n,) above 0, proportional to the inverse variance of each sample (WLS); None = OLS.

    Raises:
        CollinearError: a constant candidate, two that are proportional up to a constant, or, with more samples than
            candidates, any that the others determine. (With fewer samples every set of candidates is dependent; the
            selection then leaves out what the selected ones determine.)
        TooFewSamplesError: no freedom left for one variable.
        ValueError: shapes that disagree, values that are not finite, a constant response, weights not above 0.
    """
    options = options or SelectionOptions()
    x, y, w = checked(candidates, response, names, weights)
    check_freedom(len(y), options.freedom_min)
    check_collinear(x, names)
    return _fit(x, y, w, names, _select(x, y, w, options), weights is not None)


def leave_one_out(
    candidates: ArrayLike,
    response: ArrayLike,
    names: Sequence[str],
    weights: ArrayLike | None = None,
    options: SelectionOptions | None = None,
) -> Floats:
    """(n,) response of each sample predicted by a model selected and fitted without it. Arguments and errors as above.

    Raises:
        TooFewSamplesError: as :func:`stepwise`, for one sample fewer.
    """
    options = options or SelectionOptions()
    x, y, w = checked(candidates, response, names, weights)
    check_freedom(len(y) - 1, options.freedom_min)
    predicted = np.empty(len(y))
    for row in range(len(y)):
        keep = np.arange(len(y)) != row
        columns = _select(x[keep], y[keep], w[keep], options)
        root = np.sqrt(w[keep])
        design = np.column_stack((np.ones(len(y)), x[:, columns]))
        parameters = np.linalg.lstsq(root[:, np.newaxis] * design[keep], root * y[keep], rcond=None)[0]
        predicted[row] = design[row] @ parameters
    return predicted


def _select(x: Floats, y: Floats, w: Floats, options: SelectionOptions) -> list[int]:
    """Columns in the order they entered. A QR of the few selected and a projection of all candidates per round."""
    root = np.sqrt(w)
    constant = root[:, np.newaxis]
    columns, target = root[:, np.newaxis] * x, root * y
    # Only the variation about the constant counts, or an offset would hide what a candidate brings.
    unit = constant / np.linalg.norm(constant)
    whole = np.square(columns).sum(axis=0)
    columns, target = columns - unit @ (unit.T @ columns), target - unit[:, 0] * (unit[:, 0] @ target)
    energy = np.square(columns).sum(axis=0)
    # A candidate that varies in one sample only is constant where that one is left out: what remains is rounding.
    varies = energy > CONSTANT**2 * whole
    floor = CONSTANT**2 * (target @ target)
    selected: list[int] = []
    # Every entry lowers the residual by more than a removal may raise it, so this ends; the bound guards rounding.
    for _ in range(4 * x.shape[1] + 4):
        freedom = len(y) - len(selected) - 2
        q = np.linalg.qr(columns[:, selected])[0]
        rest, left = columns - q @ (q.T @ columns), target - q @ (q.T @ target)
        size = np.square(rest).sum(axis=0)
        free = varies & (size > TOLERANCE * energy)
        free[selected] = False
        error = left @ left
        if freedom < options.freedom_min or not free.any() or error <= floor:
            break
        gain = np.zeros(len(size))
        gain[free] = (left @ rest[:, free]) ** 2 / size[free]
        best = int(np.argmax(gain))
        remaining = max(error - gain[best], floor)
        if special.fdtrc(1, freedom, gain[best] * freedom / remaining) >= options.p_enter:
            break
        selected.append(best)
        _remove(columns, target, selected, options)
    return selected


def _remove(columns: Floats, target: Floats, selected: list[int], options: SelectionOptions) -> None:
    """Take out of `selected`, one at a time, what is no longer significant beside the others."""
    while len(selected) > 1:
        q, r = np.linalg.qr(columns[:, selected])
        freedom = len(target) - len(selected) - 1
        projected = q.T @ target
        error = max(float(target @ target - projected @ projected), 0.0) / freedom
        inverse = linalg.solve_triangular(r, np.eye(len(selected)))
        squares = (inverse @ projected) ** 2 / np.square(inverse).sum(axis=1)
        worst = int(np.argmin(squares))
        if error == 0.0 or special.fdtrc(1, freedom, squares[worst] / error) <= options.p_remove:
            return
        del selected[worst]


def _fit(x: Floats, y: Floats, w: Floats, names: Sequence[str], columns: list[int], weighted: bool) -> StepwiseFit:
    import statsmodels.api as sm  # here: with pandas and all that comes with it, it takes a third of a node's start

    design = np.column_stack((np.ones(len(y)), x[:, columns]))
    model = sm.WLS(y, design, weights=w) if weighted else sm.OLS(y, design)
    result = model.fit()
    k = len(columns)
    return StepwiseFit(
        variables=tuple(names[column] for column in columns),
        columns=tuple(columns),
        parameters=np.asarray(result.params),
        standard_errors=np.asarray(result.bse),
        n=len(y),
        k=k,
        r2=float(result.rsquared) if k else 0.0,
        adjusted_r2=float(result.rsquared_adj) if k else 0.0,
        f_statistic=float(result.fvalue) if k else 0.0,
        p_value=float(result.f_pvalue) if k else 1.0,
        residual_sd=float(np.sqrt(result.mse_resid)),
        weighted=weighted,
        covariance=np.asarray(result.normalized_cov_params),
    )
