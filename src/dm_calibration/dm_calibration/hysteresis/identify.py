"""Identification of the memory law from the maps of a calibration run.

``response = figure(t) + e H`` with the effective signal ``e = sum_f w_f x_f`` of features x (play operators, Duhem
operator, each with its creep), one set of weights w for all actuators and the gains in H. It is bilinear: H and w are
least-squares solutions in turn. The few numbers that enter otherwise (slope of the Duhem operator, creep rate) are
found by Gauss-Newton around that (variable projection [14]).

Which features a mirror needs is not known beforehand: candidates from none to all are fitted to parts of the run, and
the one that predicts the other parts best is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dm_calibration.hysteresis.features import crept, fading_feature, play_features
from dm_calibration.hysteresis.responses import Responses
from dm_calibration.hysteresis.segments import basis_of, figure_columns, in_parts, parts_of, starts_of
from dm_calibration.influence.regression import TooFewMapsError
from dm_common.hysteresis.duhem import DuhemOperator
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel

Floats = NDArray[np.float64]
Rows = NDArray[np.bool_]

#: Ridge on the weights, relative to their mean evidence: keeps neighbours alike where the data do not tell them apart.
RIDGE = 1e-6
#: Rounds of alternating solutions.
ROUNDS = 6
#: The smallest slope of a law that an open loop can invert safely.
SLOPE_MIN = 0.1
#: A simpler candidate is taken when its held-out error is at most this much larger.
PARSIMONY = 1.03


@dataclass(frozen=True)
class Candidate:
    """A choice of features.

    Attributes:
        name: of the class of laws.
        plays: number of play operators beside the signal itself.
        powers: of their values.
        slopes: coefficients of the Duhem operator's slope; 0 = no such operator.
    """

    name: str
    plays: int
    powers: int
    slopes: int


CANDIDATES = (
    Candidate("linear", 0, 1, 0),
    Candidate("Prandtl-Ishlinskii", 20, 1, 0),
    Candidate("Preisach", 20, 3, 0),
    Candidate("Duhem", 0, 3, 4),
    Candidate("Preisach and Duhem", 20, 3, 4),
)


class ExcitationError(TooFewMapsError):
    """The maps do not show the memory: too few, or the commands do not turn."""


@dataclass(frozen=True, eq=False)
class Run:
    """The commands and responses of one calibration run, in order, from a degauss at mid range on.

    Attributes:
        signals: (M, N) as applied.
        time: (M,) s, of the maps, rising.
        responses: what was measured.
        start: s, when the degauss had ended; None = just before the first map.
        moved: (M,) s, when the mirror took each shape; None = right after the map before.
        segment: (M,) changes where the run was resumed with a degauss; None = it was not interrupted.
    """

    signals: Floats
    time: Floats
    responses: Responses
    start: float | None = None
    moved: Floats | None = None
    segment: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        if (np.diff(self.time) < 0.0).any():
            row = int(np.flatnonzero(np.diff(self.time) < 0.0)[0]) + 1
            back = self.time[row - 1] - self.time[row]
            raise ValueError(f"time stamps: map {row + 1} is {back:.3f} s before the map before it; was the clock set?")

    @property
    def began(self) -> float:
        return float(self.time[0]) - 1.0 if self.start is None else min(self.start, float(self.time[0]))

    @property
    def parts(self) -> list[slice]:
        """Rows of each part of the run, from one degauss to the next."""
        return parts_of(np.zeros(len(self.time), dtype=np.int64) if self.segment is None else self.segment)


@dataclass(frozen=True, eq=False)
class LawFit:
    """A candidate fitted to some rows of a run.

    Attributes:
        candidate: which.
        law: with effective signals that span 2 in a full cycle.
        residual: (M, D) of all rows, those left out included; units of `Responses.values`.
        weight_covariance: (F, F) of the features' weights, relative to the signal's, for the scatter of the fit.
    """

    candidate: Candidate
    law: HysteresisModel
    residual: Floats
    weight_covariance: Floats


class _Problem:
    """One candidate on one run: features once, then fits to any rows."""

    def __init__(self, run: Run, candidate: Candidate, scatter: Floats) -> None:
        self.run, self.candidate, self._scatter = run, candidate, scatter
        self.radius = np.concatenate(([0.0], (np.arange(candidate.plays) + 0.5) / max(candidate.plays, 1)))
        self._parts = run.parts
        self._starts = [run.began, *starts_of(self._parts, run.time, run.moved)]
        powers = candidate.powers
        self._plays = in_parts(self._parts, lambda part: play_features(run.signals[part], self.radius, powers))
        self._plays_crept = self._crept(self._plays)
        self._measured = run.responses.values / scatter
        self._figure = figure_columns(run.time, self._parts, self._starts)

    def _crept(self, features: Floats) -> Floats:
        """What creep adds to `features` (M, F, N) per unit of creep rate; each part begins rested."""
        time, moved = self.run.time, self.run.moved
        start = {part.start: start for part, start in zip(self._parts, self._starts, strict=True)}
        return in_parts(
            self._parts,
            lambda part: crept(features[part], time[part], start[part.start], None if moved is None else moved[part]),
        )

    def fit(self, keep: Rows, start: LawFit | None = None, evaluations: int = 20) -> LawFit:
        """Fit to the rows in `keep` (M,)."""
        slopes = self.candidate.slopes
        if start is None:
            guess = np.concatenate((np.full(min(slopes, 1), 1.5), np.zeros(max(slopes - 1, 0)), [0.01]))
        else:
            guess = np.concatenate((start.law.duhem_slope, [start.law.creep_rate]))
        weights: list[Floats | None] = [None]

        def residual(nonlinear: Floats) -> Floats:
            try:
                features = self._features(nonlinear)
            except ValueError:  # a Duhem operator that leads nowhere
                return np.full(int(keep.sum()) * self._measured.shape[1], 1e3)
            weights[0], left, _ = self._solve(features, keep, weights[0])
            return np.asarray(left[keep].ravel())

        low = np.concatenate((np.full(slopes, -30.0), [0.0]))
        high = np.concatenate((np.full(slopes, 30.0), [0.2]))
        scale = np.concatenate((np.ones(slopes), [0.01]))
        found = least_squares(
            residual, guess, bounds=(low, high), x_scale=scale, diff_step=1e-3, max_nfev=evaluations, xtol=1e-5,
            ftol=1e-6,
        )  # fmt: skip
        features = self._features(found.x)
        solved, left, covariance = self._solve(features, keep, weights[0])
        return LawFit(self.candidate, self._law(solved, found.x), left * self._scatter, covariance)

    def _features(self, nonlinear: Floats) -> Floats:
        rate, slope = nonlinear[-1], nonlinear[:-1]
        features = self._plays + rate * self._plays_crept
        if not self.candidate.slopes:
            return features
        operator = DuhemOperator(slope)
        fading = in_parts(self._parts, lambda part: fading_feature(self.run.signals[part], operator))
        fading = fading + rate * self._crept(fading)
        return np.concatenate((features, fading), axis=1)

    def _solve(self, features: Floats, keep: Rows, weights: Floats | None) -> tuple[Floats, Floats, Floats]:
        """Weights (F,), residual (M, D) in units of the scatter, covariance of the weights."""
        measured, figure = self._measured[keep], self._figure[keep]
        free = basis_of(figure)
        kept = features[keep]
        without_figure = measured - free @ (free.T @ measured)
        count = features.shape[1]
        if weights is None:
            weights = np.eye(count)[0]
        covariance = np.zeros((count, count))
        rows, actuators = len(kept), kept.shape[2]
        flat = kept.reshape(rows, -1)
        projected = (flat - free @ (free.T @ flat)).reshape(kept.shape)
        for _ in range(ROUNDS if count > 1 else 1):
            design = np.hstack((figure, np.einsum("f,mfn->mn", weights, kept)))
            solution = np.linalg.lstsq(design, measured, rcond=1e-10)[0]
            influence = solution[figure.shape[1] :]
            if count == 1:
                break
            # Least squares over responses equals least squares over displacements, weighted by H H'.
            gram = influence @ influence.T
            root = np.linalg.cholesky(gram + 1e-9 * np.trace(gram) * np.eye(actuators))
            columns = np.einsum("mfn,nk->fmk", projected, root, optimize=True).reshape(count, -1)
            seen = np.linalg.solve(root, influence @ without_figure.T).T.ravel()
            normal = columns @ columns.T
            ridge = RIDGE * np.trace(normal) / count * np.eye(count)
            ridge[0, 0] = 0.0
            inverse = np.linalg.inv(normal + ridge)
            weights = inverse @ (columns @ seen)
            covariance = inverse
            weights = weights / weights[0]
        design = np.hstack((self._figure, np.einsum("f,mfn->mn", weights, features)))
        return weights, self._measured - design @ solution, covariance

    def _law(self, weights: Floats, nonlinear: Floats) -> HysteresisModel:
        plays = len(self.radius) * self.candidate.powers
        law = HysteresisModel(
            self.radius,
            weights[:plays].reshape(len(self.radius), self.candidate.powers),
            nonlinear[:-1].copy(),
            float(weights[plays]) if self.candidate.slopes else 0.0,
            float(nonlinear[-1]),
            CREEP_TIMES,
        )
        return law.scaled(2.0 / law.span())


@dataclass(frozen=True, eq=False)
class Identification:
    """The law of a mirror and how well it predicts.

    Attributes:
        fit: of the chosen candidate, to all maps.
        held_out: (M, D) residual of maps that had no part in the fit: the test maps, or where there are none, each part
            of the run in turn; NaN = not predicted.
        scores: held-out error of each candidate in units of the scatter of the best.
        refused: candidates that cannot be inverted, with the reason.
    """

    fit: LawFit
    held_out: Floats
    scores: dict[str, float]
    refused: dict[str, str]


def identify(
    run: Run,
    test: Rows | None = None,
    candidates: Sequence[Candidate] = CANDIDATES,
    folds: int = 4,
    progress: Callable[[str], None] = lambda step: None,
) -> Identification:
    """Find the law that predicts best.

    Args:
        test: (M,) maps that have no part in the choice and are predicted at the end; None = none.
        folds: contiguous parts of the run that are predicted from the others.

    Raises:
        ExcitationError: the run does not show the memory.
        ValueError: time stamps that run backwards.
    """
    check_excitation(run)
    usable = run.responses.usable
    test = np.zeros_like(usable) if test is None else test & usable
    train = usable & ~test
    scatter = _scatter(run, train)
    part = np.zeros(len(usable), dtype=int)
    part[train] = np.arange(train.sum()) * folds // train.sum()
    best: tuple[float, _Problem, LawFit, Floats] | None = None
    scores: dict[str, float] = {}
    refused: dict[str, str] = {}
    for candidate in candidates:
        progress(candidate.name)
        problem = _Problem(run, candidate, scatter)
        whole = problem.fit(train)
        slope = whole.law.slope_min()
        if slope < SLOPE_MIN:
            refused[candidate.name] = f"its slope falls to {slope:.2f}: it could not be inverted safely"
            continue
        held_out = np.full_like(whole.residual, np.nan)
        for fold in range(folds):
            left_out = train & (part == fold)
            held_out[left_out] = problem.fit(train & ~left_out, whole, evaluations=4).residual[left_out]
        score = float(np.sqrt(np.mean(np.square(held_out[train] / scatter))))
        scores[candidate.name] = score
        if best is None or PARSIMONY * score < best[0]:
            best = (score, problem, whole, held_out)
    assert best is not None  # the linear candidate can always be inverted
    score, problem, fitted, held_out = best
    if test.any():
        held_out = np.where(test[:, None], fitted.residual, np.nan)
        fitted = problem.fit(usable, fitted, evaluations=8)
    return Identification(fitted, held_out, {name: s / score for name, s in scores.items()}, refused)


def check_excitation(run: Run) -> None:
    """Refuse runs that cannot show the memory.

    Raises:
        ExcitationError: fewer maps than unknowns, or actuators that hardly turn or hardly move.
    """
    usable = int(run.responses.usable.sum())
    actuators = run.signals.shape[1]
    needed = 2 * actuators
    if usable < needed:
        raise ExcitationError(
            f"{usable} usable maps: the memory of {actuators} actuators needs at least {needed}; take 100 to 400"
        )
    change = np.diff(run.signals, axis=0)
    turns = (change[1:] * change[:-1] < 0.0).sum(axis=0)
    swing = np.ptp(run.signals, axis=0)
    quiet = np.flatnonzero((turns < 10) | (swing < 0.3))
    if quiet.size:
        worst = int(quiet[np.argmin(turns[quiet])])
        raise ExcitationError(
            f"actuator {worst + 1} turned {turns[worst]} times over a swing of {swing[worst]:.2f} "
            f"({quiet.size} of {actuators} actuators like it): 10 turns over 0.3 are needed: use the memory plan"
        )


def _scatter(run: Run, keep: Rows) -> Floats:
    """(D,) uncertainty of each response, from what a rich law leaves: one value for coefficients, one per pattern."""
    responses = run.responses
    scatter = np.ones(responses.values.shape[1])
    scatter[: responses.coefficients] = 1e-9
    scatter[responses.coefficients :] = 1e-8
    richest = next(candidate for candidate in CANDIDATES if candidate.name == "Preisach")
    for _ in range(2):
        left = _Problem(run, richest, scatter).fit(keep, evaluations=4).residual[keep]
        # Robust: maps that no law explains must not set the scale.
        size = 1.4826 * np.median(np.abs(left), axis=0)
        scatter = np.maximum(size, 1e-11)
        scatter[: responses.coefficients] = max(float(np.median(size[: responses.coefficients])), 1e-11)
    return scatter
