"""Search for single actuators that explain a disagreeing map, with their positions and probabilities."""

from collections.abc import Mapping

import numpy as np
from scipy.linalg import solve_triangular

from dm_calibration.calibration import Calibration
from dm_calibration.hysteresis.responses import Reduction
from dm_calibration.influence.bumps import Bump, bumps
from dm_calibration.influence.quality import NO_RESPONSE
from dm_calibration.procedure.applied_history import MapNotUsableError
from dm_calibration.recalibration.drift import DEAD_SHARE, DISTINCT_SIGNAL, FAILED_SIGNAL, NOTICED, Displaced, Drift
from dm_common import Bools, Floats
from dm_common.geometry import pitch
from dm_common.optics.piston_tilt import weighted_fit
from dm_common.optics.zernike import PISTON_TILT, basis

#: Most actuators to which a difference is attributed, and the least share of its sum of squares that each must explain:
#: the actuator that fits pure noise best explains about 0.13.
DISPLACED_MAX, DISPLACED_SHARE = 3, 0.3
#: Prior standard deviation of the displacement of a faulty actuator, in effective signal.
DISPLACED_SIGMA = 0.5
#: The same of a change of one coefficient, as by another focus of the interferometer, m rms.
TERM_SIGMA = 1e-7
#: An actuator counts as failed beyond this many standard deviations from where it should stand.
DISPLACED_SIGMAS = 4.0
#: No actuator stands at an effective signal beyond this.
FURTHEST = 1.5
#: From data sheets of piezo mirrors: rise of the surface over an actuator per unit signal, m, and width of the bump
#: (standard deviation, in pitches).
TYPICAL_RISE, TYPICAL_WIDTH = 4e-6, 0.9
#: Least probability of a fault for which the message says how to go on without the actuator.
SURE = 0.9


def without_response(calibration: Calibration) -> Bools:
    """(N,) which actuators showed no response in the calibration."""
    return np.isin(calibration.fit.grades, NO_RESPONSE)


def visible_gain(gain: Floats, reduction: Reduction, calibration: Calibration) -> Floats:
    """`gain` (R, N) per unit of effective signal, with that of a typical piezo mirror for actuators without a response.

    For these the fit contains only noise, so no map could show that they move.
    """
    silent = without_response(calibration)
    if not silent.any() or silent.size < 2:  # no neighbour whose distance gives the width of a bump
        return gain
    radius, points = calibration.aperture_radius, calibration.fit.points
    x, y = calibration.actuator_x / radius, calibration.actuator_y / radius
    shape, size = bumps(np.asarray(x + 1j * y, dtype=np.complex128), Bump(TYPICAL_WIDTH * pitch(x, y)), points)
    sag = TYPICAL_RISE * size[:, None] * shape
    coefficients = weighted_fit(sag, basis(points.x, points.y), points.weight)
    return np.where(silent, reduction.reduce(coefficients, sag).T, gain)


def displaced_actuators(
    innovation: Floats, gain: Floats, factor: tuple[Floats, bool], silent: Bools, coefficients: int
) -> dict[int, Displaced]:
    """Actuators whose displacement explains `innovation` (R,), found one by one by generalised least squares.

    Args:
        gain: (R, N) per unit of effective signal, see :func:`visible_gain`.
        factor: Cholesky factor of the expected covariance (R, R).
        silent: (N,) actuators without a measured gain, for which the typical gain is used.
        coefficients: how many of the values are Zernike coefficients; the first ones.
    """
    values = np.column_stack((gain, innovation, np.eye(len(innovation))[:, :coefficients]))
    white = solve_triangular(factor[0], values, trans="T")
    columns, whole, terms = np.split(white, [gain.shape[1], gain.shape[1] + 1], axis=1)
    whole = whole[:, 0]
    power = np.maximum(np.square(columns).sum(axis=0), np.finfo(np.float64).tiny)
    left, found, amounts = whole, list[int](), np.zeros(0)
    while len(found) < DISPLACED_MAX and left @ left > len(left):
        explained = np.square(columns.T @ left) / power
        best = int(explained.argmax())
        if explained[best] < DISPLACED_SHARE * (left @ left):
            break
        found.append(best)
        amounts = np.linalg.lstsq(columns[:, found], whole, rcond=None)[0]
        left = whole - columns[:, found] @ amounts
    size = np.abs(amounts)
    # Small moves of actuators without a response, whose bumps are not well known, are more likely other errors.
    order = [int(k) for k in np.argsort(-size) if size[k] >= DISTINCT_SIGNAL or not silent[found[k]]]
    displaced = {}
    for k in order:
        of_this = left + columns[:, found[k]] * amounts[k]
        probability = _probability(columns, power, of_this, silent, terms)[found[k]]
        displaced[found[k]] = Displaced(float(amounts[k]), float(probability))
    return displaced


