"""Identification of the hysteresis model from the maps of a calibration run.

Which features a mirror needs is not known beforehand: candidates from none to all are fitted to parts of the run
(:mod:`~dm_calibration.hysteresis.candidate_fit`), and the one that predicts the other parts best is taken. Laws of
each actuator by itself (:mod:`~dm_calibration.hysteresis.own_laws`) are one more candidate, so a mirror whose actuators
are alike keeps its common law.
"""

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass

import numpy as np

from dm_calibration.hysteresis.candidate_fit import CANDIDATES, PREISACH, Candidate, CandidateProblem, LawFit, Rows
from dm_calibration.hysteresis.excitation import MAPS_PER_ACTUATOR
from dm_calibration.hysteresis.own_laws import OwnFit, OwnLaws
from dm_calibration.hysteresis.run import Run
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.influence.screening import MAD_TO_SIGMA
from dm_common import Floats
from dm_common.hysteresis import law_shape
from dm_common.hysteresis.model import CREEP_RATE_MAX

#: The smallest slope of a law that an open loop can invert safely.
SLOPE_MIN = 0.1
#: A simpler candidate is taken when its held-out error is at most this much larger.
PARSIMONY = 1.03
#: Where a run has fewer other maps than so many per actuator, or tests in its first half, so that it may end early,
#: each half of the test maps is predicted with the other half in the fit. Without any, moves in use lie far outside
#: what so few maps show: 5 to 10 nm in the median of mirrors after 100 maps, where the final fit errs by 3.
FEW = 4
#: How often an actuator must turn, and over what swing, to show a law, and the share of them, one at least, that may do
#: less: the others determine the common law, and what is not known of those few follows it.
TURNS_MIN, SWING_MIN, QUIET_SHARE = 10, 0.3, 0.1


class ExcitationError(TooFewMapsError):
    """The maps do not show hysteresis: too few, or the commands do not turn."""


@dataclass(frozen=True, eq=False)
class Identification:
    """The law of a mirror and how well it predicts.

    Attributes:
        fit: of the chosen candidate, to all maps.
        held_out: (M, D) residual of maps that had no part in the fit: the test maps, or where there are none, each part
            of the run in turn; NaN = not predicted.
        scores: held-out error of each candidate relative to the best; that of the best before it, of a richer one that
            leaves hardly less in the maps it was fitted to.
        refused: candidates that cannot be inverted, or creep without bound, with the reason; the final fit too.
        quiet: actuators, from 0, that moved or turned too little to show a law of their own.
    """

    fit: LawFit
    held_out: Floats
    scores: dict[str, float]
    refused: dict[str, str]
    quiet: tuple[int, ...] = ()

    @property
    def quiet_remark(self) -> str:
        """That the quiet actuators follow the law of the others, as a sentence; "" = there are none."""
        if not self.quiet:
            return ""
        names = ", ".join(str(number + 1) for number in self.quiet)
        return (
            f"Hysteresis: the law of actuator{'s' if len(self.quiet) > 1 else ''} {names} is that of the others: "
            f"{TURNS_MIN} turns over {SWING_MIN:g} are needed in a run to show its own."
        )

    @property
    def changed_remark(self) -> str:
        """Whose law was changed so that it can be inverted, as a sentence; "" = nobody's."""
        if not isinstance(self.fit, OwnFit) or not self.fit.changed.any():
            return ""
        names = ", ".join(str(number + 1) for number in np.flatnonzero(self.fit.changed))
        return (
            f"Hysteresis: as found, the law of actuator{'s' if self.fit.changed.sum() > 1 else ''} {names} could not "
            "be inverted safely; it was changed so that it can."
        )


