"""Which single actuators a map that disagrees comes from, how probable that is, and where they stand."""

from collections.abc import Mapping

import numpy as np
from scipy.linalg import solve_triangular

from dm_common import Floats
from dm_common.optics.zernike import PISTON_TILT

#: Most actuators that a difference is put down to, and the share of its square that each of them must explain: the one
#: that fits noise best explains about 0.13.
DISPLACED_MAX, DISPLACED_SHARE = 3, 0.3
#: How far an actuator that stands elsewhere is from where it should be, normalised.
DISPLACED_SIGMA = 0.5
#: Smallest signal that tells a weak actuator from one that is displaced, and what is left of the move of a dead one.
TELLING_SIGNAL, DEAD_SHARE = 0.1, 0.15
#: Of this probability on it is named how to go on without what does not move.
SURE = 0.9


def displaced_actuators(
    innovation: Floats, gain: Floats, factor: tuple[Floats, bool]
) -> tuple[dict[int, float], dict[int, float]]:
    """Actuators whose displacement explains `innovation` (R,), one after the other by generalised least squares; and
    the probability of each.

    Args:
        gain: (R, N) per unit of effective signal.
        factor: Cholesky factor of the expected covariance (R, R).
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
    order = [int(k) for k in np.argsort(-np.abs(amounts))]
    probability = {}
    for k in order:
        of_this = left + columns[:, found[k]] * amounts[k]
        probability[found[k]] = _probability(columns, power, of_this, found[k])
    return {found[k]: float(amounts[k]) for k in order}, probability


def _probability(columns: Floats, power: Floats, white: Floats, actuator: int) -> float:
    """That `actuator` alone makes the difference `white` (R,), and neither another one nor something else.

    An actuator may be anywhere in its range; something else differs everywhere, as much as `white` does. Half of the
    prior is the actuators', the other half that of something else.
    """
    size, whole = len(white), float(white @ white)
    precision = 1.0 / DISPLACED_SIGMA**2
    evidence = 0.5 * np.square(columns.T @ white) / (power + precision) - 0.5 * np.log1p(power / precision)
    something = 0.5 * (whole - size) - 0.5 * size * np.log(whole / size) if whole > size else 0.0
    all_of_them = np.append(evidence - np.log(evidence.size), something)
    return float(np.exp(all_of_them[actuator] - np.logaddexp.reduce(all_of_them)))


def displacement(
    innovation: Floats, gain: Floats, factor: tuple[Floats, bool], actuators: list[int]
) -> tuple[Floats, Floats]:
    """How far each of `actuators` stands from where it should, and its standard deviation.

    By generalised least squares; other args as those of :func:`displaced_actuators`.
    """
    white = solve_triangular(factor[0], np.column_stack((gain[:, actuators], innovation)), trans="T")
    inverse = np.linalg.pinv(white[:, :-1])
    return np.asarray(inverse @ white[:, -1]), np.sqrt(np.square(inverse).sum(axis=1))


def described(displaced: Mapping[int, float], probability: Mapping[int, float], expected: Floats) -> str:
    """What a map that disagrees shows, where actuators should stand at `expected` (N,)."""
    if not displaced:
        return "bad map, or the mirror has changed"
    faults = {actuator: _fault(expected[actuator], more) for actuator, more in displaced.items()}
    found = ", ".join(
        f"actuator {actuator + 1} stands at {expected[actuator] + more:+.2f} instead of {expected[actuator]:+.2f}"
        f"{faults[actuator]} ({probability[actuator]:.0%})"
        for actuator, more in displaced.items()
    )
    if any("weakened" in faults[actuator] or probability[actuator] < SURE for actuator in displaced):
        return found
    without = " ".join(f"--without {actuator + 1}" for actuator in sorted(displaced))
    return f"{found}; ./dm check {without} goes on without what does not move"


def worst_elsewhere(
    displaced: Mapping[int, float], probability: Mapping[int, float], expected: Floats, zernike: Floats
) -> float:
    """Largest coefficient error of any other shape by actuators that stay where a map shows them, m.

    One that stays where it is errs by as much as it is asked to move: at the far end of the range by most.

    Args:
        displaced, probability: as :func:`displaced_actuators` finds them; those that are not sure do not count.
        expected: (N,) effective signals where actuators should stand, within about -1 .. +1.
        zernike: (K, N) m per unit of effective signal.
    """
    furthest = np.zeros(len(expected))
    for actuator, more in displaced.items():
        if probability[actuator] >= SURE:
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