def _probability(columns: Floats, power: Floats, white: Floats, silent: Bools, terms: Floats) -> Floats:
    """(N,) probability that each actuator alone causes the difference `white` (R,), against any other cause.

    An actuator may be anywhere in its range. A cause other than an actuator changes one coefficient, by its column of
    `terms` (R, K - 3), or all values, by an unknown amount estimated from `white`; for a `silent` actuator, whose bump
    is not known, the same holds for its residual. The prior is one half for all actuators together, and one half for
    other causes.
    """
    size, whole = len(white), white @ white
    precision = 1.0 / DISPLACED_SIGMA**2
    left = whole - np.square(columns.T @ white) / (power + precision)
    left = np.where(silent, _deviance(left, size), left)
    evidence = 0.5 * (whole - left) - 0.5 * np.log1p(power / precision)
    other_cause = 0.5 * (whole - _deviance(whole, size))
    strength, of_term = np.square(terms).sum(axis=0), 1.0 / TERM_SIGMA**2
    one_term = 0.5 * np.square(terms.T @ white) / (strength + of_term) - 0.5 * np.log1p(strength / of_term)
    others = np.append(other_cause - np.log(2.0), one_term - np.log(2.0 * max(one_term.size, 1)))
    all_of_them = np.concatenate((evidence - np.log(evidence.size), others))
    return np.asarray(np.exp(all_of_them - np.logaddexp.reduce(all_of_them)))


def _deviance(square: Floats, size: int) -> Floats:
    """-2 log likelihood of a white difference in `size` values with that sum of squares and unknown variance (>= 1)."""
    return np.where(square > size, size * (1.0 + np.log(np.maximum(square, size) / size)), square)


def given_up_at(
    innovation: Floats, gain: Floats, factor: tuple[Floats, bool], actuators: list[int], expected: Floats, moving: Bools
) -> Floats:
    """Where a map shows each of `actuators`, in effective signal, by generalised least squares.

    Args:
        innovation, gain, factor: as of :func:`displaced_actuators`.
        expected: (N,) where actuators should stand.
        moving: (N,) which were not given up before.

    Raises:
        MapNotUsableError: an actuator stands where it should, within the error of the map, or where none can.
    """
    white = solve_triangular(factor[0], np.column_stack((gain[:, actuators], innovation)), trans="T")
    inverse = np.linalg.pinv(white[:, :-1])
    away, sigma = inverse @ white[:, -1], np.sqrt(np.square(inverse).sum(axis=1))
    for actuator, more, error in zip(actuators, away, sigma, strict=True):
        place = f"actuator {actuator + 1} stands at {expected[actuator] + more:+.2f} +- {error:.2f}"
        if moving[actuator] and abs(more) <= DISPLACED_SIGMAS * error:
            raise MapNotUsableError(
                f"{place}, expected at {expected[actuator]:+.2f}: this shape does not show that it fails; ask for "
                "another first"
            )
        if abs(expected[actuator] + more) > FURTHEST:
            raise MapNotUsableError(f"{place}, none beyond {FURTHEST:g}: the map shows another fault")
    return np.asarray(expected[actuators] + away)


def described(displaced: Mapping[int, Displaced], expected: Floats, given_up: Bools, silent: Bools) -> str:
    """Describe what a disagreeing map shows, if actuators should stand at `expected` (N,).

    Args:
        given_up: (N,) actuators that are already known not to move any more.
        silent: (N,) which showed no response in the calibration.
    """
    displaced = {k: one for k, one in displaced.items() if abs(expected[k] + one.more) <= FURTHEST}
    if not displaced:
        return "bad map, or the mirror has changed"
    sure = sorted(actuator for actuator, one in displaced.items() if one.probability >= SURE)
    shown, faults = list[str](), ""
    for actuator, (more, probability) in displaced.items():
        finding = f"stands at {expected[actuator] + more:+.2f} instead of {expected[actuator]:+.2f}"
        if silent[actuator]:
            finding = "moves, but showed no response in the calibration"
        elif given_up[actuator]:
            finding += ", moves again"
        else:
            finding += (fault := _fault(expected[actuator], more))
            faults += fault if actuator in sure else ""
        shown.append(f"actuator {actuator + 1} {finding} ({probability:.0%})")
    found = ", ".join(shown)
    if given_up[sure].any():
        return f"{found}; ./dm check --forget uses it again"
    if silent[sure].any():
        return f"{found}; ./dm calibrate measures it"
    if not sure or not all(failed(displaced[k]) for k in sure) or len(sure) + given_up.sum() >= len(expected):
        return found
    without = " ".join(f"--without {actuator + 1}" for actuator in sure)
    condition = "if it is at the same place in another shape, " if "weakened" in faults else ""
    return f"{found}; {condition}./dm check {without} continues without what does not move"


