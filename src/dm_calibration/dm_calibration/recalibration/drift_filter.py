"""Gains and figure of a calibrated mirror, followed by recursive least squares over maps that arrive later.

In the reduced values of a map (:class:`~dm_calibration.hysteresis.responses.Reduction`) a calibration predicts ``v = v0
+ V e`` from the effective signals e. Later it is ``v = v0 + d + c + V diag(e) (1 + g)``: gains have changed by the
shares g, the figure by d and by creep c slower than the run of the calibration shows. If maps have a temperature, t
above that of the calibration, ``k t V e + h t`` is added, with constants k of all gains and h of the figure. Creep
fades, and gains and figure are random walks, so knowledge of them fades with time. Each map is a step of the Kalman
filter, which is recursive least squares with that forgetting (Ljung, System Identification, 2nd ed., section 11.3).

An estimate of drift contains noise; on a mirror that does not drift it is nothing but noise, and would make the
calibration worse. So each map first tests the estimate from earlier maps: the predicted change is compared with the
measured one. Only the share of the estimate that this evidence supports is used (the positive-part estimate of a
regression through the origin, less one standard error), and none of it before a second shape was measured. Changes by
temperature are tested separately in the same way.

If a map differs from its prediction by more than chance allows, either the map is bad or the mirror has changed: the
caller must not use it.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from dm_calibration.calibration import Calibration
from dm_calibration.hysteresis.hysteresis_fit import effective_maps
from dm_calibration.hysteresis.responses import Reduction
from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.quality import GRADE_DEAD
from dm_calibration.procedure.applied_history import MapNotUsableError
from dm_calibration.recalibration.displaced import displaced_actuators, given_up_at, visible_gain, without_response
from dm_calibration.recalibration.drift import WARM_FIGURE, WARM_GAIN, Comparison, Drift, UpdateOptions, surprise_of
from dm_common import LARGEST_95, Floats
from dm_common.hysteresis.creep_record import slow_creep
from dm_common.hysteresis.model import HysteresisModel
from dm_common.measurement import Measurement
from dm_common.optics.piston_tilt import fill_gaps, remove_piston_tilt, rms
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS

DAY_S = 86400.0
#: Least variance of a value that is attributed to the noise of its map: as a share of the scatter of the calibration's
#: maps, and in m^2, for maps without any noise.
NOISE_SHARE_MIN, NOISE_MIN = 0.1, 1e-24
#: Factor on earlier evidence for each further map: evidence covers about the last thirty maps.
EVIDENCE_KEPT = 0.97
#: The same for the mean square of surprises, which covers about the last four maps.
MISFIT_KEPT = 0.75
GAIN_SIGMA_MAX = 0.05  # largest relative standard deviation of a gain, even of actuators with little response
#: Decades of time for which a stuck actuator creeps on, as after a move across the range: with the factor on every
#: bound (1.4), and a map some ten seconds after it failed, that covers about two hours.
STUCK_DECADES = 2.0


class _Innovation(NamedTuple):
    """A map against its prediction, in R reduced values.

    Attributes:
        design: (R, N + 3 R + 1) sensitivity of the values to gains, figure, temperature coefficients and creep.
        predicted, warm, shown: (R,) m rms: change that earlier maps predict, that they predict from temperature, and
            measured change.
        expected: (R, R) covariance of their difference.
        factor: Cholesky factor of that.
        zernike_error, sag_error: (K,) and (P,) m, departure of the map from the calibration as it is used.
    """

    design: Floats
    predicted: Floats
    warm: Floats
    shown: Floats
    expected: Floats
    factor: tuple[Floats, bool]
    zernike_error: Floats
    sag_error: Floats


class DriftFilter:
    """Follows one mirror's :class:`Drift`.

    Args:
        calibration: its maps give the scatter of a map about its prediction.
        options: how fast a mirror drifts, and the error of effective signals without a hysteresis model.

    Raises:
        ValueError: the maps of a hysteresis model have time stamps that run backwards.
    """

    def __init__(self, calibration: Calibration, options: UpdateOptions) -> None:
        fit, maps, hysteresis = calibration.fit, calibration.maps, calibration.hysteresis
        self._fit, self.options, self._began_ns = fit, options, calibration.stamp_ns
        self.reduction = Reduction(fit.points, fit.influence_sag, maps.terms)
        self._gain = self.reduction.reduce(fit.influence_zernike.T, fit.influence_sag.T).T
        self._visible = visible_gain(self._gain, self.reduction, calibration)
        self._silent = without_response(calibration)
        self._offset = self.reduction.reduce(fit.zernike_offset, fit.sag_offset)
        scatter = self._scatter(maps if hysteresis is None else effective_maps(maps, hysteresis.law))
        signal_sigma = options.signal_sigma if hysteresis is None else hysteresis.signal_sigma(fit.influence_zernike)
        self._creep_law = HysteresisModel.linear() if hysteresis is None else hysteresis.law
        # Covariance of the values for independent errors of 1 in all effective signals.
        self._unit = self._gain @ self._gain.T
        self._law = signal_sigma**2 * self._unit
        self._noise = np.maximum(scatter - np.diag(self._law), NOISE_SHARE_MIN * scatter) + NOISE_MIN
        # (N + 3 R + 1, N + 3 R + 1) growth of the covariance of a drift in one day.
        values = self.reduction.size
        gains = 0.5 * options.gain_rate**2 * (np.eye(fit.actuators) + 1.0)
        figure = options.figure_rate**2 / values * np.eye(values)
        self._growth = np.asarray(block_diag(gains, figure, np.zeros((1 + 2 * values,) * 2)))
        known = np.isfinite(maps.temperature) & fit.used
        self._temperature = float(maps.temperature[known].mean()) if known.any() else np.nan

    def start(self, stamp_ns: int) -> Drift:
        """The drift at the time of the calibration: none, with the uncertainty of the calibration."""
        fit, values, shows = self._fit, self.reduction.size, self._fit.response > 0.0
        share = np.divide(fit.standard_error, fit.response, out=np.full(fit.actuators, GAIN_SIGMA_MAX), where=shows)
        gain = np.square(np.minimum(share, GAIN_SIGMA_MAX))
        offset = (self._noise + np.diag(self._law)) / max(int(fit.used.sum()), 1) + fit.drift_rms**2 / values
        warm = np.array([WARM_GAIN**2, *np.full(values, WARM_FIGURE**2 / values)])
        return Drift(
            gain=np.zeros(fit.actuators),
            offset=np.zeros(values),
            thermal=np.zeros(1 + values),
            crept=np.zeros(values),
            covariance=np.diag(np.concatenate((gain, offset, warm, np.zeros(values)))),
            stamp_ns=stamp_ns,
            stuck=np.full(fit.actuators, np.nan),
            failing=np.full(fit.actuators, np.nan),
            temperatures=np.full(3, self._temperature),
        )

    def compare(self, drift: Drift, measured: Measurement, effective: Floats, repeat: int = 0) -> Comparison:
        """Compare a map with what `drift` predicts for it; nothing is changed.

        Args:
            measured: a map older than the drift is dated to the time of the drift. If the calibration has no
                temperature, the first one measured with a map takes its place.
            effective: (N,) effective signals at the time of the map.
            repeat: number of earlier maps of the same state. The error of the law is the same in all of them and does
                not average out, so repeats have less and less weight.
        """
        drift = self._at(drift, measured.stamp_ns)
        seen = self._innovation(drift, measured, effective, repeat)
        prior, design, factor = drift.covariance, seen.design, seen.factor
        innovation = seen.shown - seen.predicted - seen.warm
        shared = prior @ design.T
        ends = np.cumsum((self._fit.actuators, self.reduction.size, 1 + self.reduction.size))
        gain, offset, thermal, crept = np.split(shared @ cho_solve(factor, innovation), ends)
        # Joseph form: symmetric and positive whatever the rounding.
        kalman = cho_solve(factor, shared.T).T
        left = np.eye(len(prior)) - kalman @ design
        covariance = left @ prior @ left.T + kalman @ (seen.expected - design @ shared) @ kalman.T
        evidence, misfit = drift.evidence.copy(), drift.misfit
        surprise = surprise_of(innovation, seen.expected, factor)
        if not repeat:  # a repeat shares the error of the law with the map before it
            weighed, warm = cho_solve(factor, seen.predicted), cho_solve(factor, seen.warm)
            rest = seen.shown - drift.thermal_trust * seen.warm, seen.shown - drift.trust * seen.predicted
            evidence[0] *= EVIDENCE_KEPT
            evidence[1] *= EVIDENCE_KEPT if seen.warm.any() else 1.0  # a map not warmer is no evidence
            misfit = MISFIT_KEPT * misfit + (1.0 - MISFIT_KEPT) * surprise**2
            evidence += (weighed @ seen.predicted, weighed @ rest[0]), (warm @ seen.warm, warm @ rest[1])
        known = np.append(drift.temperatures, measured.temperature)
        updated = replace(
            drift,
            gain=drift.gain + gain,
            offset=drift.offset + offset,
            thermal=drift.thermal + thermal,
            crept=drift.crept + crept,
            covariance=0.5 * (covariance + covariance.T),
            stamp_ns=max(measured.stamp_ns, drift.stamp_ns),
            revision=drift.revision + 1,
            checked_ns=max(measured.stamp_ns, drift.checked_ns),
            surprising=0,
            disagreement=0.0,
            misfit=misfit,
            evidence=evidence,
            temperatures=np.array(
                [next(filter(np.isfinite, known), np.nan), np.fmin.reduce(known), np.fmax.reduce(known)]
            ),
        )
        return Comparison(
            max_zernike=float(np.abs(seen.zernike_error)[PISTON_TILT:].max()),
            rms=float(rms(remove_piston_tilt(seen.sag_error[None], self._fit.points)[0], self._fit.points.weight)),
            surprise=surprise,
            updated=updated,
            displaced=displaced_actuators(innovation, self._visible, factor, self._silent, self.reduction.coefficients),
        )

    def give_up(
        self, drift: Drift, actuators: list[int], measured: Measurement, effective: Floats, repeat: int = 0
    ) -> Drift:
        """`drift` with `actuators` given up: they have no effect any more and stand where a map shows them.

        Args as of :meth:`compare`.

        Raises:
            MapNotUsableError: see :func:`given_up_at`; or no actuator that responds is left.
        """
        seen = self._innovation(self._at(drift, measured.stamp_ns), measured, effective, repeat)
        innovation = seen.shown - seen.predicted - seen.warm
        moving, at = np.isnan(drift.stuck), drift.reached(effective)
        stuck = drift.stuck.copy()
        stuck[actuators] = given_up_at(innovation, self._gain, seen.factor, actuators, at, moving)
        if (np.isfinite(stuck) | self._silent).all():
            raise MapNotUsableError("no actuator that responds would be left: calibrate anew")
        return drift.fixed(stuck, effective, self._fit.influence_zernike)

    def _at(self, drift: Drift, stamp_ns: int) -> Drift:
        """`drift` as expected at `stamp_ns`, with its own stamp kept: creep fades, and the covariance grows."""
        elapsed = max(0.0, 1e-9 * (stamp_ns - drift.stamp_ns))
        grown, most = (slow_creep(self._creep_law, time) for time in (elapsed, np.inf))
        kept = float(np.sqrt(1.0 - (grown / most) ** 2)) if most else 1.0
        fade = np.ones(len(drift.covariance))
        creep = slice(-self.reduction.size, None)
        fade[creep] = kept
        # Drift is only a part of what maps differ by: to account for the excess it must have grown by more than that.
        covariance = drift.covariance * np.outer(fade, fade) + drift.excess**2 * elapsed / DAY_S * self._growth
        covariance[creep, creep] += grown**2 * self._unit
        return replace(drift, crept=kept * drift.crept, covariance=covariance)

    def _innovation(self, drift: Drift, measured: Measurement, effective: Floats, repeat: int) -> _Innovation:
        """Compare a map with its prediction; `drift` must be the one expected at its time."""
        temperature = measured.temperature
        moved = self._gain * np.where(np.isnan(drift.stuck), effective, 0.0)
        figure, warmer = np.eye(self.reduction.size), drift.warmer(temperature)
        warmed = warmer * np.column_stack((moved.sum(axis=1), figure))
        design = np.hstack((moved, figure, warmed, figure))
        changed = self.changed(drift, temperature)
        predicted_sag = changed.sag_offset + changed.influence_sag @ effective
        zernike_error = measured.coefficients - changed.zernike_offset - changed.influence_zernike @ effective
        sag_error = self.reduction.fill(measured.sag - predicted_sag)
        predicted, warm = moved @ drift.gain + drift.figure, warmed @ drift.thermal
        used = drift.trust * predicted + drift.thermal_trust * warm
        shown = self.reduction.reduce(zernike_error, sag_error) + used
        # Uncertainty of the calibration's influence function other than that of gains.
        leverage = effective @ self._fit.signal_covariance @ effective
        expected = design @ drift.covariance @ design.T + (1.0 + repeat) ** 2 * self._law
        creeping = 0.5 * self._gain * self._creeping_on(drift)
        expected += (1.0 + leverage) * np.diag(self._noise) + creeping @ creeping.T
        if np.isnan(temperature):  # any change within the temperatures of earlier maps is possible
            unknown = np.column_stack((moved.sum(axis=1), figure)) @ drift.thermal
            expected += (drift.thermal_trust * drift.temperature_range) ** 2 * np.outer(unknown, unknown)
        factor = cho_factor(expected)
        return _Innovation(design, predicted, warm, shown, expected, factor, zernike_error, sag_error)

    def warm_error(self, drift: Drift, temperature: float) -> float:
        """95 % bound of the coefficient error by an unknown `temperature` (degC), m; 0 if known or without effect.

        An unknown temperature is taken to be within the range of those of the maps.
        """
        if np.isfinite(temperature):
            return 0.0
        coefficients = np.abs(self.reduction.expand(drift.thermal[1:])[0])
        coefficients += np.abs(drift.thermal[0]) * np.abs(self._fit.influence_zernike).sum(axis=1)
        return float(drift.thermal_trust * drift.temperature_range * coefficients[PISTON_TILT:].max())

    def drift_error(self, drift: Drift, elapsed: float) -> float:
        """95 % bound of the coefficient error, m, at half of what a term alone can reach, by drift since the last map,
        `elapsed` s ago, and by earlier drift that maps leave open, or show but have not confirmed.
        """
        moved = drift.at_half(self._gain[: self.reduction.coefficients])
        # What was uncertain when it was calibrated is part of every bound.
        parts = np.stack((drift.covariance - self.start(0).covariance, drift.excess**2 / DAY_S * self._growth))
        left, growth = np.einsum("ki,mij,kj->mk", moved, parts[:, : moved.shape[1], : moved.shape[1]], moved)
        unused = np.square((1.0 - drift.trust) * moved @ np.concatenate((drift.gain, drift.offset)))
        earlier = growth * max(0.0, 1e-9 * (drift.stamp_ns - self._began_ns))
        size = np.sqrt(np.clip(left + np.minimum(unused, earlier), 0.0, earlier) + growth * elapsed)
        return LARGEST_95 * float((size / TERM_RMS[PISTON_TILT:][: len(size)]).max())

    def stuck_error(self, drift: Drift) -> float:
        """Bound of the coefficient error by stuck actuators that creep on, m; 0 without a law of creep."""
        return float((np.abs(self._fit.influence_zernike[PISTON_TILT:]) @ self._creeping_on(drift)).max())

    def _creeping_on(self, drift: Drift) -> Floats:
        """(N,) bound of the further creep of stuck actuators, in effective signal; 0 for the others."""
        return STUCK_DECADES * self._creep_law.creep_rate * np.nan_to_num(1.0 + np.abs(drift.stuck))

    def changed(self, drift: Drift, temperature: float = np.nan) -> InfluenceFit:
        """The fit changed by the confirmed part of `drift`; stuck actuators only change the figure."""
        fit, moves = self._fit, np.isnan(drift.stuck)
        warmer = drift.thermal_trust * drift.warmer(temperature)
        coefficients, sag = self.reduction.expand(drift.trust * drift.figure + warmer * drift.thermal[1:])
        gain = 1.0 + drift.trust * drift.gain + warmer * drift.thermal[0]
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
        return np.asarray(np.square(residual).sum(axis=0) / max(len(used) - self._fit.actuators - 1, 1))
