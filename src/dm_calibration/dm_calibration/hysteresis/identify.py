"""Identification of the hysteresis model from the maps of a calibration run.

Which features a mirror needs is not known beforehand: candidates from none to all of them are fitted to parts of the
run (:mod:`~dm_calibration.hysteresis.candidate_fit`), and the one that best predicts the other parts is taken. Laws
with own weights for each actuator (:mod:`~dm_calibration.hysteresis.own_laws`) are one more candidate, so a mirror
whose actuators are alike keeps its common law.
"""

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np

from dm_calibration.hysteresis.candidate_fit import CANDIDATES, PREISACH, Candidate, CandidateProblem, LawFit
from dm_calibration.hysteresis.excitation import MAPS_PER_ACTUATOR
from dm_calibration.hysteresis.own_laws import OwnFit, OwnLaws
from dm_calibration.hysteresis.run import Run
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.influence.screening import MAD_TO_SIGMA
from dm_common import Bools, Floats
from dm_common.hysteresis import law_shape
from dm_common.hysteresis.model import CREEP_RATE_MAX
from dm_common.mirror import actuators_text

#: The smallest slope of a law that an open loop can invert safely.
SLOPE_MIN = 0.1
#: A simpler candidate is preferred unless its held-out error is larger by more than this factor.
PARSIMONY = 1.03
#: Fewest turns and least swing (normalised) with which an actuator shows its law. One actuator, or up to QUIET_SHARE of
#: all, may turn or move less: they then follow the common law of the others.
TURNS_MIN, SWING_MIN, QUIET_SHARE = 10, 0.3, 0.1


class ExcitationError(TooFewMapsError):
    """The maps do not show hysteresis: too few, or the commands do not turn."""


@dataclass(frozen=True, eq=False)
class Identification:
    """The law of a mirror and how well it predicts.

    Attributes:
        fit: of the chosen candidate, to all maps.
        held_out: (M, D) residual of maps that had no part in the fit: the test maps or, without these, each part of the
            run in turn; NaN = not predicted.
        scores: held-out error of each candidate relative to the best. A richer candidate that hardly fits its own maps
            better than the best one before it gets the score of that one.
        refused: by name, why a candidate, or the final fit, is refused: it cannot be inverted or creeps without bound.
        closest: (M, D) residual of the fit, chosen or not, that is closest to most maps. It shows outliers, which can
            hide behind the larger errors of a law that was chosen because of them.
        quiet: actuators, from 0, that moved or turned too little to show a law of their own.
    """

    fit: LawFit
    held_out: Floats
    closest: Floats
    scores: dict[str, float]
    refused: dict[str, str]
    quiet: tuple[int, ...] = ()

    @property
    def quiet_remark(self) -> str:
        """Sentence that the quiet actuators follow the law of the others; "" = there are none."""
        if not self.quiet:
            return ""
        which = actuators_text(number + 1 for number in self.quiet)
        return (
            f"Hysteresis: the law of {which} is that of the others: its own would need {TURNS_MIN} turns and a swing "
            f"of {SWING_MIN:g} in the run."
        )

    @property
    def changed_remark(self) -> str:
        """Sentence that names the actuators whose law was changed so that it can be inverted; "" = none."""
        if not isinstance(self.fit, OwnFit) or not self.fit.changed.any():
            return ""
        which = actuators_text(np.flatnonzero(self.fit.changed) + 1)
        return f"Hysteresis: as found, the law of {which} could not be inverted safely and was corrected."


def identify(
    run: Run,
    test: Bools | None = None,
    candidates: Sequence[Candidate] = CANDIDATES,
    folds: int = 4,
    blocks: int = 1,
    slope_min: float = SLOPE_MIN,
) -> Identification:
    """Find the law that predicts best.

    Args:
        test: (M,) maps that have no part in the choice and are predicted at the end; None = none.
        candidates: tried in this order; the first must have no hysteresis. One with own laws is tried if the best so
            far agrees with it in having hysteresis or not. It starts from the best common law of its kind or, with
            Duhem operators, from one with a much smaller residual; if the result cannot be inverted, from the next.
        folds: parts of the run, each predicted from the others.
        blocks: contiguous blocks of rows in each part, spread over the run; several avoid extrapolation of slow drift.
        slope_min: smallest slope that a law may have over the signals for which it is meant.

    Raises:
        ExcitationError: the run does not show hysteresis.
    """
    quiet = check_excitation(run)
    usable = run.responses.usable
    test = np.zeros_like(usable) if test is None else test & usable
    choice = _Choice(run, usable & ~test, folds, blocks, slope_min)
    scatter = _scatter(run, choice.train)
    for candidate in candidates:
        if not candidate.own:
            choice.consider(CandidateProblem(run, candidate, scatter))
        elif choice.best is not None and choice.best.problem.candidate.hysteretic == candidate.hysteretic:
            starts = choice.common_laws(candidate.kind)
            for own, whole in _own_law_fits(run, candidate, starts, scatter, choice.train, slope_min):
                choice.consider(own, whole)
                if candidate.name not in choice.refused:
                    break
    best = choice.best
    assert best is not None  # the linear candidate can always be inverted
    fit, held_out = _with_tests(run, test, best, choice) if test.any() else (best.whole, best.held_out)
    residuals = (*choice.residuals, fit.residual)
    closest = min(residuals, key=lambda left: np.median(np.linalg.norm(left[usable], axis=1)))
    scores = {name: score / best.score for name, score in choice.scores.items()}
    return Identification(fit, held_out, closest, scores, choice.refused, quiet)


