"""Which single actuators a map that disagrees comes from, how probable that is, and where they stand."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from dm_calibration.calibration import Calibration
from dm_calibration.hysteresis.responses import Reduction
from dm_calibration.influence.quality import NO_RESPONSE
from dm_calibration.influence.registration import bumps
from dm_calibration.recalibration.drift import Displaced
from dm_common import Floats
from dm_common.geometry import pitch
from dm_common.optics.piston_tilt import weighted_fit
from dm_common.optics.sampling import SamplePoints
from dm_common.optics.zernike import PISTON_TILT, basis

#: Most actuators that a difference is put down to, and the share of its square that each of them must explain: the one
#: that fits noise best explains about 0.13.
DISPLACED_MAX, DISPLACED_SHARE = 3, 0.3
#: How far an actuator that stands elsewhere is from where it should be, normalised.
DISPLACED_SIGMA = 0.5
#: Smallest signal that tells a weak actuator from one that is displaced, and smallest move of one that showed no
#: response in the calibration; what is left of the move of a dead one.
TELLING_SIGNAL, DEAD_SHARE = 0.1, 0.15
#: What the data sheets of piezo mirrors say: rise of the surface over an actuator per unit signal, m, and the width of
#: the bump, standard deviation in pitches.
TYPICAL_RISE, TYPICAL_WIDTH = 4e-6, 0.9
#: Of this probability on it is named how to go on without what does not move.
SURE = 0.9


def without_response(calibration: Calibration) -> NDArray[np.bool_]:
    """(N,) which actuators showed no response in the calibration."""
    return np.isin(calibration.fit.grades, NO_RESPONSE)


def visible_gain(gain: Floats, reduction: Reduction, calibration: Calibration) -> Floats:
    """`gain` (R, N) per unit of effective signal, of actuators without a response as data sheets let expect.

    The fit has nothing but noise of those, by which no map could show that they move.
    """
    silent = without_response(calibration)
    if not silent.any() or silent.size < 2:  # no neighbour whose distance tells the width of a bump
        return gain
    radius = calibration.aperture_radius
    places = calibration.actuator_x / radius, calibration.actuator_y / radius
    coefficients, sag = typical_response(*places, calibration.fit.points)
    return np.where(silent, reduction.reduce(coefficients, sag).T, gain)


def typical_response(x: Floats, y: Floats, points: SamplePoints) -> tuple[Floats, Floats]:
    """(N, 21) coefficients and (N, P) sag, m per unit signal, of actuators at x, y (N,), in radii of the aperture.

    As the data sheet of a piezo mirror lets expect; piston and tilt of the sag are removed.
    """
    shape, size = bumps(np.asarray(x + 1j * y, dtype=np.complex128), TYPICAL_WIDTH * pitch(x, y), points)
    sag = TYPICAL_RISE * size[:, None] * shape
    return weighted_fit(sag, basis(points.x, points.y), points.weight), sag


def displaced_actuators(
    innovation: Floats, gain: Floats, factor: tuple[Floats, bool], silent: NDArray[np.bool_]
) -> dict[int, Displaced]:
    """Actuators whose displacement explains `innovation` (R,), one after the other by generalised least squares.

    Args:
        gain: (R, N) per unit of effective signal, see :func:`visible_gain`.
        factor: Cholesky factor of the expected covariance (R, R).
        silent: (N,) whose gain is not known but as data sheets let expect.
    """
    white = solve_triangular(factor[0], np.column_stack((gain, innovation)), trans="T")
    columns, whole = white[:, :-1], white[:, -1]
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
    # One without a response that moved so little is rather another shape than a bump that is not well known.
    order = [int(k) for k in np.argsort(-size) if size[k] >= TELLING_SIGNAL or not silent[found[k]]]
    displaced = {}
    for k in order:
        of_this = left + columns[:, found[k]] * amounts[k]
        probability = _probability(columns, power, of_this, silent)[found[k]]
        displaced[found[k]] = Displaced(float(amounts[k]), float(probability))
    return displaced


def _probability(columns: Floats, power: Floats, white: Floats, silent: NDArray[np.bool_]) -> Floats:
    """(N,) that each actuator alone makes the difference `white` (R,), and neither another one nor something else.

    An actuator may be anywhere in its range; something else differs everywhere, as much as `white` does, or as much as
    a `silent` actuator leaves of it, whose bump is not known. Half of the prior is the actuators', the other half that
    of something else.
    """
    size, whole = len(white), white @ white
    precision = 1.0 / DISPLACED_SIGMA**2
    left = whole - np.square(columns.T @ white) / (power + precision)
    left = np.where(silent, _of_anything(left, size), left)
    evidence = 0.5 * (whole - left) - 0.5 * np.log1p(power / precision)
    something = 0.5 * (whole - _of_anything(whole, size))
    all_of_them = np.append(evidence - np.log(evidence.size), something)
    return np.asarray(np.exp(all_of_them - np.logaddexp.reduce(all_of_them)))


def _of_anything(square: Floats, size: int) -> Floats:
    """What a difference of that `square`, white, counts for where its size is not known, in `size` values."""
    return np.where(square > size, size * (1.0 + np.log(np.maximum(square, size) / size)), square)


def displacement(
    innovation: Floats, gain: Floats, factor: tuple[Floats, bool], actuators: list[int]
) -> tuple[Floats, Floats]:
    """How far each of `actuators` stands from where it should, and its standard deviation.

    By generalised least squares; other args as those of :func:`displaced_actuators`.
    """
    white = solve_triangular(factor[0], np.column_stack((gain[:, actuators], innovation)), trans="T")
    inverse = np.linalg.pinv(white[:, :-1])
    return np.asarray(inverse @ white[:, -1]), np.sqrt(np.square(inverse).sum(axis=1))


def described(
    displaced: Mapping[int, Displaced], expected: Floats, given_up: NDArray[np.bool_], silent: NDArray[np.bool_]
) -> str:
    """What a map that disagrees shows, where actuators should stand at `expected` (N,).

    Args:
        given_up: (N,) which have been taken not to move any more.
        silent: (N,) which showed no response in the calibration.
    """
    if not displaced:
        return "bad map, or the mirror has changed"
    sure = sorted(actuator for actuator, one in displaced.items() if one.probability >= SURE)
    shown, faults = list[str](), ""
    for actuator, (more, probability) in displaced.items():
        stands = f"stands at {expected[actuator] + more:+.2f} instead of {expected[actuator]:+.2f}"
        if silent[actuator]:
            stands = "moves, which showed no response in the calibration"
        elif given_up[actuator]:
            stands += ", moves again"
        else:
            stands += (fault := _fault(expected[actuator], more))
            faults += fault if actuator in sure else ""
        shown.append(f"actuator {actuator + 1} {stands} ({probability:.0%})")
    found = ", ".join(shown)
    if given_up[sure].any():
        return f"{found}; ./dm check --forget takes it back"
    if silent[sure].any():
        return f"{found}; ./dm calibrate measures it"
    if not sure or "weakened" in faults or len(sure) + given_up.sum() >= len(expected):
        return found
    without = " ".join(f"--without {actuator + 1}" for actuator in sure)
    return f"{found}; ./dm check {without} goes on without what does not move"


def worst_elsewhere(displaced: Mapping[int, Displaced], expected: Floats, zernike: Floats) -> float:
    """Largest coefficient error of any other shape by actuators that stay where a map shows them, m.

    One that stays where it is errs by as much as it is asked to move: at the far end of the range by most.

    Args:
        displaced: as :func:`displaced_actuators` finds them; those that are not sure do not count.
        expected: (N,) effective signals where actuators should stand, within about -1 .. +1.
        zernike: (K, N) m per unit of effective signal.
    """
    furthest = np.zeros(len(expected))
    for actuator, (more, probability) in displaced.items():
        if probability >= SURE:
            furthest[actuator] = 1.0 + abs(expected[actuator] + more)
    return float((np.abs(zernike[PISTON_TILT:]) @ furthest).max())


def _fault(signal: float, more: float) -> str:
    """What an actuator does that stands `more` beyond its effective `signal`; "" = no single map tells."""
    if abs(signal) < TELLING_SIGNAL:
        return ""
    share = 1.0 + more / signal
    if abs(share) < DEAD_SHARE:
        return ", as if it were dead"
    return f", as if weakened to {share:.0%}" if DEAD_SHARE <= share < 1.0 - DEAD_SHARE else ""
