"""The fast path from a target to its command: what does not depend on the request is computed in advance.

There is time between two requests, but a request must not wait for its command. Both halves give the result of the
regular path, :meth:`CalibratedMirror.command` and :func:`dm_common.hysteresis.inverse.invert`, or report that the
regular path is needed: where a series is too short, a piece not exact enough, or a limit binds. Together they make
planning five times as fast.

With a short power series in the radius, all that is linear in the sag of a conic is computed once per mirror:

    z = c r^2 / (1 + sqrt(1 - q)) = c r^2 sum_j C_j / (2 4^j) q^j,   q = (1 + K) (c r)^2,   C_j the Catalan numbers

(generating function of the Catalan numbers, [6], section 7.5). A mirror of 11 mm and 0.05 1/m has q = 3e-7, so four
terms are exact to rounding.
"""

from functools import cache

import numpy as np

from dm_common import Floats
from dm_common.hysteresis.inverse import LAG_LEFT, LAG_ROUNDS, Pieces, horner, pieces
from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.limits import Limits
from dm_common.optics.conic import disc_coefficients
from dm_common.optics.zernike import PISTON_TILT, TERMS, basis
from dm_controller.planning.mirror_model import CalibratedMirror
from dm_controller.planning.target import FocusTarget, Shape

#: Error of an effective signal above which a piece is not used: a third of a DAC step. Preisach laws stay a hundred
#: times below this; the tables of Duhem operators reach half of it.
EXACT = 1e-5
#: Offset between actuators on the axis on which all onsets are looked up at once; effective signals span about 2.
APART = 1e3
#: Number of powers of q that are kept.
ORDERS = 4
#: Signs of falling and rising moves, in the order of `Pieces.polynomial`.
WAYS = np.array([-1.0, 1.0])[:, None, None]
#: Largest |q| at the rim for which the series is used: the first term left out is 14/512 q^4 of c r^2, 3e-18.
Q_MAX = 1e-4


def series(curvature: float, conic_constant: float, radius: float) -> tuple[float, float, float, float] | None:
    """The ORDERS amplitudes (m) of (r / radius)^2, ^4, ^6, ^8; None where the series is too short."""
    q = (1.0 + conic_constant) * (curvature * radius) ** 2
    if not abs(q) <= Q_MAX:
        return None
    reach = curvature * radius * radius
    return reach / 2, reach * q / 8, reach * q * q / 16, reach * q**3 * (5 / 128)


def series_sag(x: Floats, y: Floats) -> Floats:
    """(P, ORDERS) sag per amplitude at points of the unit disc."""
    return np.asarray((x**2 + y**2)[:, None] ** np.arange(1, ORDERS + 1))


@cache
def series_coefficients() -> Floats:
    """(21, ORDERS) Born & Wolf coefficients per amplitude, by least squares over the full disc."""
    return disc_coefficients(lambda x, y: series_sag(x, y).T).T


class ClosedForm:
    """Effective signals and largest coefficient error of a target: a matrix times its few amplitudes.

    As long as no limit binds, signals are linear in the wanted sag, and wanted sag is linear in the amplitudes of the
    short series, the added Zernike terms and the figure.
    """

    def __init__(self, mirror: CalibratedMirror) -> None:
        model = mirror.model
        self._radius, self._limits = model.aperture_radius, mirror.limits
        x, y = model.points.x, model.points.y
        # Columns: the figure with the amplitude 1, the series, the added terms.
        coefficients = np.column_stack([-model.zernike_offset, series_coefficients(), np.eye(len(TERMS))])
        sag = np.column_stack([-model.sag_offset, series_sag(x, y), basis(x, y)])
        tilt = np.zeros((2, coefficients.shape[1]))
        tilt[:, 1] = -2 / self._radius * mirror.axis  # by the slope of the sphere, whose amplitude is c r^2 / 2
        tilt[:, 1 + ORDERS + 1 : 1 + ORDERS + PISTON_TILT] = np.eye(2)
        signals = mirror.unlimited(Shape(coefficients, sag), tilt)
        errors = (model.influence_zernike @ signals - coefficients)[PISTON_TILT:]
        self._signals = len(signals)
        self._all_terms = np.ascontiguousarray(np.vstack([signals, errors]))
        self._conic_only = np.ascontiguousarray(self._all_terms[:, : 1 + ORDERS])

    def find(self, target: FocusTarget) -> tuple[Floats, float] | None:
        """Effective signals (N,), and the largest coefficient error that they leave, m.

        None where the series is too short for the target, or a limit binds.
        """
        conic = series(target.curvature, target.conic_constant, self._radius)
        if conic is None:
            return None
        if target.zernike:
            result = self._all_terms @ np.array([1.0, *conic, *target.zernike])
        else:
            result = self._conic_only @ np.array((1.0, *conic))
        signals, errors = result[: self._signals], np.abs(result[self._signals :])
        return (signals, float(np.maximum.reduce(errors))) if self._limits.allow(signals) else None


