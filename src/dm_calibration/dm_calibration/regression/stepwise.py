"""Forward-backward stepwise selection for a linear regression, ordinary or weighted ([1], section 3.1).

Each round enters the candidate with the smallest p value of its partial F test, if that is below `p_enter`, and then
removes, one by one, those whose p value has risen above `p_remove`. [1] does not name its thresholds. 0.05 and 0.10 are
the defaults of the packages that made the method common ([15], section 15.2). The threshold of removal must be the
larger one, or a candidate could enter and leave for ever.

The statistics of the result are those of statsmodels for the selected model, as if it had been chosen beforehand. The
best of 58 candidates always looks better than chance, so R^2, F and p are optimistic. The meaningful error is that on
unused samples, :func:`leave_one_out`, which repeats the selection without each sample.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, special

from dm_calibration.influence.regression import TooFewMapsError
from dm_common import Floats
from dm_common.errors import ErrorCode, Refusal

#: Share of a candidate's variation not explained by the selected ones, below which it cannot be selected.
TOLERANCE = 1e-8
#: Spread of values, relative to their size, below which they count as constant.
CONSTANT = 1e-12
P_ENTER = 0.05
P_REMOVE = 0.10
#: Least number of degrees of freedom left for the residual: with more candidates than samples, a selection could go on
#: until it fits anything.
FREEDOM_MIN = 10


@dataclass(frozen=True)
class SelectionOptions:
    """Thresholds of the selection.

    Attributes:
        p_enter: largest p value of a candidate that enters; above 0, below 1.
        p_remove: p value above which a variable leaves again; at least p_enter, below 1.
    """

    p_enter: float = P_ENTER
    p_remove: float = P_REMOVE

    def __post_init__(self) -> None:
        if not 0.0 < self.p_enter < 1.0:
            raise ValueError(f"p_enter = {self.p_enter:g}: must be above 0 and below 1; {P_ENTER:g} is usual")
        if not self.p_enter <= self.p_remove < 1.0:
            raise ValueError(
                f"p_remove = {self.p_remove:g}: must be at least p_enter = {self.p_enter:g} and below 1, or a variable "
                f"could enter and leave for ever; {P_REMOVE:g} is usual"
            )


@dataclass(frozen=True, eq=False)
class StepwiseFit:
    """The selected model y = params[0] + sum_j params[j] x_j. Units: those of the response, per unit of x_j.

    Attributes:
        variables: (k,) names, in the order in which they entered.
        columns: (k,) their columns among the candidates.
        result: of statsmodels for the selected model, with its params (k + 1,) and number of samples nobs.
    """

    variables: tuple[str, ...]
    columns: tuple[int, ...]
    result: Any

    @property
    def adjusted_r2(self) -> float:
        """Of the selected model; 0 without variables. Optimistic: see the module."""
        return float(self.result.rsquared_adj) if self.variables else 0.0

    @property
    def f_statistic(self) -> float:
        """Of the model against the constant; 0 without variables."""
        return float(self.result.fvalue) if self.variables else 0.0

    @property
    def p_value(self) -> float:
        """Of the F statistic; 1 without variables. Optimistic: see the module."""
        return float(self.result.f_pvalue) if self.variables else 1.0

    def predict(self, candidates: ArrayLike, weights: ArrayLike | None = None) -> tuple[Floats, Floats, Floats]:
        """Mean and 95 % prediction interval of new samples, without the uncertainty of the selection itself.

        Args:
            candidates: (M, C) all candidates, in the order they had in the fit.
            weights: (M,) of the samples, as in the fit; 1 when None.

        Returns:
            mean, lower, upper: (M,) each, in the unit of the response.
        """
        x = np.asarray(candidates, dtype=float)[:, list(self.columns)]
        found = self.result.get_prediction(np.column_stack((np.ones(len(x)), x)), weights=weights)
        return found.predicted_mean, *found.conf_int(obs=True).T


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
        TooFewMapsError: too few samples for one variable; a constant candidate; two that are proportional up to a
            constant; or, with more samples than candidates, any that the others determine. (With fewer samples,
            candidates are always dependent, and the selection leaves out those that the selected ones determine.)
        ValueError: a constant response.
        Refusal: NOT_SUPPORTED, statsmodels is not installed.
    """
    try:
        import statsmodels.api as sm  # here: with pandas and all that comes with it, it takes a third of a node's start
    except ModuleNotFoundError as error:
        text = "the regression needs statsmodels: `sudo apt-get install python3-statsmodels`, or pip"
        raise Refusal(ErrorCode.NOT_SUPPORTED, text) from error

    options = options or SelectionOptions()
    x, y, w = _samples(candidates, response, weights, 0)
    _check_collinear(x, names)
    columns = _select(x, y, w, options)
    design = np.column_stack((np.ones(len(y)), x[:, columns]))
    model = sm.OLS(y, design) if weights is None else sm.WLS(y, design, weights=w)
    return StepwiseFit(tuple(names[column] for column in columns), tuple(columns), model.fit())


