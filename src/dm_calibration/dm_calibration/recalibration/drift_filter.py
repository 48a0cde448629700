"""Gains and figure of a calibrated mirror, followed by recursive least squares over maps that arrive later.

In the reduced values of a map (:class:`~dm_calibration.hysteresis.responses.Reduction`) a calibration says ``v = v0 + V
e`` with the effective signals e. Later it is ``v = v0 + d + c + V diag(e) (1 + g)``: gains have changed by the shares
g, the figure by d, and by c of creep slower than the calibration's run shows. Where maps tell the temperature, t above
that of the calibration, ``k t V e + h t`` comes on top: k of all gains and h of the figure do not change. Creep fades,
gains and figure walk at random, so what is known of them fades with time; each map is one step of the Kalman filter,
which is recursive least squares with that forgetting (Ljung, System Identification, 2nd ed., section 11.3).

An estimate of drift is noise as well, and on a mirror that stands still nothing else: taken over as it is, it makes the
calibration worse. So each map is first a test of what the maps before it made out: the change that they predict,
against the change that it shows. Only the share of the former that this evidence carries is used (the positive-part
estimate of a regression through the origin, less one standard error), none of it before a second shape was measured.
Changes by temperature are tested so by themselves.

A map that departs further from its prediction than chance allows is a bad map, or the mirror is another one: the caller
must not take it in.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from dm_calibration.calibration import Calibration
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit, effective_maps
from dm_calibration.hysteresis.responses import Reduction
from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.quality import GRADE_DEAD
from dm_calibration.procedure.applied_history import MapNotUsableError
from dm_calibration.recalibration.displaced import displaced_actuators, displacement, visible_gain, without_response
from dm_calibration.recalibration.drift import WARM_FIGURE, WARM_GAIN, Comparison, Drift, UpdateOptions, surprise_of
from dm_common import Floats
from dm_common.hysteresis.creep_record import slow_creep
from dm_common.hysteresis.model import HysteresisModel
from dm_common.measurement import Measurement
from dm_common.optics.piston_tilt import fill_gaps, remove_piston_tilt, rms
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS

DAY_S = 86400.0
#: Least variance of a value that is laid to its map's noise, as a share of what the calibration's maps scatter, and
#: in m^2, for maps without any noise.
NOISE_SHARE_MIN, NOISE_MIN = 0.1, 1e-24
#: What evidence counts for after one more map: it is of the last thirty maps or so.
EVIDENCE_KEPT = 0.97
#: An actuator that fails stands further from where it should than this many standard deviations.
DISPLACED_SIGMAS = 4.0
GAIN_SIGMA_MAX = 0.05  # gains of actuators that hardly show are not known worse
#: One given up creeps on as after a move across the range, for so many decades of time: with the allowance that every
#: bound has (1.4), and a map some ten seconds after it failed, for about two hours.
STUCK_DECADES = 2.0


class _Innovation(NamedTuple):
    """A map against its prediction, in R reduced values.

    Attributes:
        design: (R, N + 3 R + 1) what it shows of gains, figure, what temperature does and creep.
        predicted, warm, shown: (R,) change that the maps before predict, that they predict of the temperature, and
            that it shows, m rms.
        expected: (R, R) covariance of their difference.
        factor: Cholesky factor of that.
        zernike_error, sag_error: (K,) and (P,) m, from the calibration as it is used.
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
        calibration: its maps show how far a map scatters about its prediction.
        options: how fast a mirror drifts, and how far actuators stand off without a hysteresis model.

    Raises:
        ValueError: the maps of a hysteresis model have time stamps that run backwards.
    """

    def __init__(self, calibration: Calibration, options: UpdateOptions) -> None:
        fit, maps, hysteresis = calibration.fit, calibration.maps, calibration.hysteresis
        self._fit, self.options = fit, options
        self.reduction = Reduction(fit.points, fit.influence_sag, maps.terms)
        self._gain = self.reduction.reduce(fit.influence_zernike.T, fit.influence_sag.T).T
        self._visible = visible_gain(self._gain, self.reduction, calibration)
        self._silent = without_response(calibration)
        self._offset = self.reduction.reduce(fit.zernike_offset, fit.sag_offset)
        scatter = self._scatter(maps if hysteresis is None else effective_maps(maps, hysteresis.law))
        signal_sigma = options.signal_sigma if hysteresis is None else self._law_sigma(hysteresis)
        self._creep_law = HysteresisModel.linear() if hysteresis is None else hysteresis.law
        # What effective signals that err by 1 each, whichever way, make of the values.
        self._unit = self._gain @ self._gain.T
        self._law = signal_sigma**2 * self._unit
        self._noise = np.maximum(scatter - np.diag(self._law), NOISE_SHARE_MIN * scatter) + NOISE_MIN
        # (N + 3 R + 1, N + 3 R + 1) that one day adds to the covariance of a drift.
        values = self.reduction.size
        gains = 0.5 * options.gain_rate**2 * (np.eye(fit.actuators) + 1.0)
        figure = options.figure_rate**2 / values * np.eye(values)
        self._growth = np.asarray(block_diag(gains, figure, np.zeros((1 + 2 * values,) * 2)))
        known = np.isfinite(maps.temperature) & fit.used
        self._temperature = float(maps.temperature[known].mean()) if known.any() else np.nan

    def start(self, stamp_ns: int) -> Drift:
        """What the calibration itself knows, at its time."""
        fit, values = self._fit, self.reduction.size
        shows = fit.response > 0.0
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
            temperatures=np.full(3, self._temperature),
        )

    def compare(self, drift: Drift, measured: Measurement, effective: Floats, repeat: int = 0) -> Comparison:
        """Compare a map with what `drift` makes of it; nothing is changed.

        Args:
            measured: of a time before the drift's, it is taken as of the drift's. The temperature of the first map
                which tells it stands for that of a calibration which does not.
            effective: (N,) effective signals at its time.
            repeat: maps that were taken of this very state before. The error of the law is the same in all of them and
                does not average out, so repeats count for less and less.
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
        noise = seen.expected - design @ shared
        covariance = left @ prior @ left.T + kalman @ noise @ kalman.T
        evidence = drift.evidence.copy()
        if not repeat:  # a repeat shares the error of the law with the map before it
            weighed, warm = cho_solve(factor, seen.predicted), cho_solve(factor, seen.warm)
            rest = seen.shown - drift.thermal_trust * seen.warm, seen.shown - drift.trust * seen.predicted
            evidence[0] *= EVIDENCE_KEPT
            evidence[1] *= EVIDENCE_KEPT if seen.warm.any() else 1.0  # a map that is not warmer says nothing of it
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
            checked_ns=measured.stamp_ns,
            surprising=0,
            disagreement=0.0,
            evidence=evidence,
            temperatures=np.array(
                [next(filter(np.isfinite, known), np.nan), np.fmin.reduce(known), np.fmax.reduce(known)]
            ),
        )
        departure = remove_piston_tilt(seen.sag_error[None], self._fit.points)[0]
        return Comparison(
            max_zernike=float(np.abs(seen.zernike_error)[PISTON_TILT:].max()),
            rms=float(rms(departure, self._fit.points.weight)),
            surprise=surprise_of(innovation, seen.expected, factor),
            updated=updated,
            displaced=displaced_actuators(innovation, self._visible, factor, self._silent),
        )

    def give_up(
        self, drift: Drift, actuators: list[int], measured: Measurement, effective: Floats, repeat: int = 0
    ) -> Drift:
        """`drift` of a mirror on which `actuators` have no effect any more and stand where a map shows them.

        Args as of :meth:`compare`.

        Raises:
            MapNotUsableError: one stands where it should, as far as the map shows.
        """
        seen = self._innovation(self._at(drift, measured.stamp_ns), measured, effective, repeat)
        away, sigma = displacement(seen.shown - seen.predicted - seen.warm, self._gain, seen.factor, actuators)
        at = drift.reached(effective)
        stuck = drift.stuck.copy()
        for actuator, more, error in zip(actuators, away, sigma, strict=True):
            if np.isnan(stuck[actuator]) and abs(more) <= DISPLACED_SIGMAS * error:
                raise MapNotUsableError(
                    f"actuator {actuator + 1} stands at {at[actuator] + more:+.2f} +- {error:.2f}, and should at "
                    f"{at[actuator]:+.2f}: this shape does not show that it fails; ask for another first"
                )
            stuck[actuator] = at[actuator] + more
        return replace(drift, stuck=stuck)

    def _at(self, drift: Drift, stamp_ns: int) -> Drift:
        """`drift` as expected at `stamp_ns`, still with its own stamp: creep fades, and all is known less well."""
        elapsed = max(0.0, 1e-9 * (stamp_ns - drift.stamp_ns))
        grown, most = (slow_creep(self._creep_law, time) for time in (elapsed, np.inf))
        kept = float(np.sqrt(1.0 - (grown / most) ** 2)) if most else 1.0
        fade = np.ones(len(drift.covariance))
        creep = slice(-self.reduction.size, None)
        fade[creep] = kept
        covariance = drift.covariance * np.outer(fade, fade) + elapsed / DAY_S * self._growth
        covariance[creep, creep] += grown**2 * self._unit
        return replace(drift, crept=kept * drift.crept, covariance=covariance)

    def _innovation(self, drift: Drift, measured: Measurement, effective: Floats, repeat: int) -> _Innovation:
        """`drift`: at the time of the map."""
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
        # What the calibration itself does not know of its influence function, beyond gains.
        leverage = effective @ self._fit.signal_covariance @ effective
        expected = design @ drift.covariance @ design.T + (1.0 + repeat) ** 2 * self._law
        creeping = 0.5 * self._gain * self._creeping_on(drift)
        expected += (1.0 + leverage) * np.diag(self._noise) + creeping @ creeping.T
        if np.isnan(temperature):  # what it has been seen to do may have happened
            unknown = np.column_stack((moved.sum(axis=1), figure)) @ drift.thermal
            expected += (drift.thermal_trust * drift.temperature_range) ** 2 * np.outer(unknown, unknown)
        factor = cho_factor(expected)
        return _Innovation(design, predicted, warm, shown, expected, factor, zernike_error, sag_error)

    def warm_error(self, drift: Drift, temperature: float) -> float:
        """95 % bound of what `temperature` (degC) may change of a coefficient, m; 0 where it is known, or changes none.

        One that is not known is taken to be within the range of those of the maps.
        """
        if np.isfinite(temperature):
            return 0.0
        coefficients = np.abs(self.reduction.expand(drift.thermal[1:])[0])
        coefficients += np.abs(drift.thermal[0]) * np.abs(self._fit.influence_zernike).sum(axis=1)
        return float(drift.thermal_trust * drift.temperature_range * coefficients[PISTON_TILT:].max())

    def stuck_error(self, drift: Drift) -> float:
        """Bound of what actuators given up change of a coefficient since they creep on, m; 0 without a law of that."""
        return float((np.abs(self._fit.influence_zernike[PISTON_TILT:]) @ self._creeping_on(drift)).max())

    def _creeping_on(self, drift: Drift) -> Floats:
        """(N,) bound of the effective signal by which actuators given up creep on, 0 of the others."""
        return STUCK_DECADES * self._creep_law.creep_rate * np.nan_to_num(1.0 + np.abs(drift.stuck))

    def changed(self, drift: Drift, temperature: float = np.nan) -> InfluenceFit:
        """The influence function with gains and figure as far as what `drift` has found of them is borne out.

        Actuators that do not move have none: what they do where they stand is part of the figure.
        """
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
        freedom = max(len(used) - self._fit.actuators - 1, 1)
        return np.asarray(np.square(residual).sum(axis=0) / freedom)

    def _law_sigma(self, hysteresis: HysteresisFit) -> float:
        """Standard deviation of an effective signal that explains the held-out error of the coefficients."""
        count = self.reduction.coefficients
        reach = np.square(self._gain[:count]).sum()
        error = np.square(hysteresis.zernike_sigma[PISTON_TILT:] * TERM_RMS[PISTON_TILT : PISTON_TILT + count]).sum()
        return float(np.sqrt(error / reach))