class _Tried(NamedTuple):
    """A candidate with `whole`, its fit to all maps of the choice, `held_out`, the (M, D) residual that fits without
    the same part of the run leave, NaN elsewhere, and `score`, the rms of that.
    """

    score: float
    problem: CandidateProblem | OwnLaws
    whole: LawFit
    held_out: Floats


class _Choice:
    """The candidates tried so far, and the best of them.

    Args:
        train: (M,) maps by which they are compared.

    Attributes:
        best: None before the first that can be inverted.
        scores, refused: as in Identification, the scores in m rms.
        residuals: (M, D) residual of each.
    """

    def __init__(self, run: Run, train: Bools, folds: int, blocks: int, slope_min: float) -> None:
        self._run, self.train, self.slope_min = run, train, slope_min
        # Each part of a resumed run is divided for itself: a fit without all its maps would not know its figure.
        fold = np.full(len(train), -1)
        for rows, _ in run.parts:
            seen = rows.start + np.flatnonzero(train[rows])
            if seen.size > 1:
                fold[seen] = np.arange(seen.size) * folds * blocks // seen.size % folds
        self._parts = [fold == number for number in range(folds)]
        self.best: _Tried | None = None
        self._common: list[tuple[float, LawFit]] = []
        self.scores: dict[str, float] = {}
        self.refused: dict[str, str] = {}
        self.residuals: list[Floats] = []

    def common_laws(self, kind: tuple[bool, bool]) -> list[LawFit]:
        """Laws common to all actuators of this kind, the best first; those with Duhem operators even if refused."""
        return [fit for _, fit in sorted(self._common, key=lambda tried: tried[0]) if fit.candidate.kind == kind]

    def consider(self, problem: CandidateProblem | OwnLaws, whole: LawFit | None = None) -> None:
        """Try the candidate of `problem`; `whole` is its fit to all of `train`, if that is known already."""
        name, train, best = problem.candidate.name, self.train, self.best
        whole = whole or problem.fit(train)
        self.residuals.append(whole.residual)
        if flat := _too_flat(self._run, whole, self.slope_min):
            self.refused[name] = flat
            if not whole.candidate.own and whole.candidate.slopes:
                self._common.append((np.inf, whole))
            return
        if whole.candidate.own and whole.law.creep_rate >= CREEP_RATE_MAX:
            text = f"it creeps by {CREEP_RATE_MAX:.0%} per decade or more: the maps do not determine its creep"
            self.refused[name] = text
            return
        if best and self._fits_hardly_better(whole, best.whole):
            self.scores[name] = best.score  # it will not predict better either
        else:
            held_out = np.full_like(whole.residual, np.nan)
            for part in self._parts:
                held_out[part] = problem.fit(train & ~part, whole).residual[part]
            self.scores[name] = score = _size(self._run, held_out[np.any(self._parts, axis=0)])
            if best is None or PARSIMONY * score < best.score:
                self.best = _Tried(score, problem, whole, held_out)
        self.refused.pop(name, None)
        if not whole.candidate.own:
            self._common.append((self.scores[name], whole))

    def _fits_hardly_better(self, richer: LawFit, simpler: LawFit) -> bool:
        """Whether `richer` contains all laws of `simpler`, and is hardly closer to the maps of the choice."""
        gain = _size(self._run, simpler.residual[self.train]) / _size(self._run, richer.residual[self.train])
        features = zip(astuple(richer.candidate)[1:], astuple(simpler.candidate)[1:], strict=True)
        return gain < PARSIMONY and all(more >= less for more, less in features)


