"""Gains and figure of a calibrated mirror, followed by recursive least squares over maps that arrive later.

In the reduced values of a map (:class:`~dm_calibration.hysteresis.reduction.Reduction`) a calibration says
``v = v0 + V e`` with the effective signals e. Later it is ``v = v0 + d + V diag(e) (1 + g)``: gains have changed by the
shares g, the figure by d. Both walk at random, so what is known of them fades with time; each map is one step of the
Kalman filter, which is recursive least squares with that forgetting (Ljung, System Identification, 2nd ed., section
11.3).

An estimate of drift is noise as well, and on a mirror that stands still nothing else: taken over as it is, it makes the
calibration worse. So each map is first a test of what the maps before it made out: the change that they foretell,
against the change that it shows. Only the share of the former that this evidence carries is used (the positive-part
estimate of a regression through the origin, less one standard error), none of it before a second shape was measured.

A map that departs further from its prediction than chance allows is a bad map, or the mirror is another one: the caller
must not take it in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import ndtri

from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit, effective_maps
from dm_calibration.hysteresis.reduction import Reduction
from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.quality import GRADE_DEAD
from dm_calibration.procedure.applied_history import MapNotUsableError
from dm_calibration.recalibration.displaced import displaced_actuators, displacement
from dm_calibration.recalibration.drift import Drift, DriftRates
from dm_common.optics.piston_tilt import fill_gaps, remove_piston_tilt, rms
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS

Floats = NDArray[np.float64]

DAY_S = 86400.0
#: Least variance of a value that is laid to its map's noise, as a share of what the calibration's maps scatter.
NOISE_SHARE_MIN = 0.1
#: The same in m^2, for maps without any noise.
NOISE_MIN = 1e-24
#: What evidence counts for after one more map: it is of the last thirty maps or so.
EVIDENCE_KEPT = 0.97
#: An actuator that fails stands further from where it should than this many standard deviations.
DISPLACED_SIGMAS = 4.0
#: Gains of actuators that hardly show are not known worse than this.
GAIN_SIGMA_MAX = 0.05


@dataclass(frozen=True, eq=False)
class Comparison:
    """A map against its prediction.

    Attributes:
        max_zernike: m, largest difference of a coefficient beyond tilt from the calibration as it is used.
        rms: m rms of the difference in sag, piston and tilt removed.
        surprise: difference over its expected size: about 1 when all is well. The larger of two: root mean square over
            all values, and the largest single one over the largest to be expected of so many.
        updated: the drift with this map taken in.
        displaced: {index: effective signal more than there should be} of the actuators that the difference comes from,
            the worst first, where a few of them explain it: one that sticks, say.
        probability: {index: of each of them, against any other actuator and against a map that is bad all over}.
    """

    max_zernike: float
    rms: float
    surprise: float
    updated: Drift
    displaced: dict[int, float]
    probability: dict[int, float]


class _Innovation(NamedTuple):
    """A map against its prediction, in R reduced values.

    Attributes:
        prior: (N + R, N + R) covariance of gains and figure at its time.
        design: (R, N + R) what it shows of them.
        foretold, shown: (R,) change that the maps before foretell, and that it shows, m rms.
        expected: (R, R) covariance of their difference.
        factor: Cholesky factor of that.
        zernike_error, sag_error: (K,) and (P,) m, from the calibration as it is used.
    """

    prior: Floats
    design: Floats
    foretold: Floats
    shown: Floats
    expected: Floats
    factor: tuple[Floats, bool]
    zernike_error: Floats
    sag_error: Floats


class DriftFilter:
    """Follows one mirror's :class:`Drift`.

    Args:
        fit: the influence function, of effective signals when `hysteresis` is known.
        maps: what it was fitted to: shows how far a map scatters about its prediction.
        hysteresis: None = not identified.
        signal_sigma: standard deviation of an effective signal where no hysteresis model is identified, normalised.
        rates: see there.

    Raises:
        ValueError: the maps of a hysteresis model have time stamps that run backwards.
    """

    def __init__(
        self, fit: InfluenceFit, maps: MapSet, hysteresis: HysteresisFit | None, signal_sigma: float, rates: DriftRates
    ) -> None:
        self._fit = fit
        self.reduction = Reduction(fit.points, fit.influence_sag, maps.terms)
        self._gain = self.reduction.reduce(fit.influence_zernike.T, fit.influence_sag.T).T
        self._offset = self.reduction.reduce(fit.zernike_offset, fit.sag_offset)
        scatter = self._scatter(maps if hysteresis is None else effective_maps(maps, hysteresis.law))
        if hysteresis is not None:
            signal_sigma = self._law_sigma(hysteresis)
        self._law = signal_sigma**2 * (self._gain @ self._gain.T)
        self._noise = np.maximum(scatter - np.diag(self._law), NOISE_SHARE_MIN * scatter) + NOISE_MIN
        self._growth = self._covariance(rates)

    def start(self, stamp_ns: int) -> Drift:
        """What the calibration itself knows, at its time."""
        fit, values = self._fit, self.reduction.size
        shows = fit.response > 0.0
        share = np.divide(fit.standard_error, fit.response, out=np.full(fit.actuators, GAIN_SIGMA_MAX), where=shows)
        gain = np.square(np.minimum(share, GAIN_SIGMA_MAX))
        offset = (self._noise + np.diag(self._law)) / max(int(fit.used.sum()), 1) + fit.drift_rms**2 / values
        moving = np.full(fit.actuators, np.nan)
        return Drift(
            np.zeros(fit.actuators), np.zeros(values), np.diag(np.concatenate((gain, offset))), stamp_ns, moving
        )

    def compare(
        self, drift: Drift, coefficients: Floats, sag: Floats, effective: Floats, stamp_ns: int, repeat: int = 0
    ) -> Comparison:
        """Compare a map with what `drift` makes of `effective`; nothing is changed.

        Args:
            coefficients: (K,) m.
            sag: (P,) m, NaN = no data.
            effective: (N,) effective signals at the time of the map.
            stamp_ns: of the map; a time before the drift's is taken as the drift's.
            repeat: maps that were taken of this very state before. The error of the law is the same in all of them and
                does not average out, so repeats count for less and less.
        """
        seen = self._innovation(drift, coefficients, sag, effective, stamp_ns, repeat)
        prior, design, innovation, factor = seen.prior, seen.design, seen.shown - seen.foretold, seen.factor
        shared = prior @ design.T
        correction = shared @ cho_solve(factor, innovation)
        # Joseph form: symmetric and positive whatever the rounding.
        kalman = cho_solve(factor, shared.T).T
        left = np.eye(len(prior)) - kalman @ design
        noise = seen.expected - design @ shared
        covariance = left @ prior @ left.T + kalman @ noise @ kalman.T
        evidence = (drift.foretold, drift.borne_out)
        if not repeat:  # a repeat shares the error of the law with the map before it
            weighed = cho_solve(factor, seen.foretold)
            new = (float(weighed @ seen.foretold), float(weighed @ seen.shown))
            evidence = (EVIDENCE_KEPT * evidence[0] + new[0], EVIDENCE_KEPT * evidence[1] + new[1])
        updated = replace(
            drift,
            gain=drift.gain + correction[: len(effective)],
            offset=drift.offset + correction[len(effective) :],
            covariance=0.5 * (covariance + covariance.T),
            stamp_ns=max(stamp_ns, drift.stamp_ns),
            revision=drift.revision + 1,
            checked_ns=stamp_ns,
            surprising=0,
            foretold=evidence[0],
            borne_out=evidence[1],
        )
        displaced, probability = displaced_actuators(innovation, self._gain, factor)
        departure = remove_piston_tilt(seen.sag_error[None], self._fit.points)[0]
        return Comparison(
            max_zernike=float(np.abs(seen.zernike_error)[PISTON_TILT:].max()),
            rms=float(rms(departure, self._fit.points.weight)),
            surprise=_surprise(innovation, seen.expected, factor),
            updated=updated,
            displaced=displaced,
            probability=probability,
        )

    def give_up(
        self,
        drift: Drift,
        actuators: list[int],
        coefficients: Floats,
        sag: Floats,
        effective: Floats,
        stamp_ns: int,
        repeat: int = 0,
    ) -> Drift:
        """`drift` of a mirror on which `actuators` have no effect any more and stand where a map shows them.

        Other args as those of :meth:`compare`.

        Raises:
            MapNotUsableError: one stands where it should, as far as the map shows.
        """
        seen = self._innovation(drift, coefficients, sag, effective, stamp_ns, repeat)
        away, sigma = displacement(seen.shown - seen.foretold, self._gain, seen.factor, actuators)
        at = drift.standing(effective)
        stuck = drift.stuck.copy()
        for actuator, more, error in zip(actuators, away, sigma, strict=True):
            if np.isnan(stuck[actuator]) and abs(more) < DISPLACED_SIGMAS * error:
                raise MapNotUsableError(
                    f"actuator {actuator + 1} stands at {at[actuator] + more:+.2f} +- {error:.2f}, and should at "
                    f"{at[actuator]:+.2f}: this shape does not show that it fails; ask for another first"
                )
            stuck[actuator] = at[actuator] + more
        return replace(drift, stuck=stuck)

    def _innovation(
        self, drift: Drift, coefficients: Floats, sag: Floats, effective: Floats, stamp_ns: int, repeat: int
    ) -> _Innovation:
        elapsed = max(0.0, 1e-9 * (stamp_ns - drift.stamp_ns)) / DAY_S
        prior = drift.covariance + elapsed * self._growth
        design = np.hstack((self._gain * np.where(np.isnan(drift.stuck), effective, 0.0), np.eye(self.reduction.size)))
        changed = self.changed(drift)
        predicted_sag = changed.sag_offset + changed.influence_sag @ effective
        zernike_error = coefficients - changed.zernike_offset - changed.influence_zernike @ effective
        sag_error = fill_gaps(sag[None], predicted_sag[None], self._fit.points)[0] - predicted_sag
        foretold = design @ np.concatenate((drift.gain, drift.offset))
        shown = self.reduction.reduce(zernike_error, sag_error) + drift.trust * foretold
        # What the calibration itself does not know of its influence function, beyond gains.
        leverage = effective @ self._fit.signal_covariance @ effective
        expected = design @ prior @ design.T + (1.0 + leverage) * np.diag(self._noise) + (1.0 + repeat) ** 2 * self._law
        return _Innovation(prior, design, foretold, shown, expected, cho_factor(expected), zernike_error, sag_error)

    def changed(self, drift: Drift) -> InfluenceFit:
        """The influence function with gains and figure as far as what `drift` has found of them is borne out.

        Actuators that do not move have none: what they do where they stand is part of the figure.
        """
        fit, moves = self._fit, np.isnan(drift.stuck)
        coefficients, sag = self.reduction.expand(drift.trust * drift.offset)
        gain = 1.0 + drift.trust * drift.gain
        zernike, surface = fit.influence_zernike * gain, fit.influence_sag * gain
        at = np.where(moves, 0.0, drift.stuck)
        return replace(
            fit,
            influence_zernike=zernike * moves,
            influence_sag=surface * moves,
            zernike_offset=fit.zernike_offset + coefficients + zernike @ at,
            sag_offset=fit.sag_offset + sag + surface @ at,
            grades=np.where(moves, fit.grades, GRADE_DEAD).astype(np.uint8),
        )

    def _scatter(self, maps: MapSet) -> Floats:
        """(R,) variance of the calibration's maps about the fit, m^2."""
        used = maps.select(self._fit.used)
        model = self._fit.sag_offset + used.applied @ self._fit.influence_sag.T
        values = self.reduction.reduce(used.coefficients, fill_gaps(used.sag, model, used.points))
        residual = values - self._offset - used.applied @ self._gain.T
        freedom = max(len(used) - self._fit.actuators - 1, 1)
        return np.asarray(np.square(residual).sum(axis=0) / freedom)

    def _law_sigma(self, hysteresis: HysteresisFit) -> float:
        """Standard deviation of an effective signal that explains the held-out error of the coefficients."""
        count = self.reduction.coefficients
        reach = np.square(self._gain[:count]).sum()
        error = np.square(hysteresis.zernike_sigma[PISTON_TILT:] * TERM_RMS[PISTON_TILT : PISTON_TILT + count]).sum()
        return float(np.sqrt(error / reach))

    def _covariance(self, rates: DriftRates) -> Floats:
        """(N + R, N + R) that one day adds."""
        actuators, values = self._fit.actuators, self.reduction.size
        growth = np.zeros((actuators + values, actuators + values))
        growth[:actuators, :actuators] = 0.5 * rates.gain**2 * (np.eye(actuators) + 1.0)
        growth[actuators:, actuators:] = rates.figure**2 / values * np.eye(values)
        return growth


def _surprise(innovation: Floats, expected: Floats, factor: tuple[Floats, bool]) -> float:
    """`innovation` (R,) over its `expected` covariance (R, R)."""
    size = len(innovation)
    together = np.sqrt(innovation @ cho_solve(factor, innovation) / size)
    # Median of the largest of so many normal numbers.
    largest = -ndtri(0.5 * (1.0 - 0.5 ** (1.0 / size)))
    single = np.abs(innovation / np.sqrt(np.diag(expected))).max() / largest
    return float(max(together, single))
