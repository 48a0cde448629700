"""The drift of a calibrated mirror, as estimated from later maps."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import cho_solve
from scipy.special import ndtri

from dm_common import Floats
from dm_common.errors import CHECK_ANOTHER_SHAPE
from dm_common.mirror import APERTURE_TOLERANCE, actuators_text
from dm_common.optics.zernike import PISTON_TILT
from dm_common.recipes import GOES_ON_WITHOUT
from dm_common.values import live_parameter, parameter, real, whole

#: Prior standard deviations of changes per K, valid until a map is taken at another temperature: relative change of all
#: gains, and change of the figure, m rms.
WARM_GAIN, WARM_FIGURE = 1e-3, 2e-9

#: Mean square of the surprise of a few maps that may be due to chance.
MISFIT_BY_CHANCE = 1.5
#: Least signal at which a weak actuator can be distinguished from a displaced one, and least move that is attributed to
#: an actuator without a response in the calibration; share of its move up to which one is called dead.
DISTINCT_SIGNAL, DEAD_SHARE = 0.1, 0.15
#: Least displacement, in effective signal, at which an actuator counts as failed: errors of the law can look like
#: displacements of up to 0.03.
FAILED_SIGNAL = 0.05
#: Least displacement, in effective signal, at which an actuator is named where the map agrees.
NOTICED = 0.01


@dataclass(frozen=True)
class UpdateOptions:
    """Which maps are used, and how far they may change the calibration.

    Attributes:
        gain_rate, figure_rate: standard deviations. Half of the variance of gains is common to all actuators.
        valid_fraction_min: least share of valid pixels.
        aperture_tolerance: largest relative deviation of a map's aperture radius from the calibration's.
        signal_sigma: standard deviation of an effective signal where no hysteresis model is identified, normalised.
    """

    surprise_max: float = live_parameter(
        real(3.0, 1.0, 100.0),
        "A map that differs from its prediction by more than this times the expected difference is not used.",
    )
    surprises_max: int = live_parameter(
        whole(3, 1, 1000), "Number of such maps in a row after which the mirror counts as changed."
    )
    gain_rate: float = parameter(
        real(3e-4, 0.0, 1.0),
        "Expected relative drift of a gain in one day; grows with the square root of time. 0 = gains do not drift.",
    )
    figure_rate: float = parameter(
        real(1e-9, 0.0, 1e-6, "m"),
        "Expected rms drift of the figure in one day; grows with the square root of time. 0 = it does not drift.",
    )
    valid_fraction_min: float = 0.5
    aperture_tolerance: float = APERTURE_TOLERANCE
    signal_sigma: float = 0.05


@dataclass(frozen=True, eq=False)
class Drift:
    """Drift of a mirror since its calibration, as estimated from later maps. Never changed in place.

    Attributes:
        gain: (N,) relative changes.
        offset: (R,) m rms, permanent change of the figure, in reduced values.
        thermal: (1 + R,) per K: relative change of all gains, and m rms, change of the figure in reduced values.
        crept: (R,) m rms, change of the figure by slow creep at `stamp_ns`, in reduced values; it fades.
        covariance: (N + 3 R + 1, N + 3 R + 1) of gain, offset, thermal and crept.
        stamp_ns: time for which these values hold.
        revision: number of maps used.
        checked_ns: latest stamp of these; 0 = none.
        surprising: number of the latest maps, in a row, that disagreed.
        disagreement: largest error (m) in these maps, or in other shapes by the faulty actuators that they show; if the
            last map agreed, that by actuators that may begin to fail.
        misfit: mean square of the surprise of maps that agreed, in which the last ones count most; 1 = as expected.
        evidence: (2, 2) sum of squares of the changes predicted for maps, in standard deviations, and sum of their
            products with the measured changes; first row: gain and figure, second row: changes by temperature.
        stuck: (N,) effective signals at which actuators are stuck; NaN = the actuator moves.
        failing: (N,) least effective signals, of either sign, at which maps would show that actuators fail, which
            earlier maps showed; of stuck ones, the signal at which they were found if they may only be weakened; NaN =
            the actuator follows its commands, or is surely stuck.
        temperatures: (3,) degC: reference for gain and offset, lowest and highest of the maps; NaN = not known.
    """

    gain: Floats
    offset: Floats
    thermal: Floats
    crept: Floats
    covariance: Floats
    stamp_ns: int
    stuck: Floats
    failing: Floats
    temperatures: Floats
    evidence: Floats = field(default_factory=lambda: np.zeros((2, 2)))
    revision: int = 0
    checked_ns: int = 0
    surprising: int = 0
    disagreement: float = 0.0
    misfit: float = 1.0

    @property
    def trust(self) -> float:
        """Share of the estimated gain and offset that maps not used for the estimate have confirmed, 0 to 1."""
        return _share(*self.evidence[0])

    @property
    def excess(self) -> float:
        """Factor by which the last maps differ more than expected and by more than chance (mean square), at least 1."""
        return max(1.0, self.misfit / MISFIT_BY_CHANCE)

    @property
    def thermal_trust(self) -> float:
        """The same for the changes by temperature."""
        return _share(*self.evidence[1])

    def warmer(self, temperature: float) -> float:
        """Temperature above the reference for gain and offset, K; 0 where not known."""
        above = temperature - float(self.temperatures[0])
        return above if np.isfinite(above) else 0.0

    @property
    def temperature_range(self) -> float:
        """Largest difference between maps and the reference for gain and offset, K; 0 where not known."""
        return float(np.nan_to_num(np.abs(self.temperatures - self.temperatures[0]).max()))

    def reached(self, effective: Floats) -> Floats:
        """Where the actuators stand when `effective` (N,) is commanded."""
        return np.where(np.isnan(self.stuck), effective, self.stuck)

    def fixed(self, stuck: Floats, effective: Floats, zernike: Floats) -> Self:
        """The same with actuators that stand at `stuck` (N,), NaN = moves, from a map at the signals `effective` on.

        One that stands between 0 and its signal may as well be weakened: then its next move makes an error. So may one
        that was given up before and now stands elsewhere. At a small signal every place within it is near 0.

        Args:
            zernike: (K, N) m per unit of effective signal.
        """
        signal, toward = np.abs(effective), stuck * np.sign(effective)
        share = np.divide(np.abs(stuck), signal, out=np.zeros_like(stuck), where=signal > 0.0)
        new = np.isnan(self.stuck) & np.isfinite(stuck)
        elsewhere = np.abs(stuck - self.stuck) >= FAILED_SIGNAL
        weak = (new | elsewhere) & (toward > np.where(signal < DISTINCT_SIGNAL, -signal, NOTICED)) & (share < 1.0)
        error = float((np.abs(zernike[PISTON_TILT:]) @ np.where(weak, share * (1.0 + signal), 0.0)).max())
        failing = np.where(weak, effective, np.where(new, np.nan, self.failing))
        return replace(self, stuck=stuck, failing=failing, disagreement=max(self.disagreement, error))

    def at_half(self, gain: Floats) -> Floats:
        """(K, N + R) effect of gain and offset on K reduced values, each at half of what it alone can reach.

        Args:
            gain: (K, N) per unit of effective signal.
        """
        alone = np.linalg.pinv(gain).T  # signals of each value alone
        half = 0.5 * alone / np.maximum(np.abs(alone).max(axis=1, keepdims=True), np.finfo(np.float64).tiny)
        return np.hstack((gain * half * np.isnan(self.stuck), np.eye(len(gain), len(self.offset))))

    @property
    def given_up(self) -> str:
        """Sentence on the actuators that no longer move and where they stand; "" = all move."""
        weak = np.where(np.isfinite(self.failing), f", if not only weakened: {CHECK_ANOTHER_SHAPE}", "")
        places = [
            f"{index + 1} (fixed at {at:+.2f}{weak[index]})" for index, at in enumerate(self.stuck) if np.isfinite(at)
        ]
        return f"{GOES_ON_WITHOUT} {actuators_text(places)}" if places else ""

    @property
    def largest_gain(self) -> tuple[float, int]:
        """The largest relative change of a gain as it is used, and the index of its actuator."""
        index = int(np.abs(self.gain).argmax())
        return self.trust * float(self.gain[index]), index

    def figures(self) -> dict[str, object]:
        """Figures for diagnostics, as they are used."""
        gain, actuator = self.largest_gain
        return {
            "gain_drift_percent": round(100.0 * gain, 4),
            "gain_drift_actuator": actuator + 1,
            "offset_drift_nm": round(self.offset_rms * 1e9, 3),
            "gain_per_kelvin_percent": round(100.0 * self.thermal_trust * float(self.thermal[0]), 4),
            "figure_per_kelvin_nm": round(1e9 * self.thermal_trust * float(np.linalg.norm(self.thermal[1:])), 3),
            "revision": self.revision,
        }

    @property
    def figure(self) -> Floats:
        """(R,) m rms, change of the figure, drift and creep together."""
        return self.offset + self.crept

    @property
    def offset_rms(self) -> float:
        """Change of the figure as it is used, m rms."""
        return self.trust * float(np.linalg.norm(self.figure))


class Displaced(NamedTuple):
    """A displaced actuator: its displacement in effective signal, and the probability that it is displaced.

    The alternatives are any other actuator, a change of one coefficient alone, and a map that is bad everywhere.
    """

    more: float
    probability: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """A map against its prediction.

    Attributes:
        max_zernike: m, largest difference of a coefficient beyond tilt from the calibration as it is used.
        rms: m rms of the difference in sag, piston and tilt removed.
        surprise: difference relative to its expected size, about 1 when all is well: the larger of the rms over all
            values and the largest single value relative to the largest expected among as many.
        displaced: by index, the worst first, the actuators that cause the difference, if a few of them (such as one
            that is stuck) explain it.
    """

    max_zernike: float
    rms: float
    surprise: float
    updated: Drift
    displaced: dict[int, Displaced]


def surprise_of(innovation: Floats, expected: Floats, factor: tuple[Floats, bool]) -> float:
    """Size of `innovation` (R,) relative to that by its `expected` covariance (R, R), with Cholesky factor `factor`."""
    size = len(innovation)
    together = np.sqrt(innovation @ cho_solve(factor, innovation) / size)
    # Median of the largest absolute value of `size` normal numbers.
    largest = -ndtri(0.5 * (1.0 - 0.5 ** (1.0 / size)))
    single = np.abs(innovation / np.sqrt(np.diag(expected))).max() / largest
    return float(max(together, single))


def _share(predicted: float, borne_out: float) -> float:
    """The positive-part estimate of a regression through the origin, less one standard error."""
    return float(np.clip((borne_out - np.sqrt(predicted)) / predicted, 0.0, 1.0)) if predicted > 0.0 else 0.0
