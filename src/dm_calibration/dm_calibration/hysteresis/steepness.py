"""Laws of actuators that rise everywhere: what is known of their weights where they would be too flat."""

import numpy as np
from numpy.polynomial import legendre

from dm_calibration.hysteresis.actuator_weights import Known
from dm_common import Floats
from dm_common.hysteresis.law_shape import PLACES, slope_min, slopes, span
from dm_common.hysteresis.model import HysteresisModel

#: Where a law is flatter than STEEPER times the smallest slope allowed, it is fitted to this slope with a standard
#: deviation of STEEP_SIGMA.
STEEPER, STEEP_SIGMA = 1.5, 0.02

#: If a law would keep less than LEAST of its hysteresis, hardly any map may show where it is too flat: it is drawn
#: halfway to the mean of the others instead, with half its Duhem weight. If more than one law and more than the share
#: LOST are so flat, all stay: the fit is refused.
LEAST, LOST = 0.7, 0.1


class Steepness:
    """Slopes of laws as sums over the patterns of their play operators.

    Args:
        basis: (R D, K) patterns: weights of Legendre polynomials 1 .. D of R play operators.
        radius: (R,) half-widths of these.
        low, high: signals between which laws must have an inverse.
        least: smallest slope that they may have there.
    """

    def __init__(self, basis: Floats, radius: Floats, low: float, high: float, least: float) -> None:
        self._low, self._high, self._least = low, high, least
        each = basis.reshape(len(radius), -1, basis.shape[1])
        orders = range(1, each.shape[1] + 1)
        slope_of = [legendre.legder([0.0] * order + [1.0]) for order in orders]
        signals = np.linspace(low, high, PLACES)[:, None]
        rows = []
        for sign in (-1.0, 1.0):
            slope = np.stack([legendre.legval(signals - sign * radius, one) for one in slope_of], axis=-1)
            rows.append(np.einsum("srd,rdk->srk", slope, each).cumsum(axis=1))
        #: (2 S R, K) slope due to each pattern, at all places of :func:`slopes`.
        self._rows = np.stack(rows).reshape(-1, basis.shape[1])

    def share_kept(self, law: HysteresisModel) -> Floats:
        """(N,) share of its hysteresis that each law can keep and still be inverted safely; 1 or more = all of it."""
        return np.asarray((1.0 - self._least) / (1.0 - np.minimum(slope_min(law, self._low, self._high), 0.999)))

    def known(self, law: HysteresisModel, patterns: Floats, count: int) -> Known:
        """What is known of the weights if laws rise everywhere: where `law` is too flat, it is steeper.

        Without this, weights that hardly any map shows may make a law fall.

        Args:
            law: of any scale.
            patterns: (K, N) weights of its patterns.
            count: number of weights of an actuator, of which the patterns are the first.
        """
        size, actuators = patterns.shape
        precision, pull = np.zeros((actuators, count, count)), np.zeros((actuators, count))
        mean = span(law, self._low, self._high) / (self._high - self._low)
        lacking = STEEPER * self._least * mean[:, None, None] - slopes(law, self._low, self._high)
        missing = np.maximum(np.moveaxis(lacking, 1, 0).reshape(actuators, -1), 0.0)
        some = np.flatnonzero(missing.any(axis=0))  # places at which any law is too flat
        missing, rows = missing[:, some], self._rows[some] / STEEP_SIGMA
        seen = rows.T @ ((missing > 0.0)[..., None] * rows)  # (N, K, K)
        precision[:, :size, :size] = seen
        pull[:, :size] = (seen @ patterns.T[..., None])[..., 0] + missing / STEEP_SIGMA @ rows
        return Known(precision, pull)


def shrink(patterns: Floats, share: Floats, loops: int) -> bool:
    """Leave laws too flat to be inverted less of their hysteresis, see LEAST; False = too many are, so all stay.

    Args:
        patterns: (F, N) weights of their features, changed in place.
        share: (N,) of its hysteresis that each can keep.
        loops: number of the first features; others do not follow those of the other laws.
    """
    flat, lost = share < 1.0, share < LEAST
    if lost.all() or lost.sum() > max(1.0, LOST * len(lost)):
        return False
    others = patterns[:, ~lost].mean(axis=1, keepdims=True)
    others[loops:] = 0.0
    patterns[:, lost] = 0.5 * (patterns[:, lost] + others)
    less = flat & ~lost
    patterns[1:, less] *= 0.999 * share[less]
    return True
