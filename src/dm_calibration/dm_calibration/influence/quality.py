"""Quality of an influence function: held-out error, condition number, a grade per actuator, and limitations."""

import numpy as np
from numpy.typing import NDArray

from dm_calibration.influence.maps import MapSet, StepKind
from dm_calibration.influence.regression import Design, seen_alike
from dm_calibration.influence.screening import FitOptions
from dm_common import Bools, Floats, Ints
from dm_common.figures import counted
from dm_common.limits import Limits
from dm_common.mirror import actuators_text
from dm_common.optics.piston_tilt import rms
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS

#: Variance of a held-out prediction, relative to that of one measurement, above which it counts as extrapolation.
EXTRAPOLATION_MAX = 10.0
#: An actuator is dead if its response is up to this share of the median response of all excited actuators.
DEAD_SHARE = 0.02
#: An actuator beside the aperture moves few points of it, which count little in the rms sag. So it is not dead if one
#: point moves by this many times as many standard errors of its own as its rms response would need.
PEAK_RATIO = 2.0

#: An actuator is uncertain if its relative error exceeds this many times the median: an error that all share, such as
#: that of hysteresis in pokes, is no sign of a bad actuator.
UNCERTAIN_RATIO = 2.0

#: Maps show hysteresis that no law describes if their error is at least this share of their moves; less may be noise.
LOOPS_SHOW = 0.01
#: Least size of a move as a divisor, m: maps at mid range have no move.
NO_MOVE = 1e-15
#: Singular values up to this share of the largest count as noise, such as that of a dead actuator.
LEAST_AUTHORITY = 0.01
#: Factor from pokes to requested moves: these go up to twice as far, and loops widen with the distance, ...
LOOPS_WIDEN = 2.0
#: ... but to at most this many times the allowance of a single actuator: all actuators err in the same direction.
LOOPS_WIDEST = 1.5

# Values of dm_msgs/Calibration.actuator_grade.
GRADE_GOOD = 0
GRADE_WEAK = 1
GRADE_DEAD = 2
GRADE_NOT_EXCITED = 3
GRADE_NAMES = ("good", "weak", "dead", "not excited")
#: Grades of actuators whose response is not known.
NO_RESPONSE = (GRADE_DEAD, GRADE_NOT_EXCITED)


def grade(
    response: Floats, peak: Floats, standard_error: Floats, excited: Bools, rings: Ints | None, options: FitOptions
) -> NDArray[np.uint8]:
    """Grade of each actuator from its response (N,) and standard error (N,), m per unit signal, and its peak (N,).

    A response is the weighted rms sag of a unit signal, piston and tilt removed; a peak is the largest sag of a point,
    in standard errors of that point.
    """
    uncertainty, typical = _uncertainty(response, standard_error, excited)
    uncertain = (uncertainty > UNCERTAIN_RATIO * typical) & (response < options.weak_sigmas * standard_error)
    rings = np.zeros(response.size, dtype=np.int64) if rings is None else rings
    overall = np.median(response[excited])
    ring_median = np.array(
        [np.median(response[excited & (rings == ring)]) if e else 0.0 for ring, e in zip(rings, excited, strict=True)]
    )
    noise = (response < options.dead_sigmas * standard_error) & (peak < PEAK_RATIO * options.dead_sigmas)
    dead = noise | (response <= DEAD_SHARE * overall)
    weak = uncertain | (response < options.weak_share * ring_median)
    grades = np.where(dead, GRADE_DEAD, np.where(weak, GRADE_WEAK, GRADE_GOOD))
    return np.where(excited, grades, GRADE_NOT_EXCITED).astype(np.uint8)


def _uncertainty(response: Floats, standard_error: Floats, excited: Bools) -> tuple[Floats, float]:
    """Standard errors (N,) as shares of the responses (N,), and their median over the actuators that were moved."""
    share = np.divide(standard_error, response, out=np.full(response.size, np.inf), where=response > 0.0)
    return share, float(np.median(share[excited]))


def blur(response: Floats, standard_error: Floats, excited: Bools, weak_sigmas: float) -> list[str]:
    """Sentences on responses (N,) that are all uncertain; empty if they are not."""
    _, typical = _uncertainty(response, standard_error, excited)
    if typical * weak_sigmas < 1.0 or not np.isfinite(typical):
        return []  # or nothing responds at all
    return [
        f"Responses are known to {typical:.0%} only (one standard error, median of the actuators): hysteresis, which "
        "a hysteresis plan can separate, or noise blurs them all."
    ]


def folds_of(step: Ints, held: Bools, folds: int) -> Ints:
    """(M,) fold of each map `held` (M,); -1 = it stays in every fit.

    Commanded states `step` (M,) are dealt out to the folds in order, so that repeated maps of a state stay together and
    the two directions of a push-pull poke lie in different folds. Reference frames should stay in every fit: otherwise
    the drifting figure would be extrapolated, by which the influence function is not judged.
    """
    fold = np.full(step.size, -1)
    fold[held] = np.unique(step[held], return_inverse=True)[1] % folds
    return fold