def leave_one_out(
    candidates: ArrayLike,
    response: ArrayLike,
    weights: ArrayLike | None = None,
    options: SelectionOptions | None = None,
) -> Floats:
    """(n,) response of each sample predicted by a model selected and fitted without it.

    Arguments and errors as :func:`stepwise`, for one sample fewer.
    """
    options = options or SelectionOptions()
    x, y, w = _samples(candidates, response, weights, 1)
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
    """Columns in the order they entered. Each round takes a QR of the few selected and projects all candidates."""
    root = np.sqrt(w)
    constant = root[:, np.newaxis]
    columns, target = root[:, np.newaxis] * x, root * y
    # Only the variation about the constant counts: an offset would hide the contribution of a candidate.
    unit = constant / np.linalg.norm(constant)
    whole = np.square(columns).sum(axis=0)
    columns, target = columns - unit @ (unit.T @ columns), target - unit[:, 0] * (unit[:, 0] @ target)
    energy = np.square(columns).sum(axis=0)
    # A candidate that varies in one sample only is constant, up to rounding, when that sample is left out.
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
        if freedom < FREEDOM_MIN or not free.any() or error <= floor:
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
    """Remove from `selected`, one at a time, variables that are not significant beside the others."""
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


def _samples(
    candidates: ArrayLike, response: ArrayLike, weights: ArrayLike | None, left_out: int
) -> tuple[Floats, Floats, Floats]:
    """Candidates, response and weights as arrays, checked to suffice for a regression with `left_out` samples fewer."""
    x, y = np.asarray(candidates, dtype=float), np.asarray(response, dtype=float)
    if len(y) - left_out < FREEDOM_MIN + 2:
        raise TooFewMapsError(
            f"{len(y) - left_out} samples: a constant, one variable and {FREEDOM_MIN} degrees of freedom for the "
            f"residual need at least {FREEDOM_MIN + 2}; measure more surfaces"
        )
    if np.ptp(y) <= CONSTANT * np.abs(y).max():
        raise ValueError(
            "the response is the same for all samples, so there is nothing to explain: use samples that differ"
        )
    return x, y, np.ones(len(y)) if weights is None else np.asarray(weights, dtype=float)


def _check_collinear(x: Floats, names: Sequence[str]) -> None:
    centred = x - x.mean(axis=0)
    size = np.linalg.norm(centred, axis=0)
    constant = np.flatnonzero(size <= CONSTANT * np.maximum(np.linalg.norm(x, axis=0), np.finfo(float).tiny))
    if constant.size:
        raise TooFewMapsError(
            f"candidate {names[constant[0]]} is the same for all samples, like the constant: leave it out, or add "
            "samples in which it differs"
        )
    unit = centred / size
    likeness = np.triu(np.abs(unit.T @ unit), 1)
    alike = np.argwhere(likeness > 1.0 - 0.5 * TOLERANCE)
    if len(alike):
        one, other = alike[0]
        raise TooFewMapsError(
            f"candidates {names[one]} and {names[other]} are proportional over all samples: leave one of them out, or "
            "add samples in which they differ"
        )
    if len(x) > x.shape[1] + 1:
        _, r, order = linalg.qr(unit, mode="economic", pivoting=True)
        diagonal = np.abs(np.diag(r))
        dependent = order[diagonal < np.sqrt(TOLERANCE)]
        if dependent.size:
            listed = ", ".join(sorted(names[column] for column in dependent))
            raise TooFewMapsError(
                f"the other candidates determine {listed}: leave out as many, or add samples that separate them"
            )