def worst_other_error(displaced: Mapping[int, Displaced], expected: Floats, zernike: Floats) -> float:
    """Largest coefficient error (m) over all other shapes if actuators stay where a map shows them.

    The error of a stuck actuator is the move that it should make, which is largest to the far end of the range.

    Args:
        displaced: as found by :func:`displaced_actuators`; only failed actuators count.
        expected: (N,) effective signals at which actuators should stand, within about -1 .. +1.
        zernike: (K, N) m per unit of effective signal.
    """
    furthest = np.zeros(len(expected))
    for actuator, one in displaced.items():
        if failed(one):
            furthest[actuator] = 1.0 + abs(expected[actuator] + one.more)
    return float((np.abs(zernike[PISTON_TILT:]) @ furthest).max())


def noticed_error(displaced: Mapping[int, Displaced], zernike: Floats) -> float:
    """Coefficient error (m) by actuators that are noticed, which are likely to err as much in other shapes.

    Args as of :func:`worst_other_error`.
    """
    away = np.zeros(zernike.shape[1])
    for actuator, one in displaced.items():
        if noticed(one):
            away[actuator] = abs(one.more)
    return float((np.abs(zernike[PISTON_TILT:]) @ away).max())


def failing_from(displaced: Mapping[int, Displaced], expected: Floats, drift: Drift, shown: Bools) -> Floats:
    """`failing` of :class:`Drift` after a map.

    A weakened actuator misses the same share of every move, so near 0 it stands where it should; a stuck one stands
    where it should in the shape in which it got stuck, and surely not beyond its place.

    Args:
        displaced, expected: as of :func:`worst_other_error`; only failed actuators count.
        drift: before the map.
        shown: (N,) whether the map would have shown it of each, see :func:`shown_at`.
    """
    failing = np.where(shown, np.nan, drift.failing)
    for actuator, one in displaced.items():
        if failed(one) and np.isnan(drift.stuck[actuator]):
            wanted, stuck = expected[actuator], min(abs(expected[actuator] + one.more) + FAILED_SIGNAL, 1.0)
            weakened = wanted != 0.0 and DEAD_SHARE <= 1.0 + one.more / wanted < 1.0
            failing[actuator] = FAILED_SIGNAL * abs(wanted / one.more) if weakened else stuck
    return failing


def shown_at(effective: Floats, drift: Drift) -> Bools:
    """(N,) whether a map at the signals `effective` (N,) would show that actuators still fail, see :class:`Drift`."""
    moves = np.isnan(drift.stuck)
    share = np.maximum(np.abs(drift.stuck / drift.failing), DEAD_SHARE)  # of less, few maps would show anything
    away = np.where(moves, effective, (effective - drift.failing) * share)
    return np.abs(away) >= np.where(moves, drift.failing, FAILED_SIGNAL)


def noticed(one: Displaced) -> bool:
    """Whether an actuator is surely somewhere else, if only so little that the map agrees."""
    return one.probability >= SURE and abs(one.more) >= NOTICED


def failed(one: Displaced) -> bool:
    """Whether an actuator is surely, and far enough, from where it should stand to have failed."""
    return one.probability >= SURE and abs(one.more) >= FAILED_SIGNAL


def _fault(signal: float, more: float) -> str:
    """The fault of an actuator that stands `more` beyond its effective `signal`; "" = one map cannot show it."""
    if abs(signal) < DISTINCT_SIGNAL:
        return ""
    share = 1.0 + more / signal
    if abs(share) < DEAD_SHARE:
        return ", as if it were dead"
    return f", as if weakened to {share:.0%}" if DEAD_SHARE <= share < 1.0 - NOTICED else ""
