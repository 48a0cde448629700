"""One class of hysteresis models fitted to the maps of a calibration run.

``response = figure(t) + e H`` with the effective signal ``e = sum_f w_f x_f`` of features x (play operators, Duhem
operator, each with its creep), one set of weights w for all actuators and the gains in H. This is bilinear, so H and w
are found by alternating least squares. A Gauss-Newton iteration around that finds the few parameters that enter
nonlinearly: slope of the Duhem operator, creep rate (variable projection [14]).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares

from dm_calibration.hysteresis.features import play_features
from dm_calibration.hysteresis.run import Run, basis_of, without
from dm_common import Bools, Floats
from dm_common.hysteresis.duhem import FadingHysteresis
from dm_common.hysteresis.law_shape import normalised
from dm_common.hysteresis.model import CREEP_RATE_MAX, CREEP_TIMES, HysteresisModel

#: Ridge on the weights, relative to the mean diagonal of the normal matrix: smooths weights that maps do not separate.
RIDGE = 1e-6
#: Rounds of alternating solutions. With 6 a run of 100 maps predicts held-out ones three times worse; 60 gain nothing.
ROUNDS = 20
#: The rounds end early once no effective signal changes by more than this, far below the resolution of a map.
SETTLED = 1e-6
#: Ridge on the gains, relative to the trace of their normal matrix: keeps it regular where actuators hardly move.
SOLVABLE = 1e-13
#: Guess, bounds and scale: of the first coefficient of a slope, of each further one, and of the creep rate.
FIRST_SLOPE, FURTHER_SLOPE = (1.5, -30.0, 30.0, 1.0), (0.0, -30.0, 30.0, 1.0)
CREEP_RATE = (0.01, 0.0, CREEP_RATE_MAX, 0.01)
#: Most evaluations of the Gauss-Newton iteration that starts from a guess, or from a fit to other rows (one step).
EVALUATIONS, EVALUATIONS_AGAIN = 20, 2
#: Creep is set to 0 if it lowers the sum of squares, in units of the scatter, by less than CREEP_SHOWN or, without
#: hysteresis, by less than the share CREEP_SHARE of that sum: slow drift of the figure looks like creep.
CREEP_SHOWN, CREEP_SHARE = 10.0, 0.03


@dataclass(frozen=True)
class Candidate:
    """A choice of features.

    Attributes:
        name: of the class of laws.
        plays: number of play operators beside the signal itself.
        powers: highest power of their values.
        slopes: number of coefficients of the Duhem operator's slope; 0 = no such operator.
        own: each actuator has its own weights, drawn towards common ones (:mod:`~dm_calibration.hysteresis.own_laws`);
            its Duhem operator starts from that of the best common candidate that has one.
    """

    name: str
    plays: int
    powers: int
    slopes: int
    own: bool = False

    @property
    def hysteretic(self) -> bool:
        """Whether it has more than a static response to the signal."""
        return bool(self.plays or self.slopes)

    @property
    def kind(self) -> tuple[bool, bool]:
        """Whether it has hysteresis, and whether some of that fades."""
        return self.hysteretic, bool(self.slopes)

    @property
    def radius(self) -> Floats:
        """(1 + plays,) half-widths of the play operators, that of the signal itself first."""
        return np.concatenate(([0.0], (np.arange(self.plays) + 0.5) / max(self.plays, 1)))


PREISACH = Candidate("Preisach", 20, 3, 0)
CANDIDATES = (
    Candidate("linear", 0, 1, 0),
    Candidate("static", 0, 3, 0),
    Candidate("Prandtl-Ishlinskii", 20, 1, 0),
    PREISACH,
    Candidate("Duhem", 0, 3, 4),
    Candidate("Preisach and Duhem", 20, 3, 4),
    Candidate("static, each actuator its own", 0, 5, 0, own=True),
    Candidate("Preisach, each actuator its own", 30, 10, 0, own=True),
    Candidate("Preisach and Duhem, each actuator its own", 30, 10, 4, own=True),
)
#: The candidates with one law for all actuators.
COMMON = tuple(candidate for candidate in CANDIDATES if not candidate.own)


@dataclass(frozen=True, eq=False)
class LawFit:
    """A candidate fitted to some rows of a run.

    Attributes:
        law: normalised: in a full cycle over the range of the run, effective signals span as much as signals.
        residual: (M, D) of all rows, including those left out of the fit; units of `Responses.values`.
    """

    candidate: Candidate
    law: HysteresisModel
    residual: Floats


class CandidateProblem:
    """One candidate on one run: its features are computed once, then fitted to any rows."""

    def __init__(self, run: Run, candidate: Candidate, scatter: Floats) -> None:
        self.run, self.candidate = run, candidate
        self._plays = run.along(lambda signals: play_features(signals, candidate.radius, candidate.powers, run.rest))
        self._plays_crept = run.crept(self._plays)
        self._scatter = scatter
        self._measured = run.responses.values / scatter
        # Fits to other rows begin at the same slope and take the same steps from it; creep leaves it as it is.
        self._fading = lru_cache(2 * self.candidate.slopes)(self._fading_of)

    def fit(self, keep: Bools, start: LawFit | None = None, evaluations: int | None = None) -> LawFit:
        """Fit to the rows in `keep` (M,), starting from `start` or, without it, from a guess.

        Args:
            evaluations: most evaluations of the residual; None = EVALUATIONS or EVALUATIONS_AGAIN.
        """
        slopes = [FIRST_SLOPE, *[FURTHER_SLOPE] * (self.candidate.slopes - 1)] if self.candidate.slopes else []
        guess, low, high, scale = np.array([*slopes, CREEP_RATE]).T
        if start is not None:
            guess = np.append(start.law.duhem_slope, start.law.creep_rate)
        weights: list[Floats | None] = [None]
        free = basis_of(self.run.figure[keep])
        measured = without(self._measured[keep], free)

        def solve(features: Floats) -> tuple[Floats, Floats]:
            """Weights (F,), residual (M, D) in units of the scatter."""
            begin = np.eye(features.shape[1])[0] if weights[0] is None else weights[0]
            found = _alternate(without(features[keep], free), measured, begin) if len(begin) > 1 else begin
            left = self.run.gains(np.einsum("f,mfn->mn", found, features), keep)[1]
            return found, left / self._scatter

        def residual(nonlinear: Floats) -> Floats:
            try:
                features = self._features(nonlinear)
            except ValueError:  # coefficients that give no valid Duhem operator
                return np.full(int(keep.sum()) * self._measured.shape[1], 1e3)
            weights[0], left = solve(features)
            return np.asarray(left[keep].ravel())

        found = least_squares(
            residual,
            guess,
            bounds=(low, high),
            x_scale=scale,
            diff_step=1e-3,
            max_nfev=evaluations or (EVALUATIONS if start is None else EVALUATIONS_AGAIN),
            xtol=1e-5,
            ftol=1e-6,
        )
        nonlinear, still = found.x, np.append(found.x[:-1], 0.0)
        static, least = float(np.square(residual(still)).sum()), CREEP_SHOWN
        if not self.candidate.hysteretic:
            least = max(least, CREEP_SHARE * static)
        if static - 2.0 * found.cost < least:
            nonlinear = still
        solved, left = solve(self._features(nonlinear))
        return LawFit(self.candidate, self._law(solved, nonlinear), left * self._scatter)

    def _features(self, nonlinear: Floats) -> Floats:
        rate, slope = nonlinear[-1], nonlinear[:-1]
        features = self._plays + rate * self._plays_crept
        if not self.candidate.slopes:
            return features
        fading, crept = self._fading(tuple(slope))
        return np.concatenate((features, fading + rate * crept), axis=1)

    def _fading_of(self, slope: tuple[float, ...]) -> tuple[Floats, Floats]:
        """(M, 1, N) values of the Duhem operator with `slope`, and their creep per unit of creep rate."""
        fading = self.run.fading(FadingHysteresis(np.array(slope)))
        return fading, self.run.crept(fading)

    def _law(self, weights: Floats, nonlinear: Floats) -> HysteresisModel:
        radius, plays = self.candidate.radius, self._plays.shape[1]
        law = HysteresisModel(
            radius,
            weights[:plays].reshape(len(radius), -1),
            nonlinear[:-1].copy(),
            float(weights[plays]) if self.candidate.slopes else 0.0,
            float(nonlinear[-1]),
            CREEP_TIMES,
        )
        return normalised(law, *self.run.reach)


def _alternate(features: Floats, measured: Floats, weights: Floats) -> Floats:
    """(F,) weights by least squares, alternating with the gains and starting from `weights`.

    Args:
        features: (M, F, N) less the part that the figure explains.
        measured: (M, D) likewise, in units of the scatter.
    """
    rows, count, actuators = features.shape
    by_feature = np.ascontiguousarray(features.transpose(1, 0, 2))
    flat = by_feature.reshape(count, rows * actuators)
    same = np.eye(actuators)
    for _ in range(ROUNDS):
        effective = (weights @ flat).reshape(rows, actuators)
        normal = effective.T @ effective
        influence = np.linalg.solve(normal + SOLVABLE * np.trace(normal) * same, effective.T @ measured)
        # Least squares over responses equals least squares over displacements, weighted by H H'.
        gram = influence @ influence.T
        root = np.linalg.cholesky(gram + 1e-9 * np.trace(gram) * same)
        columns = (by_feature.reshape(count * rows, actuators) @ root).reshape(count, -1)
        seen = np.linalg.solve(root, influence @ measured.T).T.ravel()
        normal = columns @ columns.T
        ridge = RIDGE * np.trace(normal) / count * np.eye(count)
        ridge[0, 0] = 0.0
        found = np.linalg.solve(normal + ridge, columns @ seen)
        found = found / found[0]
        change = np.abs((found - weights) @ flat).max()
        weights = found
        if change < SETTLED:
            break
    return weights
