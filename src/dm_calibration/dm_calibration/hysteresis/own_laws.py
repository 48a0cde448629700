"""Hysteresis and creep laws of each actuator, drawn towards common ones where the maps do not determine them.

Hysteresis is a Preisach operator of a general density over centre and half-width of its relays: for each half-width r
any smooth function of the value of the play operator p_r [16]. Functions are Legendre series in p_r. A Gaussian prior
makes them similar for neighbouring r and small for high orders; only its strongest patterns are kept, so that sixty
numbers per actuator describe a law. The patterns of all actuators are drawn towards each other: weights that the maps
hardly determine for one actuator become the mean of the others. Creep is a spectrum over the elements of the model,
smooth over the logarithm of time, also drawn towards a common one. Fast elements may follow loops with a spectrum of
their own, since loops are wider for fast moves, and creep may change over the range. Low-order shapes move all
actuators alike, so an effect left out here would not average out in them: it would pass for slow creep.

Responses are linear in the gains of the actuators, in their patterns and in their spectra. Each of the three is solved
for in turn by regularised least squares, given the other two. The patterns of all actuators are one system, since the
responses of neighbours overlap; its matrix is the elementwise product of the Gram matrices of features and gains.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import block_diag

from dm_calibration.hysteresis.actuator_weights import SPREAD, Known, alike, likeliest_spread, weights_of
from dm_calibration.hysteresis.candidate_fit import Candidate, LawFit
from dm_calibration.hysteresis.features import (
    DUHEM_ROUNDS,
    PER_ELEMENT,
    fading_changes,
    own_slopes,
    padded_slope,
    pattern_basis,
    play_values,
    play_weights,
    smoothness,
    spectrum_prior,
    weight_of,
)
from dm_calibration.hysteresis.responses import agreeing
from dm_calibration.hysteresis.run import Run, basis_of, without
from dm_calibration.hysteresis.steepness import Steepness, shrink
from dm_calibration.influence.screening import MAD_TO_SIGMA
from dm_common import Bools, Floats
from dm_common.hysteresis.duhem import NO_DRIVE, NONE, FadingHysteresis
from dm_common.hysteresis.law_shape import normalised
from dm_common.hysteresis.model import CREEP_RATE_MAX, CREEP_TIMES, HysteresisModel

#: Prior standard deviations: of the weight of a Duhem operator; of that weight times the change of a slope coefficient.
DUHEM_WEIGHT, DUHEM_CHANGE = 0.3, 0.1
#: Linear Duhem operators: rates, per signal travelled; number of powers of the signal that they follow, from 0 on;
#: prior standard deviation of their weights.
FADING_RATE, FADING_POWERS, FADING_WEIGHT = np.array([1.0, 3.0, 9.0]), 3, 0.1
#: Prior of the creep spectrum: standard deviation relative to the common rate; spread of actuators, relative to that.
SPECTRUM, SPECTRUM_SPREAD = 0.5, 0.3
#: Correlation length of that prior, in elements.
SPECTRUM_CORRELATION = 12.0
#: Loops may have another spectrum over elements of up to LAG_S (s); LAG: prior standard deviation of the difference.
LAG_S, LAG = 30.0, 0.02
LAGS = int(np.count_nonzero(CREEP_TIMES <= LAG_S))
#: Rows of the weights of creep: its elements, and their additional weights for loops; the last row is the creep slope.
ELEMENTS, LAGGED = slice(len(CREEP_TIMES)), slice(len(CREEP_TIMES), -1)
#: Prior standard deviation of the relative change of creep from mid range to the end.
CREEP_SLOPE = 0.3
#: Rounds of the three alternating solutions, for a run of ROUNDS_MAPS maps: with 6, slow creep is a third less accurate
#: and held-out errors are up to four times as large; 60 are hardly better. Shorter runs get proportionally more: for
#: 100 maps errors after 60 rounds are up to a quarter smaller than after 20, on some mirrors a tenth larger.
ROUNDS, ROUNDS_MAPS = 20, 300
#: Residual from which a map is an outlier during the fit, in medians. A law partly follows 16 outliers among 314 maps,
#: whose residuals then are 4 to 16 medians: a limit of 8 finds five of them, a limit of 6 finds all, one after the
#: other, and in the end they have 12 to 30.
OUTLIER_OF_FIT = 6.0
#: Fewest maps per actuator from which the spread between actuators is estimated: a close fit to fewer overestimates it.
SPREAD_MAPS = 5
#: If several laws are too flat to be inverted safely, all are fitted again so that they rise, unless residuals become
#: RISEN times as large. One still too flat, or a single one, loses a share of its hysteresis, in up to SHRINKS steps;
#: if it has its own Duhem operator and would keep less than SHRUNK, it takes the common operator first.
RISEN, SHRINKS, SHRUNK = 2.0, 8, 0.9


@dataclass(frozen=True, eq=False)
class OwnFit(LawFit):
    """Laws of each actuator fitted to some rows of a run.

    Attributes:
        patterns: (F, N) weights of the features of each actuator.
        creep: (J + L + 1, N) weights of the creep elements, additional weights of the first L of them for loops, and
            the change of creep per unit of position.
        scatter: (D,) uncertainty of each response, from the residual of these laws.
        changed: (N,) whether a law was changed so that it can be inverted, see SHRUNK.
    """

    patterns: Floats
    creep: Floats
    scatter: Floats
    changed: Bools


class OwnLaws:
    """Laws of each actuator on one run: features are computed once, then fitted to any rows.

    Args:
        candidate: play operators and orders of the Legendre series.
        common: law of all actuators from which the fit starts.
        scatter: (D,) initial uncertainty of each response.
        slope_min: smallest slope that each law may have, see SHRUNK.

    Attributes:
        spread: of the patterns between actuators, estimated in the first fit and reused by later ones to other rows;
            None = not yet estimated (before half of its rounds), or too few maps to do so.
    """

    def __init__(
        self, run: Run, candidate: Candidate, common: HysteresisModel, scatter: Floats, slope_min: float
    ) -> None:
        self.run, self.candidate, self._scatter = run, candidate, scatter
        self._slope = common.duhem_slope
        radius, orders = candidate.radius, candidate.powers
        self._basis = pattern_basis(radius, orders)
        self._steepness = Steepness(self._basis, radius, *run.in_use, slope_min)
        signals = run.signals - run.rest
        values = run.along(lambda signals: play_values(signals, radius, run.rest))
        series = legendre.legvander(values, orders)[..., 1:] - legendre.legvander(np.full(1, run.rest), orders)[0, 1:]
        flat = series.transpose(0, 2, 1, 3).reshape(*signals.shape, -1)
        columns = [signals[:, None, :], (flat @ self._basis).transpose(0, 2, 1)]
        if candidate.slopes:
            linear = FadingHysteresis(rates=FADING_RATE, drive=np.zeros((len(FADING_RATE), FADING_POWERS)))
            columns.append(run.fading(linear))
        self._plain = np.concatenate(columns, axis=1)
        #: Feature ranges: the patterns of the play operators, and the linear Duhem operators.
        first = 1 + self._basis.shape[1]
        self._patterned, self._linear = slice(1, first), slice(first, self._plain.shape[1])
        self.spread: float | None = None
        self._rounds_needed = max(ROUNDS, ROUNDS * ROUNDS_MAPS // max(len(signals), 1))
        self._creeps, self._creep = common.creep_rate > 0.0, weight_of(common.creep_rate)
        elements = spectrum_prior(common.creep_rate, SPECTRUM, SPECTRUM_CORRELATION)
        lag = LAG**2 * smoothness(LAGS, SPECTRUM_CORRELATION)
        prior = block_diag(elements, lag, CREEP_SLOPE**2)
        self._creep_root = np.asarray(np.linalg.cholesky(prior), dtype=np.float64)
        self._signal_states = self.run.creep_states(signals)
        self._creep_between = alike(signals.shape[1], SPECTRUM_SPREAD)

    def fit(self, keep: Bools, start: LawFit | None = None) -> OwnFit:
        """Fit to the rows in `keep` (M,), from `start`, whose Duhem operators are kept, or from no hysteresis."""
        actuators = self._plain.shape[2]
        if isinstance(start, OwnFit):
            patterns, creep = start.patterns, start.creep
            scatter, slope, changed = start.scatter, start.law.duhem_slope, start.changed
        else:
            patterns = np.eye(self._plain.shape[1], 1) * np.ones(actuators)
            # Where the maps show no common creep, no actuator has any.
            creep = np.zeros((len(self._creep_root), actuators))
            creep[ELEMENTS] = self._creep if self._creeps else 0.0
            scatter, slope, changed = self._scatter, self._slope, np.zeros(actuators, dtype=bool)
            if slope.size and actuators > 1:  # in a message, a law with one weight has one slope for both directions
                slope = padded_slope(slope, actuators)
                own = self._linear.stop
                for _ in range(DUHEM_ROUNDS):
                    changing = np.concatenate((self._features(slope), self._changes(slope)), axis=1)
                    patterns, creep, scatter, _ = self._rounds(changing, keep, patterns, creep, scatter, None)
                    slope = own_slopes(slope, patterns[own], patterns[own + 1 :])
                    patterns = patterns[: own + 1]
        common = slope if isinstance(start, OwnFit) else padded_slope(self._slope, actuators)
        while True:
            features = self._features(slope)
            patterns, creep, scatter, residual = self._rounds(features, keep, patterns, creep, scatter, None)
            law, share = self._law(patterns, creep, slope)
            if slope.ndim < 3 or not (worse := (share < SHRUNK) & (slope != common).any(axis=(1, 2))).any():
                break
            slope, changed = np.where(worse[:, None, None], common, slope), changed | worse
            patterns[-1, worse] = 0.0
        if (flat := share < 1.0).sum() > 1:
            risen = self._rounds(features, keep, patterns, creep, scatter, slope)
            if np.linalg.norm(risen[-1][keep]) < RISEN * np.linalg.norm(residual[keep]):
                (patterns, creep, scatter, residual), changed = risen, changed | flat
                law, share = self._law(patterns, creep, slope)
        for _ in range(SHRINKS):
            if not (flat := share < 1.0).any() or not shrink(patterns, share, self._linear.stop):
                break
            changed = changed | flat
            law, share = self._law(patterns, creep, slope)
            crept = self._with_creep(features, creep, patterns)
            residual = self.run.gains(np.einsum("mfn,fn->mn", crept, patterns), keep)[1]
        return OwnFit(self.candidate, law, residual, patterns, creep, scatter, changed)

    def _features(self, slope: Floats) -> Floats:
        """(M, F, N) the signal, the patterns of the play operators, and the Duhem operator with `slope`, if any."""
        if not slope.size:
            return self._plain
        return np.concatenate((self._plain, self.run.fading(FadingHysteresis(slope))), axis=1)

    def _changes(self, slope: Floats) -> Floats:
        """(M, 2 A, N) derivatives of the Duhem operators by their coefficients `slope` (N, 2, A)."""
        return self.run.along(lambda signals: fading_changes(signals, slope, self.run.rest))

    def _rounds(
        self, features: Floats, keep: Bools, patterns: Floats, creep: Floats, scatter: Floats, rise: Floats | None
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Patterns (F, N), creep (J + L + 1, N), scatter (D,) and residual (M, D) after all rounds.

        With `rise`, the coefficients of the Duhem operators, laws are made to rise everywhere.

        Laws with so many weights follow outliers, so each round leaves out those of the last one: see OUTLIER_OF_FIT.
        """
        sigma = np.full(features.shape[1], DUHEM_CHANGE)
        sigma[: self._linear.stop + 1] = DUHEM_WEIGHT
        sigma[self._linear], sigma[self._patterned], sigma[0] = FADING_WEIGHT, 1.0, 1.0
        patterns = np.vstack((patterns, np.zeros((features.shape[1] - len(patterns), features.shape[2]))))
        features, patterns = features * sigma[:, None], patterns / sigma[:, None]  # in units of their prior
        crept = self._with_creep(features, creep, patterns)
        gains, residual = self.run.gains(np.einsum("mfn,fn->mn", crept, patterns), keep)
        given = keep
        for number in range(self._rounds_needed):
            keep = agreeing(given, residual, OUTLIER_OF_FIT)
            free = basis_of(self.run.figure[keep])
            scatter = scatter if number == 0 else self._scatter_of(residual[keep])
            measured = self.run.responses.values[keep] / scatter
            due = self.spread is None and number == self._rounds_needed // 2 and len(free) >= SPREAD_MAPS * len(gains)
            known = None
            if rise is not None:
                law = self._as_fitted(patterns * sigma[:, None], creep, rise)
                known = self._steepness.known(law, patterns[self._patterned], len(patterns) - 1)
            patterns = self._patterns(patterns, crept[keep], gains / scatter, measured, free, due, known)
            if self._creeps:
                position = np.einsum("mfn,fn->mn", features, patterns)
                creep = self._spectra(position, creep, gains / scatter, measured, keep, free)
                crept = self._with_creep(features, creep, patterns)
            gains, residual = self.run.gains(np.einsum("mfn,fn->mn", crept, patterns), keep)
        return patterns * sigma[:, None], creep, scatter, residual

    def _law(self, patterns: Floats, creep: Floats, slope: Floats) -> tuple[HysteresisModel, Floats]:
        """The law with these weights, normalised, and the share (N,) of its hysteresis that each actuator can keep."""
        law = normalised(self._as_fitted(patterns, creep, slope), *self.run.reach)
        return law, self._steepness.share_kept(law)

    def _as_fitted(self, patterns: Floats, creep: Floats, slope: Floats) -> HysteresisModel:
        """The law with the weights `patterns` (F, N) and `creep` (J + L + 1, N)."""
        radius, orders = self.candidate.radius, self.candidate.powers
        play_weight = play_weights((self._basis @ patterns[self._patterned]).T.reshape(-1, len(radius), orders))
        play_weight[:, 0, 0] += patterns[0]
        linear = patterns[self._linear].T
        share, lag = np.maximum(creep[ELEMENTS].T, 0.0), creep[LAGGED].T
        mean = float(share.mean())
        share[:, :LAGS] += lag
        return HysteresisModel(
            radius,
            play_weight,
            slope,
            patterns[-1].copy() if slope.size else 0.0,
            min(mean / PER_ELEMENT, CREEP_RATE_MAX),  # a law at this bound will be refused
            CREEP_TIMES,
            share / mean if mean else np.zeros(0),
            lag_spectrum=-lag / mean if mean else np.zeros(0),
            creep_slope=float(creep[-1].mean()),
            fading_rate=FADING_RATE if linear.size else NONE,
            fading_weight=linear.reshape(-1, len(FADING_RATE), FADING_POWERS) if linear.size else NO_DRIVE,
        )

    def _with_creep(self, features: Floats, creep: Floats, patterns: Floats) -> Floats:
        """`features` (M, F, N) with the creep that the spectra `creep` (J + L + 1, N) add."""
        if not creep.any():
            return features
        loops = creep[ELEMENTS].copy()
        loops[:LAGS] += creep[LAGGED]
        added = self.run.crept(features, loops)
        added[:, 0] = np.einsum("mjn,jn->mn", self._signal_states, creep[ELEMENTS])
        slope = creep[-1] * np.einsum("mfn,fn->mn", added, patterns)
        return features * (1.0 + slope[:, None]) + added

    def _scatter_of(self, residual: Floats) -> Floats:
        """(D,) m, robust scatter of the responses, one value for all coefficients; outliers hardly affect it."""
        count = len(residual)
        freedom = max(count - self.run.figure.shape[1] - self._plain.shape[2], 1)
        size = MAD_TO_SIGMA * np.sqrt(count / freedom) * np.median(np.abs(residual), axis=0)
        return self.run.responses.scatter(size)

    def _patterns(
        self, begin: Floats, crept: Floats, gains: Floats, values: Floats, free: Floats, due: bool, known: Known | None
    ) -> Floats:
        """Weights (F, N): 1 for the signal itself, others from maps and prior; `due`: estimate their spread first."""
        left, features = without(values - crept[:, 0] @ gains, free), without(crept[:, 1:], free)
        if due:
            self.spread = likeliest_spread(features, left, gains, begin[1:])
        solved = weights_of(features, left, gains, alike(features.shape[2], self.spread or SPREAD), begin[1:], known)
        return np.concatenate((np.ones((1, solved.shape[1])), solved))

    def _spectra(
        self, position: Floats, creep: Floats, gains: Floats, measured: Floats, keep: Bools, free: Floats
    ) -> Floats:
        """(J + L + 1, N) weights of the creep elements, additional ones for loops, and the change of creep."""
        elements = self.run.creep_states(position)
        lags = elements[:, :LAGS] - self._signal_states[:, :LAGS]
        elements = np.concatenate((elements, lags), axis=1)
        sloped = position * np.einsum("mjn,jn->mn", elements, creep[:-1])
        elements = np.concatenate((elements, sloped[:, None]), axis=1)[keep]
        left = measured - (position[keep] + self._creep * elements[:, ELEMENTS].sum(axis=1)) @ gains
        expected = np.zeros_like(creep)
        expected[ELEMENTS] = self._creep
        root = self._creep_root
        elements = without(root.T @ elements, free)  # in units of their prior
        begin = np.asarray(np.linalg.solve(root, creep - expected), dtype=np.float64)
        return expected + root @ weights_of(elements, without(left, free), gains, self._creep_between, begin)