def _with_tests(run: Run, test: Bools, best: _Tried, choice: _Choice) -> tuple[LawFit, Floats]:
    """The chosen law fitted to all maps, and (M, D) the residual that the fit without the `test` maps leaves of them.

    No other test map may help to predict one: they are of one kind and follow each other, so that two to four times
    less was promised than requests erred by.
    """
    held_out = np.where(test[:, None], best.whole.residual, np.nan)
    whole = best.problem.fit(run.responses.usable, best.whole)
    if flat := _too_flat(run, whole, choice.slope_min):
        choice.refused["the fit that includes the test moves"] = flat
        return best.whole, held_out
    return whole, held_out


def _own_law_fits(
    run: Run, candidate: Candidate, starts: Sequence[LawFit], scatter: Floats, keep: Bools, slope_min: float
) -> Iterator[tuple[OwnLaws, LawFit]]:
    """Own laws that start from each of the common laws `starts`, fitted to the rows `keep`, in the order to be tried.

    Duhem operators stay close to their start, which may be far from the truth in a common law without play operators,
    and near it in one that cannot be inverted. So a start with a much smaller residual than the first one goes first.
    """
    fitted = ((own, own.fit(keep)) for own in (OwnLaws(run, candidate, fit.law, scatter, slope_min) for fit in starts))
    if candidate.slopes:
        made = list(fitted)
        left = [_size(run, fit.residual[keep]) for _, fit in made]
        for number in sorted(range(len(made)), key=lambda number: left[number] * (PARSIMONY if number else 1.0)):
            yield made[number]
    else:
        yield from fitted


def _too_flat(run: Run, fit: LawFit, slope_min: float) -> str:
    """Why the law cannot be inverted safely; "" = it can."""
    slope = law_shape.slope_min(fit.law, *run.in_use)
    if slope.min() >= slope_min:
        return ""
    others = int((slope < slope_min).sum()) - 1
    also = f" (and too low on {others} more)" if others else ""
    whose = f"the slope of actuator {slope.argmin() + 1}" if slope.size > 1 else "its slope"
    return f"{whose} falls to {slope.min():.2f}{also}: it could not be inverted safely"


def _size(run: Run, residual: Floats) -> float:
    """Rms of the coefficients in `residual` (M, D); in its other values, noise of maps would hide errors of laws."""
    return float(np.sqrt(np.mean(np.square(residual[:, : run.responses.coefficients]))))


def check_excitation(run: Run) -> tuple[int, ...]:
    """The few actuators, from 0, that turn or move too little to show their law.

    Raises:
        ExcitationError: the run cannot show hysteresis: too few maps, or too many such actuators.
    """
    usable = int(run.responses.usable.sum())
    actuators = run.signals.shape[1]
    needed = MAPS_PER_ACTUATOR * actuators
    if usable < needed:
        raise ExcitationError(
            f"{usable} usable maps: the hysteresis of {actuators} actuators needs at least {needed}; take 100 to 400"
        )
    change = np.diff(run.signals, axis=0)
    moved = np.where(change != 0.0, np.arange(len(change))[:, None], 0)  # an actuator may stand still before it turns
    change = np.take_along_axis(change, np.maximum.accumulate(moved), 0)
    turns = (change[1:] * change[:-1] < 0.0).sum(axis=0)
    swing = np.ptp(run.signals, axis=0)
    quiet = np.flatnonzero((turns < TURNS_MIN) | (swing < SWING_MIN))
    if quiet.size == actuators or quiet.size > max(1, int(QUIET_SHARE * actuators)):
        worst = int(quiet[np.argmin(turns[quiet])])
        raise ExcitationError(
            f"actuator {worst + 1} turned {turns[worst]} times over a swing of {swing[worst]:.2f} ({quiet.size} of "
            f"{actuators} actuators move too little): {TURNS_MIN} turns and a swing of {SWING_MIN:g} are needed: use "
            "the hysteresis plan"
        )
    return tuple(quiet.tolist())


def _scatter(run: Run, keep: Bools) -> Floats:
    """(D,) uncertainty of each response, from residuals of a rich law: one value for coefficients, one per pattern."""
    responses = run.responses
    scatter = np.where(np.arange(responses.values.shape[1]) < responses.coefficients, 1e-9, 1e-8)
    for _ in range(2):
        left = CandidateProblem(run, PREISACH, scatter).fit(keep, evaluations=4).residual[keep]
        # Robust: maps that no law explains must not set the scale.
        scatter = responses.scatter(MAD_TO_SIGMA * np.median(np.abs(left), axis=0))
    return scatter
