"""Identify the law of a mirror from the maps of a run, with the expected error of its predictions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dm_calibration.hysteresis.actuator_weights import weights_of
from dm_calibration.hysteresis.candidate_fit import CANDIDATES, Candidate
from dm_calibration.hysteresis.creep_uncertainty import creep_covariance
from dm_calibration.hysteresis.identify import Identification, identify
from dm_calibration.hysteresis.responses import agreeing
from dm_calibration.hysteresis.run import Run, basis_of, run_of, without
from dm_calibration.influence.maps import MapSet, StepKind
from dm_common import Bools, Floats
from dm_common.hysteresis.inverse import random_histories
from dm_common.hysteresis.model import HysteresisModel
from dm_common.limits import Limits
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS

#: Largest number of fits, each without the outliers of the one before.
OUTLIER_ROUNDS = 4
#: Creep from before the run above this effective signal (which goes to about 1) is taken for a drift of the figure.
CREPT_MAX = 1.5
#: Number of maps beyond that of the actuators (157 maps for 37) from which on held-out moves show how well laws of each
#: actuator predict requests. With fewer, the error that they show is raised in proportion: without that, 55 % of the
#: requests to one mirror of eight were inside their bounds with 53 maps beyond, 88 % to one of eight with 75. With it,
#: 98 to 100 % are, but 82 % to one of seven with 95.
MAPS_BEYOND = 120
#: Prior standard deviation of a change of the figure between two parts of a run that is not creep, m. A change of 20 nm
#: is found by 1 to 10; the more, the less is known of the creep from before a last part of few maps.
FIGURE_STEP = 1e-9
#: A test move counts as held if its map comes this much later after it than the median, s; fewest that count.
HELD_LONGER_S, HELD_MIN = 0.9, 4
#: Limitation if no map follows a degauss within the run: then the fit takes the offset of demagnetised actuators for
#: earlier creep. After a degauss, 30 moves of a simulated mirror of one actuator were off by 1.0 nm instead of 0.1.
NO_DEGAUSS = (
    "Hysteresis: no degauss within the run: requests after a degauss may be off by a constant, which the promise does "
    "not include."
)
#: Random draws for the quantile of the largest of several correlated errors.
DRAWS = 4000


@dataclass(frozen=True, eq=False)
class HysteresisFit:
    """Hysteresis and creep of one mirror.

    Attributes:
        zernike_sigma: (K,) m, standard deviation of the coefficients of a predicted move, from maps that had no part in
            the fit, with the noise of the maps subtracted; 0 for piston and tilt.
        held_out_max_zernike: m, 95th percentile of the largest of these errors; more where the maps are few, or where
            held moves have larger errors than the others.
        unknown_sigma: standard deviation of an effective signal when the history is not known.
        maps: number of maps from which the law was identified.
        remarks: sentences on how the law was chosen.
    """

    name: str
    law: HysteresisModel
    zernike_sigma: Floats
    held_out_max_zernike: float
    unknown_sigma: float
    maps: int
    remarks: tuple[str, ...]

    def signal_sigma(self, influence_zernike: Floats) -> float:
        """Standard deviation of an effective signal that explains these errors with the influence (K, N), m."""
        scale = TERM_RMS[PISTON_TILT : len(influence_zernike)]
        reach = np.square(influence_zernike[PISTON_TILT:] * scale[:, None]).sum()
        return float(np.sqrt(np.square(self.zernike_sigma[PISTON_TILT:] * scale).sum() / reach))


def fit_hysteresis(
    maps: MapSet, candidates: Sequence[Candidate] = CANDIDATES, limits: Limits | None = None
) -> HysteresisFit:
    """Identify the law from the maps of one run, in the order measured, which begins with a degauss.

    Maps of kind CHECK test the law before they join the final fit.

    Args:
        limits: of the signals between which the law must have an inverse; None = the range of the run.

    Raises:
        ExcitationError: the maps do not show hysteresis.
        TooFewMapsError: no map can be used.
        ValueError: time stamps that run backwards.
    """
    run = run_of(maps)
    if limits is not None:
        run = replace(run, limits=(limits.low, limits.high))
    test = np.array([kind == StepKind.CHECK for kind in maps.kind])
    found, run = _without_outliers(run, test, candidates)
    covariance = _error_covariance(found, run.responses.coefficients, maps)
    sigma = np.concatenate((np.zeros(PISTON_TILT), np.sqrt(np.diag(covariance))))
    law = _followed(maps, found.fit.law, run)[1]
    if law.creep_rate:
        law = replace(law, creep_covariance=creep_covariance(run, law, found.held_out))
    remarks = [*_remarks(found), *_left_out(maps, run), *_drifted(law)]
    if not maps.degaussed.any():
        remarks.append(NO_DEGAUSS)
    return HysteresisFit(
        name=found.fit.candidate.name,
        law=law,
        zernike_sigma=sigma,
        held_out_max_zernike=_largest_of(covariance) * _few_maps(found, run) * _held(found, maps),
        unknown_sigma=unknown_history_sigma(found.fit.law, *run.reach),
        maps=int(run.responses.usable.sum()),
        remarks=tuple(remarks),
    )


def _without_outliers(run: Run, test: Bools, candidates: Sequence[Candidate]) -> tuple[Identification, Run]:
    """Identify the law without outliers; in the returned run these maps are not usable, but their commands stay."""
    for _ in range(OUTLIER_ROUNDS - 1):
        found = identify(run, test, candidates)
        # Separately: most fits have not seen the test maps, so these have larger residuals than the others.
        usable, good = run.responses.usable, np.zeros_like(test)
        for kind in (usable & ~test, usable & test):
            if kind.any():
                good |= agreeing(kind, found.closest)
        if good.sum() == usable.sum():
            return found, run
        run = replace(run, responses=replace(run.responses, usable=good))
    return identify(run, test, candidates), run


def _few_maps(found: Identification, run: Run) -> float:
    """Factor on the error of held-out moves if the maps are few for laws of each actuator, at least 1."""
    own = found.fit.candidate.own and found.fit.candidate.hysteretic
    return few_maps(int(run.responses.usable.sum()), run.signals.shape[1] if own else 0)


def few_maps(maps: int, own: int) -> float:
    """Factor on the error of held-out moves if `maps` are few for laws of `own` actuators (0 = one law for all)."""
    return max(1.0, MAPS_BEYOND / max(maps - own, 1)) if own else 1.0


def _held(found: Identification, maps: MapSet) -> float:
    """Factor by which the error of held test moves exceeds that of the others, at least 1.

    Most requests are held for longer than a test move. Creep that the law does not describe, as of thermally activated
    domain walls, shows in the held moves only.
    """
    error = np.square(found.held_out[:, : maps.terms - PISTON_TILT]).sum(axis=1)
    seen, age = np.isfinite(error), 1e-9 * (maps.stamp_ns - maps.stamp_ns[0]) - maps.moved_s()
    held = seen & (age > np.median(age[seen]) + HELD_LONGER_S)
    if held.sum() < HELD_MIN:
        return 1.0
    return max(1.0, float(np.sqrt(error[held].mean() / error[seen & ~held].mean())))


def _left_out(maps: MapSet, run: Run) -> tuple[str, ...]:
    labels = [label for label, usable in zip(maps.label, run.responses.usable, strict=True) if not usable]
    if not labels:
        return ()
    more = f" and {len(labels) - 5} more" if len(labels) > 5 else ""
    return (
        f"Hysteresis: {len(labels)} of {len(maps)} commands left out, whose map is missing or contradicts the model: "
        f"{', '.join(labels[:5])}{more}.",
    )


def _drifted(law: HysteresisModel) -> tuple[str, ...]:
    """A sentence if the maps show more creep from before the run than signals within the range can have left."""
    most = float(np.abs(law.crept).max(initial=0.0))
    if most < CREPT_MAX:
        return ()
    return (
        f"Hysteresis: the figure drifted more than earlier creep can explain (it would take signals of {most:.1f}, "
        "the range ends at 1): the promise does not include such drift, the bounds of requests do.",
    )


def effective_maps(maps: MapSet, law: HysteresisModel) -> MapSet:
    """`maps` of one run with effective signals in place of the applied ones.

    Raises:
        ValueError: time stamps that run backwards.
    """
    return _followed(maps, law, run_of(maps))[0]


def _followed(maps: MapSet, law: HysteresisModel, run: Run) -> tuple[MapSet, HysteresisModel]:
    """Maps with effective signals, and the law with the creep that the actuators had before the last part of their run.

    Args:
        run: of these maps; those that contradict a law may be marked as not usable.
    """
    effective = run.follow(law)
    if not law.creep_rate:
        return replace(maps, applied=effective), law
    # Share of an old displacement of each actuator that is still left, by the time since it ended.
    fading = np.zeros((len(maps), len(run.parts), maps.actuators))
    for number, (rows, start) in enumerate(run.parts):
        elapsed = run.time[rows, None] - start
        fading[rows, number] = np.exp(-elapsed / law.creep_time) @ np.atleast_2d(law.creep_share).T
    crept = _crept_before(run, effective, fading)
    began = 1e-9 * int(maps.stamp_ns[0]) + run.parts[-1][1]
    effective = effective + np.einsum("msn,sn->mn", fading, crept)
    rest = law.demagnetised(maps.actuators, began, run.rest).position
    return replace(maps, applied=effective), replace(law, crept_at=began, crept=rest + crept[-1])


def _crept_before(run: Run, effective: Floats, fading: Floats) -> Floats:
    """(S, N) effective signals to which the mirror had crept before each degauss, from the fading part of the figure.

    Without this the fading part counts as figure, which then holds only at the time of the run. The prior standard
    deviation is 1, the size of all effective signals; that suppresses patterns which the maps hardly show. Between two
    parts the figure may also change for good, by about FIGURE_STEP. Maps that contradict the effective signals are left
    out.

    Args:
        effective: (M, N).
        fading: (M, S, N) share of that creep that is left in each map.
    """
    good, count, values = run.responses.usable, run.responses.coefficients, run.responses.values
    steps = run.figure[:, 3::2]  # of each part after the first
    whole = np.column_stack((np.ones(len(effective)), effective, fading.mean(axis=2), steps))
    for _ in range(OUTLIER_ROUNDS):
        used = good
        solution = np.linalg.lstsq(whole[used], values[used], rcond=1e-10)[0]
        residual = values - whole @ solution
        good = agreeing(used, residual)
        if good.sum() == used.sum():
            break
    freedom = max(used.sum() - whole.shape[1], 1)
    scatter = np.sqrt(np.square(residual[used]).sum(axis=0) / freedom)
    scatter[:count] = np.sqrt(np.mean(np.square(scatter[:count])))
    known = slice(1 + effective.shape[1])
    gains = solution[known][1:] / scatter
    shown, number = steps[used], np.maximum(steps[used].sum(axis=0), 1.0)
    kept = 1.0 / np.sqrt(1.0 + number * (FIGURE_STEP / scatter[0]) ** 2)

    def independent(rows: Floats) -> Floats:
        """A step of unknown size makes the errors of all maps of its part correlated; here they no longer are."""
        means = np.tensordot(shown.T, rows, 1)
        return np.asarray(rows - np.tensordot(shown * (1.0 - kept) / number, means, 1))

    free = basis_of(independent(whole[used, known]))
    unknown = without(independent(fading[used]), free)
    left = without(independent(values[used] / scatter), free)
    return weights_of(unknown, left, gains, (1.0, 0.0), np.zeros(fading.shape[1:]))


def unknown_history_sigma(law: HysteresisModel, low: float, high: float) -> float:
    """Standard deviation of the static effective signal at one signal over random histories from `low` to `high`."""
    rng = np.random.default_rng(0)
    still = replace(law, creep_rate=0.0)
    differences = []
    for one, other in zip(*(random_histories(still, low, high, rng, 500) for _ in range(2)), strict=True):
        signals = rng.uniform(low, high, len(one.signals))
        differences.append(still.position_at(one, signals) - still.position_at(other, signals))
    return float(np.std(differences) / np.sqrt(2.0))


def _error_covariance(found: Identification, count: int, maps: MapSet) -> Floats:
    """(K - 3, K - 3) m^2, error covariance of the `count` coefficients of predicted moves, less the noise of maps."""
    rows = found.held_out[:, :count] / TERM_RMS[PISTON_TILT : maps.terms]
    rows = rows[np.isfinite(rows).all(axis=1)]
    size, axes = np.linalg.eigh(rows.T @ rows / len(rows) - np.diag(maps.noise_variance()))
    return np.asarray((axes * np.maximum(size, 0.0)) @ axes.T)


def _largest_of(covariance: Floats) -> float:
    """95 % quantile of the largest of D errors with `covariance` (D, D), in their unit."""
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(len(covariance)), covariance, DRAWS, method="svd")
    return float(np.quantile(np.abs(draws).max(axis=1), 0.95))


def _remarks(found: Identification) -> tuple[str, ...]:
    best = found.fit.candidate.name
    others = ", ".join(f"{name} {score:.2f}" for name, score in found.scores.items() if name != best)
    compared = f"; error of other models relative to it: {others}" if others else ""
    sentences = [f"Hysteresis: {best} predicts the held-out maps best{compared}."]
    tried = any(one.own and one.hysteretic and one.name in found.scores for one in CANDIDATES)
    if tried and not found.fit.candidate.own:
        sentences.append("Hysteresis: the maps show no differences between the actuators' loops; all share one law.")
    sentences += [f"Hysteresis: {name} was rejected: {reason}." for name, reason in found.refused.items()]
    sentences += filter(None, (found.quiet_remark, found.changed_remark))
    return tuple(sentences)