class PreparedInverse:
    """The inverse of the hysteresis model from one state, at any time after it.

    The state that the driver reported determines, for both directions and every actuator, the onsets of the play
    operators and the law between them. Between onsets the inverse is smooth: a cubic that meets values and slopes at
    both ends of a piece. A request then only needs to look its pieces up and to sum three powers.

    Args:
        law: one whose effective signals depend on the past.
        state: of a mirror at rest.
    """

    def __init__(self, law: HysteresisModel, state: HysteresisState, limits: Limits) -> None:
        self.state, self._limits = state, limits
        self._low, self._high = limits.low, limits.high
        self._rate = -1.0 / law.creep_time
        self._law, self._share, self._lag = law, np.atleast_2d(law.creep_share), np.atleast_2d(law.lag_share)
        self._gap = self._share * (state.crept - state.position[:, None])
        self._gap[:, : self._lag.shape[1]] += self._lag * (state.lagged - state.signals[:, None])
        self._apart = state.signals - state.position
        self._rests: dict[float, tuple[Floats, Floats, Floats]] = {}
        parts = pieces(law)
        # Without an operator of half-width 0 there is a dead zone about the state, which no piece describes.
        self._serves = parts.radius[0] == 0.0
        if self._serves:
            self._prepare(parts)

    def _prepare(self, parts: Pieces) -> None:
        """Tabulate the pieces, ordered by direction (falling first), then by actuator, then by onset."""
        curve, count = parts.polynomial, len(self.state.signals)
        begin, first, steeper, waiting = parts.onsets(self.state, WAYS, curve)
        if len(curve) == 2 and not parts.fading.size:
            slope = 1.0 / np.broadcast_to(curve[1], begin.shape)
            self._table = np.stack((begin, first, slope), axis=-1).reshape(-1, 3)
        else:
            self._table = self._cubics(parts, begin, first, steeper, waiting)
        rows = APART * np.arange(2.0 * count)
        self._falling, self._rising = rows[:count], rows[count:]
        places = (WAYS * first).reshape(len(rows), -1)
        places[:, 0] = -0.5 * APART  # nothing lies before the state itself
        self._places = (places + rows[:, None]).ravel()

    def _cubics(self, parts: Pieces, begin: Floats, first: Floats, steeper: Floats, waiting: Floats) -> Floats:
        """Rows of: onset, value there, and coefficients 1 to 3 of the inverse from there; NaN where it is not exact.

        The arguments are what `Pieces.onsets` returns.
        """
        ends, curve = np.array([[self._low], [self._high]]), parts.polynomial
        # A piece ends where the next one begins, the last one at the limit.
        end, last = np.empty_like(begin), np.empty_like(begin)
        end[..., :-1], end[..., -1] = begin[..., 1:], ends
        last[..., :-1], last[..., -1] = first[..., 1:], horner(curve[..., -1], ends)
        added, steeper_last = parts.fading.along(self.state.fading, self.state.signals, end, WAYS)
        last[..., -1] += added[..., -1]
        steep_first = horner(parts.derivative, begin) + steeper
        steep_last = horner(parts.derivative, end) + steeper_last
        with np.errstate(divide="ignore", invalid="ignore"):  # pieces of no width, which hold no solution
            rise = last - first
            chord, one, two = (end - begin) / rise, 1.0 / steep_first, 1.0 / steep_last
            square, cube = (3.0 * chord - 2.0 * one - two) / rise, (one + two - 2.0 * chord) / rise**2
            # The error is evaluated in the middle, where it is largest.
            middle = 0.5 * rise
            way = ((cube * middle + square) * middle + one) * middle
            error = horner(curve, begin + way) + waiting - first - middle
            error += parts.fading.along(self.state.fading, self.state.signals, begin + way, WAYS)[0]
        cube[~(np.abs(error) <= EXACT)] = np.nan
        return np.stack((begin, first, one, square, cube), axis=-1).reshape(-1, 5)

    def invert(self, time: float, effective: Floats, ahead: float) -> Floats | None:
        """Signals (N,) applied at `time` (s) for `effective` (N,) `ahead` s later; None = use `inverse.invert`."""
        if not self._serves:
            return None
        faded, grown, followed = self._creep(time, ahead)
        signals, apart, left = self.state.signals, self._apart, np.inf
        for _ in range(LAG_ROUNDS):
            wanted = self._law.static_of(effective, grown, faded + followed * apart)
            signals = self._from_table(wanted)
            before, apart = apart, signals - wanted
            last, left = left, np.maximum.reduce(np.abs(followed * (apart - before)))
            if not LAG_LEFT < left < last:  # as in `invert`; also for NaN
                break
        # No rounding beyond an end; a piece that is not exact gives NaN, which fails here too.
        inside = np.minimum.reduce(signals) >= self._low and np.maximum.reduce(signals) <= self._high
        return np.asarray(signals) if inside and self._limits.allow_neighbours(signals) else None

    def _from_table(self, wanted: Floats) -> Floats:
        """Signals (N,) for static effective signals; NaN where a piece is not exact."""
        places = np.where(wanted >= self.state.position, self._rising + wanted, self._falling - wanted)
        piece = self._table[self._places.searchsorted(places, "right") - 1].T
        rise = wanted - piece[1]
        if len(piece) == 3:
            return np.asarray(piece[0] + piece[2] * rise)
        return np.asarray(piece[0] + ((piece[4] * rise + piece[3]) * rise + piece[2]) * rise)

    def _creep(self, time: float, ahead: float) -> tuple[Floats, Floats, Floats]:
        """As `HysteresisModel.creep_ahead` for the state at `time`, but the second result includes the third."""
        elapsed = max(time - self.state.time, 0.0) + ahead
        known = self._rests.get(ahead)
        if known is None:
            rest = np.exp(ahead * self._rate)
            lag = self._lag @ rest[: self._lag.shape[1]]
            followed = self._lag.sum(axis=1) - lag
            rest = self._share @ rest
            faded = rest * self.state.position + lag * self.state.signals
            known = faded, self._share.sum(axis=1) - rest + followed, followed
            self._rests[ahead] = known
        return known[0] + self._gap @ np.exp(elapsed * self._rate), known[1], known[2]