def held_out_residual(design: Design, responses: Floats, fold: Ints) -> tuple[Floats, Bools]:
    """Residual of each map predicted from a fit that has not seen it, by k-fold cross-validation.

    Args:
        design: (M, p).
        responses: (M, Q).
        fold: (M,) as from :func:`folds_of`.

    Returns:
        The residual (M, Q), and which maps (M,) were tested: those whose prediction is not an extrapolation, see
        EXTRAPOLATION_MAX. Otherwise the fit without their fold knows too little about the actuators that they move.
    """
    residual = np.full(responses.shape, np.nan)
    inflation = np.full(fold.size, np.inf)
    for k in range(int(fold.max(initial=-1)) + 1):
        left_out = fold == k
        # Where a fold holds the only map that separates two actuators, this is the minimum-norm solution.
        inverse = np.linalg.pinv(design.matrix[~left_out], rcond=1e-9)
        residual[left_out] = responses[left_out] - design.matrix[left_out] @ (inverse @ responses[~left_out])
        inflation[left_out] = np.square(design.matrix[left_out] @ inverse).sum(axis=1)
        known = inverse @ design.matrix[~left_out]
        beyond = np.abs(design.matrix[left_out] - design.matrix[left_out] @ known).max(axis=1, initial=0.0) > 1e-6
        inflation[left_out] = np.where(beyond, np.inf, inflation[left_out])
    return residual, inflation <= EXTRAPOLATION_MAX


def loop_share(left: Floats, moved: Floats, weight: Floats, tested: Bools, allowance: float) -> float:
    """Error by hysteresis that no law describes, as a share of a move over the range.

    A poke shows only the loop of its own actuator, so the residuals of held-out pokes are smaller than the joint error
    of all actuators. Each map counts with its residual along its own move, relative to the largest move so far, which
    may have left a remanence.

    Args:
        left, moved: (M, P) m, sag of the held-out residuals, and sag by the signals relative to mid range.
        tested: (M,) which maps count.
        allowance: error of an actuator as a share of its move.
    """
    size = np.maximum(rms(moved, weight), NO_MOVE)
    tested = tested & (size > DEAD_SHARE * size.max())  # pokes of a dead actuator show noise
    along = np.abs((left[tested] * moved[tested]) @ weight) / (size * np.maximum.accumulate(size))[tested]
    shown = float(np.percentile(along, 95.0)) if tested.any() else 0.0
    return min(LOOPS_WIDEN * shown, LOOPS_WIDEST * allowance) if shown > LOOPS_SHOW else 0.0


def with_loops(error: float, share: float, influence_zernike: Floats, limits: Limits) -> tuple[float, list[str]]:
    """`error` (m) plus `share` of the defocus of the largest sphere inside `limits`, and a sentence on that.

    Args:
        influence_zernike: (K, N).
    """
    inverse = np.linalg.pinv(influence_zernike[PISTON_TILT:], rcond=LEAST_AUTHORITY)
    signals: Floats = np.asarray(inverse[:, 0], np.float64)  # a unit of defocus
    used = np.abs(signals).max() / limits.half_range
    apart = limits.differences(signals).max(initial=0.0) / limits.neighbour_difference
    if not (share and used):
        return error, []
    beyond = float(share / max(used, apart))
    return error + beyond, [
        f"The maps show hysteresis, which no law describes: the error includes {share:.1%} of a move over the whole "
        f"range ({beyond * 1e9:.0f} nm) in addition to the {error * 1e9:.0f} nm of held-out maps."
    ]


def seen_rms(residual: Floats, sag: Floats, weight: Floats) -> Floats:
    """(M,) m, rms of the residuals (M, P) over the points at which each map `sag` (M, P) has data.

    Points that were filled from the fit show nothing of its error.
    """
    seen = np.isfinite(sag)
    return np.asarray(np.sqrt((np.square(residual) * seen) @ weight / (seen @ weight)))


def condition_number(influence_zernike: Floats, tilt_known: bool) -> float:
    """Ratio of the largest to the smallest singular value of G without piston, and without tilt unless it is known.

    In rms-normalised modes, as in the tables of mirror makers: a unit of each mode is then the same rms sag. With N
    actuators only N modes are independent, so if N < K - 1, the N largest singular values count.
    """
    first = 1 if tilt_known else 3
    rms = np.asarray(TERM_RMS)[first : len(influence_zernike), np.newaxis]
    return float(np.linalg.cond(influence_zernike[first:] * rms))


def limitations(good: MapSet, design: Design, grades: NDArray[np.uint8], tilt_known: bool, tested: Bools) -> list[str]:
    """Limitations of an influence function fitted to the maps `good`, as sentences for its user.

    Args:
        grades: (N,) GRADE_*.
        tested: (M,) maps that the cross-validation could judge.
    """
    if StepKind.EXCITATION in good.kind:
        sentences = ["The influence function acts on effective signals, from the model of hysteresis and creep."]
    else:
        sentences = ["The model is linear: its error includes hysteresis and creep."]
    if not tilt_known:
        sentences.append(
            "The maps do not show the mirror's tilt (the interferometer's own is larger); "
            "the condition number leaves tilt out."
        )
    if design.drift == 1:
        sentences.append(
            "The figure is taken as constant over the run: too few reference frames, or too few other maps, to follow "
            "its drift."
        )
    for value, text in (
        (GRADE_WEAK, "responds/respond weakly or uncertainly"),
        (GRADE_DEAD, "shows/show no response above the noise"),
        (GRADE_NOT_EXCITED, "was/were never moved and counted as without effect"),
    ):
        if finding := actuators_text(np.flatnonzero(grades == value) + 1, text):
            sentences.append(f"{finding.capitalize()}.")
    if not tested.any():
        sentences.append(
            "Every map moves an actuator as no other map does: the held-out error comes from extrapolation and says "
            "little about the influence function; poke each actuator both ways, or add surfaces."
        )
    elif untested := int((~tested & ~good.reference).sum()):
        sentences.append(
            f"{counted(untested, 'map moves', 'maps move')} an actuator as no other map does; a prediction from the "
            "others would be extrapolation and does not count in the held-out error."
        )
    blind = sum(len(one.points) for one in seen_alike(design, np.isfinite(good.sag)) if one.inverse is None)
    if blind:
        sentences.append(
            f"{blind} of the {good.points.x.size} sampling points have no data in any map, or in too few to "
            "determine the influence function there."
        )
    return sentences
