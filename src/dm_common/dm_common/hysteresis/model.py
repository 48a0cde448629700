"""The law of hysteresis and creep of the actuators, and the state of a mirror under it.

Every actuator follows an *effective signal*; sag and coefficients are linear in it, and the influence function holds
the gains. Signals are normalised; in a slow full cycle over the run's range, effective signals span as much as signals.

* Hysteresis: a sum of polynomials in the values of play operators p_r of half-width r. With first powers only it is
  the Prandtl-Ishlinskii model ([16], section 2.4). Higher powers make it a Preisach operator with a learned density
  over centre and half-width of the relays: of the relays of half-width r, those centred below p_r are up (ibid.).
  Half-width 0 is the signal itself: the loading curve.
* Optionally Duhem operators (:mod:`~dm_common.hysteresis.duhem`), for hysteresis that fades.
* Creep: first-order elements, evenly spaced over the logarithm of time, follow the static part. Together they grow by
  `creep_rate` of a step per decade [17, 18]; a spectrum weights them individually. The first elements also follow the
  signal, with a spectrum of their own: loops may lag or creep differently from the straight part and thus be wider for
  fast moves. The size of creep may change linearly over the range.

The weights are common to all actuators, or each actuator has its own. The result does not depend on how a straight move
is divided into steps, so only turning points have to be known.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from dm_common import Floats
from dm_common.hysteresis.duhem import NO_DRIVE, NONE, FadingHysteresis, horner

#: Time constants of creep, s: from the shortest dwell to more than a day, two per decade.
CREEP_TIMES = np.geomspace(0.03, 3e5, 15)
#: Largest creep that a law may have, as a share of a step per decade of time.
CREEP_RATE_MAX = 0.2
#: Assumed ratio of the errors of requests to those of held-out moves of the calibration. Held-out moves follow each
#: other within seconds; requests are held for longer, and their errors are 1.2 to 2.6 times as large.
REQUEST_ERROR_RATIO = 1.4


class HeldOut(Protocol):
    """What tells the 95 % bound on the largest coefficient error of maps that were not used in the fit, m."""

    @property
    def held_out_max_zernike(self) -> float: ...


def request_error(static: HeldOut, moves: HeldOut | None) -> float:
    """95 % bound on the largest coefficient error of a request, without creep, m.

    Args:
        static: influence function and figure.
        moves: law of hysteresis and creep; None = there is none.
    """
    return float(static.held_out_max_zernike if moves is None else REQUEST_ERROR_RATIO * moves.held_out_max_zernike)


@dataclass(frozen=True, eq=False)
class HysteresisState:
    """State of the actuators, with their memory of past signals. Never changed in place.

    Attributes:
        time: s, of the clock that commands are stamped with.
        signals: (N,) as applied.
        play: (N, R) values of the play operators.
        fading: (N, Z) of the Duhem operators.
        position: (N,) static effective signal: hysteresis without creep.
        crept: (N, J) states of the creep elements: static effective signals, low-pass filtered.
        crept_sigma: (J,) standard deviation of `crept`, as a share of a full-range shape; 0 if all was observed.
        lagged: (N, L) states of the elements that follow the signals: signals, low-pass filtered.
    """

    time: float
    signals: Floats
    play: Floats
    fading: Floats
    position: Floats
    crept: Floats
    crept_sigma: Floats
    lagged: Floats


@dataclass(frozen=True, eq=False)
class HysteresisModel:
    """The law of the actuators of a mirror; gains are in the influence function.

    Attributes:
        play_radius: (R,) half-widths, normalised; 0 = the signal itself.
        play_weight: (R, D) weights of the powers 1 .. D of each play operator's value, or (N, R, D) for each actuator.
        duhem_slope: (A,) of the Duhem operator, or (N, 2, A): for each actuator, rising and falling; empty = none.
        duhem_weight: () or (N,) of the Duhem operator's value.
        fading_rate: (K,) decay per unit of signal travelled, of the linear Duhem operators; empty = none.
        fading_weight: (K, P) or (N, K, P) weights of those that follow the powers 0 .. P - 1 of the signal.
        creep_rate: growth of a step per decade of time, in the mean over actuators and elements.
        creep_time: (J,) s, evenly spaced over the logarithm; empty = no creep.
        creep_spectrum: (J,) or (N, J) weight of each creep element relative to an even spectrum; empty = even.
        crept_at, crept: time (s) just before the maps of the calibration, and (N,) effective signals to which the
            actuators had crept by then: the figure is relative to that state. Empty = not known.
        creep_covariance: (2, 1 + J, 1 + J) of the errors in the weights of `position` and of the creep elements: first
            of errors common to all actuators, then of errors of each one. Empty = not known.
        lag_spectrum: (L,) or (N, L) weight of each of the first L elements in following the signal, relative to an even
            spectrum; empty = none.
        creep_slope: relative change of creep per unit of `position`.

    Raises:
        ValueError: shapes, numbers that are not finite, or a law that cannot be inverted, naming the field.
    """

    play_radius: Floats
    play_weight: Floats
    duhem_slope: Floats
    duhem_weight: float | Floats
    creep_rate: float
    creep_time: Floats
    creep_spectrum: Floats = field(default_factory=lambda: NONE)
    crept_at: float = 0.0
    crept: Floats = field(default_factory=lambda: NONE)
    creep_covariance: Floats = field(default_factory=lambda: NONE)
    lag_spectrum: Floats = field(default_factory=lambda: NONE)
    creep_slope: float = 0.0
    fading_rate: Floats = field(default_factory=lambda: NONE)
    fading_weight: Floats = field(default_factory=lambda: NO_DRIVE)

    def __post_init__(self) -> None:
        if self.play_radius.ndim != 1 or not self.play_radius.size:
            raise ValueError(f"play_radius has the shape {self.play_radius.shape}: must be a list of half-widths")
        for name, rows in (("play_weight", len(self.play_radius)), ("fading_weight", len(self.fading_rate))):
            shape = getattr(self, name).shape
            if len(shape) not in (2, 3) or shape[-2] != rows:
                raise ValueError(f"{name} has the shape {shape}: must be {rows} rows")
        count = len(self.creep_time)
        if self.creep_spectrum.size and self.creep_spectrum.shape[-1] != count:
            raise ValueError(f"creep_spectrum has the shape {self.creep_spectrum.shape}: must be {count} columns")
        if self.lag_spectrum.size and self.lag_spectrum.shape[-1] > count:
            raise ValueError(f"lag_spectrum has the shape {self.lag_spectrum.shape}: must be at most {count} columns")
        expected = (2, 1 + count, 1 + count)
        if self.creep_covariance.size and self.creep_covariance.shape != expected:
            raise ValueError(f"creep_covariance has the shape {self.creep_covariance.shape}: must be {expected}")
        if len({shape for shape in self._own if shape}) > 1:
            names = "play_weight, duhem_slope, duhem_weight, fading_weight, creep_spectrum, lag_spectrum"
            raise ValueError(f"{names}: have the shapes {self._own}: must be one shape, or () for all actuators")
        for name in (item.name for item in fields(self)):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} holds values that are not finite")
        if (self.play_radius < 0.0).any():
            raise ValueError(f"play_radius = {self.play_radius.min():g}: must not be negative")
        if not 0.0 <= self.creep_rate <= CREEP_RATE_MAX:
            raise ValueError(f"creep_rate = {self.creep_rate:g} per decade: must be 0 to {CREEP_RATE_MAX:g}")
        for name in ("creep_time", "fading_rate"):
            if (getattr(self, name) <= 0.0).any():
                raise ValueError(f"{name} = {getattr(self, name).min():g}: must be positive")

    @classmethod
    def linear(cls, creep_rate: float = 0.0) -> HysteresisModel:
        """No hysteresis: apart from creep of `creep_rate` per decade the effective signal is the signal."""
        return cls(np.zeros(1), np.ones((1, 1)), NONE, 0.0, creep_rate, CREEP_TIMES if creep_rate else NONE)

    @cached_property
    def has_history(self) -> bool:
        """Whether the effective signal depends on anything but the signal."""
        return bool((self.play_radius > 0.0).any()) or self.fading.size > 0 or self.creep_rate > 0.0

    @cached_property
    def is_identity(self) -> bool:
        """Whether the effective signal is the signal."""
        return not self.has_history and self.play_weight.shape[-1] == 1 and bool((self.play_weight == 1.0).all())

    def same_as(self, other: HysteresisModel) -> bool:
        """Whether two laws are the same, number for number."""
        names = (item.name for item in fields(self))
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)

    @cached_property
    def fading(self) -> FadingHysteresis:
        """Contribution of Duhem operators, of which there may be none."""
        return FadingHysteresis(self.duhem_slope, self.duhem_weight, self.fading_rate, self.fading_weight)

    @cached_property
    def creep_share(self) -> Floats:
        """(J,) or (N, J) weight of each creep element; zeros without creep."""
        count = len(self.creep_time)
        return np.asarray(self._even * (self.creep_spectrum if self.creep_spectrum.size else np.ones(count)))

    @cached_property
    def lag_share(self) -> Floats:
        """(L,) or (N, L) weight of each element that follows the signals."""
        return np.asarray(self._even * self.lag_spectrum)

    @property
    def _even(self) -> float:
        """Weight of each element of an even spectrum; 0 without creep."""
        time = self.creep_time
        return self.creep_rate * float(np.log10(time[-1] / time[0])) / (len(time) - 1) if len(time) > 1 else 0.0

    @property
    def lag_time(self) -> Floats:
        """(L,) s, of the elements that follow the signals."""
        return self.creep_time[: self.lag_spectrum.shape[-1]]

    @property
    def actuators(self) -> int:
        """Number of actuators that have laws of their own; 0 = one law for any number of them."""
        return max(shape[0] if shape else 0 for shape in self._own)

    @property
    def _own(self) -> tuple[tuple[int, ...], ...]:
        duhem = self.duhem_slope.shape[:-2], np.shape(self.duhem_weight), self.fading_weight.shape[:-2]
        return self.play_weight.shape[:-2], *duhem, self.creep_spectrum.shape[:-1], self.lag_spectrum.shape[:-1]

    # --- states ---

    def demagnetised(self, actuators: int, time: float, middle: float = 0.0) -> HysteresisState:
        """The state after a degauss that ended at `middle`, with creep fully settled there."""
        play = np.full((actuators, len(self.play_radius)), middle)
        fading = np.zeros((actuators, self.fading.size))
        position, elements = self._position(play, fading), len(self.creep_time)
        crept = np.repeat(position[:, None], elements, axis=1)
        lagged = np.full((actuators, len(self.lag_time)), middle)
        signals = np.full(actuators, middle)
        return HysteresisState(time, signals, play, fading, position, crept, np.zeros(elements), lagged)

    def degaussed(self, state: HysteresisState, time: float, middle: float = 0.0) -> HysteresisState:
        """The state after a degauss that ended at `middle`; creep still remembers earlier shapes."""
        waited = self.advance(state, time)
        fresh = self.demagnetised(len(state.signals), waited.time, middle)
        return replace(fresh, crept=waited.crept, crept_sigma=waited.crept_sigma, lagged=waited.lagged)

    def advance(self, state: HysteresisState, time: float) -> HysteresisState:
        """The state at a later time (s), with the signals unchanged. An earlier time changes nothing."""
        elapsed = time - state.time
        if not elapsed > 0.0:
            return state
        if not self.creep_rate:
            return replace(state, time=time)
        rest = np.exp(-elapsed / self.creep_time)
        crept = state.position[:, None] + (state.crept - state.position[:, None]) * rest
        lagged = state.signals[:, None] + (state.lagged - state.signals[:, None]) * rest[: state.lagged.shape[1]]
        return replace(state, time=time, crept=crept, crept_sigma=state.crept_sigma * rest, lagged=lagged)

    def move(self, state: HysteresisState, signals: Floats, time: float) -> HysteresisState:
        """Wait until `time` (s), then move straight to `signals` (N,)."""
        state = self.advance(state, time)
        play, fading = self._moved(state, signals)
        return replace(state, signals=signals, play=play, fading=fading, position=self._position(play, fading))

    def effective(self, state: HysteresisState) -> Floats:
        """(N,) effective signal, hysteresis and creep."""
        return np.asarray(state.position + self.creep(state))

    def creep(self, state: HysteresisState) -> Floats:
        """(N,) the part of the effective signal that changes by itself."""
        creep = (self.creep_share * state.crept).sum(axis=1) + (self.lag_share * state.lagged).sum(axis=1)
        return np.asarray((1.0 + self.creep_slope * state.position) * creep)

    def creep_ahead(self, state: HysteresisState, ahead: float) -> tuple[Floats, Floats, Floats]:
        """Creep after `ahead` s: remainder of the present creep, weights of static effective signals and of signals."""
        rest = np.exp(-ahead / self.creep_time)
        lag_rest = rest[: self.lag_spectrum.shape[-1]]
        faded = (self.creep_share * state.crept) @ rest + (self.lag_share * state.lagged) @ lag_rest
        return faded, self.creep_share @ (1.0 - rest), self.lag_share @ (1.0 - lag_rest)

    def static_of(self, effective: Floats, grown: Floats, faded: Floats) -> Floats:
        """(N,) static effective signals p that solve `effective` (N,) = p + (1 + creep_slope p) (grown p + faded)."""
        slope, rest = self.creep_slope, effective - faded
        linear = 1.0 + grown + slope * faded
        return np.asarray(2.0 * rest / (linear + np.sqrt(np.maximum(linear**2 + 4.0 * slope * grown * rest, 0.0))))

    def effective_at(self, state: HysteresisState, signals: Floats, ahead: float) -> Floats:
        """(N,) effective signal `ahead` s after a straight move from `state` to `signals` (N,)."""
        moved = replace(state, signals=signals, position=self.position_at(state, signals))
        return self.effective(self.advance(moved, state.time + ahead))

    def position_at(self, state: HysteresisState, signals: Floats) -> Floats:
        """(N,) static effective signal that a straight move from `state` to `signals` (N,) would lead to."""
        return self._position(*self._moved(state, signals))

    def _moved(self, state: HysteresisState, signals: Floats) -> tuple[Floats, Floats]:
        column = signals[:, None]
        # Faster than np.clip for arrays of this size.
        play = np.minimum(np.maximum(state.play, column - self.play_radius), column + self.play_radius)
        return play, self.fading.move(state.fading, state.signals, signals)

    def _position(self, play: Floats, fading: Floats) -> Floats:
        total = (horner(np.moveaxis(self.play_weight, -1, 0), play) * play).sum(axis=1)
        return np.asarray(total + self.fading.value(fading))

    def scaled(self, factor: float | Floats) -> HysteresisModel:
        """The same law with effective signals `factor` times as large, a number or (N,)."""
        factors = np.asarray(factor, dtype=np.float64)
        if factors.shape == (1,):
            factors = factors[0]
        duhem = factors * self.duhem_weight if self.duhem_slope.size else self.duhem_weight
        return replace(
            self,
            play_weight=factors[..., None, None] * self.play_weight,
            duhem_weight=duhem,
            fading_weight=factors[..., None, None] * self.fading_weight,
            crept=factors * self.crept if self.crept.size else self.crept,
            lag_spectrum=factors[..., None] * self.lag_spectrum if self.lag_spectrum.size else self.lag_spectrum,
            creep_slope=self.creep_slope / float(np.mean(factors)),
        )