def identify(
    run: Run,
    test: Rows | None = None,
    candidates: Sequence[Candidate] = CANDIDATES,
    folds: int = 4,
    blocks: int = 1,
    slope_min: float = SLOPE_MIN,
) -> Identification:
    """Find the law that predicts best.

    Args:
        test: (M,) maps that have no part in the choice and are predicted at the end; None = none.
        candidates: in this order; the first has no hysteresis to invert. An own one counts where the best before has
            hysteresis as it has, and begins with the best common one of its kind; where it fades, with another if that
            leaves much less; where it cannot be inverted then, with the next.
        folds: parts of the run that are predicted from the others.
        blocks: contiguous rows that make a part, spread over the run: with several, no slow drift has to be foreseen.
        slope_min: smallest slope of a law over the signals that it is for.

    Raises:
        ExcitationError: the run does not show hysteresis.
    """
    quiet = check_excitation(run)
    usable = run.responses.usable
    test = np.zeros_like(usable) if test is None else test & usable
    early = bool(test[: len(test) // 2].any())
    train = usable & ~test
    scatter = _scatter(run, train)
    part = np.zeros(len(usable), dtype=int)
    part[train] = np.arange(train.sum()) * folds * blocks // train.sum() % folds
    best: tuple[float, CandidateProblem | OwnLaws, LawFit, Floats] | None = None
    common: list[tuple[float, LawFit]] = []  # own laws that fade may begin with one that cannot be inverted, too
    scores: dict[str, float] = {}
    refused: dict[str, str] = {}

    def size(residual: Floats) -> float:
        return _size(run, residual[train])

    def consider(problem: CandidateProblem | OwnLaws, whole: LawFit | None = None) -> None:
        nonlocal best
        name = problem.candidate.name
        whole = whole or problem.fit(train)
        if flat := _too_flat(run, whole, slope_min):
            refused[name] = flat
            if not whole.candidate.own and whole.candidate.slopes:
                common.append((np.inf, whole))
            return
        if whole.candidate.own and whole.law.creep_rate >= CREEP_RATE_MAX:
            refused[name] = f"it creeps by {CREEP_RATE_MAX:.0%} per decade or more: the maps do not tell its creep"
            return
        gain = size(best[2].residual) / size(whole.residual) if best else np.inf
        if best and _contains(whole.candidate, best[2].candidate) and gain < PARSIMONY:
            scores[name] = best[0]  # what it leaves of its own maps is hardly less: nor is what it predicts
        else:
            held_out = np.full_like(whole.residual, np.nan)
            for fold in range(folds):
                left_out = train & (part == fold)
                held_out[left_out] = problem.fit(train & ~left_out, whole).residual[left_out]
            scores[name] = size(held_out)
            if best is None or PARSIMONY * scores[name] < best[0]:
                best = (scores[name], problem, whole, held_out)
        refused.pop(name, None)
        if not whole.candidate.own:
            common.append((scores[name], whole))

    for candidate in candidates:
        if not candidate.own:
            consider(CandidateProblem(run, candidate, scatter))
        elif best is not None and best[1].candidate.hysteretic == candidate.hysteretic:
            common.sort(key=lambda scored: scored[0])
            starts = [fit for _, fit in common if fit.candidate.kind == candidate.kind]
            for own, whole in _begun(run, candidate, starts, scatter, train, slope_min):
                consider(own, whole)
                if candidate.name not in refused:
                    break
    assert best is not None  # the linear candidate can always be inverted
    score, problem, fitted, held_out = best
    if test.any():
        held_out = np.where(test[:, None], fitted.residual, np.nan)
        if early or train.sum() < FEW * run.signals.shape[1]:
            half = 2 * np.cumsum(test) > test.sum()
            for left_out in (test & half, test & ~half):
                if left_out.any():
                    held_out[left_out] = problem.fit(usable & ~left_out, fitted).residual[left_out]
        whole = problem.fit(usable, fitted)
        if flat := _too_flat(run, whole, slope_min):
            refused["the fit that takes in the test moves"] = flat
            held_out = np.where(test[:, None], fitted.residual, np.nan)
        else:
            fitted = whole
    return Identification(fitted, held_out, {name: s / score for name, s in scores.items()}, refused, quiet)


def _begun(
    run: Run, candidate: Candidate, starts: Sequence[LawFit], scatter: Floats, keep: Rows, slope_min: float
) -> Iterator[tuple[OwnLaws, LawFit]]:
    """Own laws that begin with each of the common ones `starts`, fitted to the rows `keep`, in the order to be tried.

    How hysteresis fades stays nearly as it begins, and a law without plays may begin far from what it is, or one that
    cannot be inverted near it: another than the first of `starts` comes first where it leaves much less.
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
    """Why the law could not be inverted safely; "" = it could."""
    slope = law_shape.slope_min(fit.law, *run.in_use)
    if slope.min() >= slope_min:
        return ""
    whose = f"the slope of actuator {slope.argmin() + 1}" if slope.size > 1 else "its slope"
    return f"{whose} falls to {slope.min():.2f}: it could not be inverted safely"


def _size(run: Run, residual: Floats) -> float:
    """Root mean square of the coefficients of `residual` (M, D): beside them the noise of maps hides errors of laws."""
    return float(np.sqrt(np.mean(np.square(residual[:, : run.responses.coefficients]))))


def _contains(richer: Candidate, simpler: Candidate) -> bool:
    """Whether the laws of `richer` are those of `simpler` and more."""
    return all(more >= less for more, less in zip(astuple(richer)[1:], astuple(simpler)[1:], strict=True))


def check_excitation(run: Run) -> tuple[int, ...]:
    """The few actuators, from 0, that hardly turn or hardly move; runs that cannot show hysteresis are refused.

    Raises:
        ExcitationError: fewer maps than unknowns, or many actuators, or all, that hardly turn or hardly move.
    """
    usable = int(run.responses.usable.sum())
    actuators = run.signals.shape[1]
    needed = MAPS_PER_ACTUATOR * actuators
    if usable < needed:
        raise ExcitationError(
            f"{usable} usable maps: the hysteresis of {actuators} actuators needs at least {needed}; take 100 to 400"
        )
    change = np.diff(run.signals, axis=0)
    turns = (change[1:] * change[:-1] < 0.0).sum(axis=0)
    swing = np.ptp(run.signals, axis=0)
    quiet = np.flatnonzero((turns < TURNS_MIN) | (swing < SWING_MIN))
    if quiet.size == actuators or quiet.size > max(1, int(QUIET_SHARE * actuators)):
        worst = int(quiet[np.argmin(turns[quiet])])
        raise ExcitationError(
            f"actuator {worst + 1} turned {turns[worst]} times over a swing of {swing[worst]:.2f} "
            f"({quiet.size} of {actuators} actuators like it): {TURNS_MIN} turns over {SWING_MIN:g} are "
            "needed: use the hysteresis plan"
        )
    return tuple(quiet.tolist())


def _scatter(run: Run, keep: Rows) -> Floats:
    """(D,) uncertainty of each response, from what a rich law leaves: one value for coefficients, one per pattern."""
    responses = run.responses
    scatter = np.where(np.arange(responses.values.shape[1]) < responses.coefficients, 1e-9, 1e-8)
    for _ in range(2):
        left = CandidateProblem(run, PREISACH, scatter).fit(keep, evaluations=4).residual[keep]
        # Robust: maps that no law explains must not set the scale.
        scatter = responses.scatter(MAD_TO_SIGMA * np.median(np.abs(left), axis=0))
    return scatter
