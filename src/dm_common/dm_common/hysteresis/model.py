"""The law by which actuators remember, and the state of a mirror under it.

Every actuator follows an *effective signal*; sag and coefficients are linear in it, and the influence function holds
the gains. Signals are normalised, so is the effective signal: it spans 2 over a slow full cycle of -1 .. +1.

* Hysteresis: a sum over play operators p_r of half-width r of polynomials in their values. With first powers it is the
  Prandtl-Ishlinskii model ([16], section 2.4); higher powers make
  it a Preisach operator whose density over centre and half-width of the relays is learned: the relays
  of half-width r that are up are those centred below p_r (ibid.). Half-width 0 is the signal itself: the loading curve.
* Optionally a :class:`~dm_common.hysteresis.duhem.DuhemOperator`, for hysteresis that fades.
* Creep: the static part is followed by first-order elements evenly spaced over the logarithm of time, which together
  grow by `creep_rate` of a step per decade [17, 18]; a spectrum says how much more or less each of them does.

The weights are those of all actuators, or each actuator has its own.

Nothing here depends on how a straight way is cut into steps, so only turning points have to be known.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dm_common.hysteresis.creep_record import CreepRecord
from dm_common.hysteresis.duhem import DuhemOperator

Floats = NDArray[np.float64]

#: Time constants of creep, s: from the shortest dwell to more than a day, two per decade.
CREEP_TIMES = np.geomspace(0.03, 3e5, 15)
#: Standard deviation of a shape that was held unseen, in shapes of the whole range.
UNSEEN = 0.5


@dataclass(frozen=True, eq=False)
class HysteresisState:
    """Where the actuators stand, with all they remember. Never changed in place.

    Attributes:
        time: s, of the clock that commands are stamped with.
        signals: (N,) as applied.
        play: (N, R) values of the play operators.
        fading: (N,) of the Duhem operator.
        position: (N,) static effective signal: hysteresis without creep.
        crept: (N, J) what the creep elements have followed so far.
        crept_sigma: (J,) its standard deviation, in shapes of the whole range: 0 but where some were held unseen.
    """

    time: float
    signals: Floats
    play: Floats
    fading: Floats
    position: Floats
    crept: Floats
    crept_sigma: Floats


@dataclass(frozen=True, eq=False)
class HysteresisModel:
    """The law of the actuators of a mirror; gains are in the influence function.

    Attributes:
        play_radius: (R,) half-widths, normalised; 0 = the signal itself.
        play_weight: (R, D) weights of the powers 1 .. D of each play operator's value, or (N, R, D) for each actuator.
        duhem_slope: (A,) of the Duhem operator, or (N, 2, A) of each actuator, rising and falling; empty = none.
        duhem_weight: () or (N,) of the Duhem operator's value.
        creep_rate: growth of a step per decade of time, in the mean over actuators and elements.
        creep_time: (J,) s, evenly spaced over the logarithm; empty = no creep.
        creep_spectrum: (J,) or (N, J) weight of each creep element relative to an even spectrum; empty = even.
        crept_at, crept: s, and (N,) effective signals that the actuators had crept to by then, just before the maps of
            the calibration: its figure is relative to that. Empty = not told.
        creep_covariance: (2, 1 + J, 1 + J) of the errors of the weights of `position` and of the creep elements: those
            that all actuators share, and those of each by itself. Empty = not told.

    Raises:
        ValueError: shapes, numbers that are not finite, or a law that cannot be inverted, naming the field.
    """

    play_radius: Floats
    play_weight: Floats
    duhem_slope: Floats
    duhem_weight: float | Floats
    creep_rate: float
    creep_time: Floats
    creep_spectrum: Floats = field(default_factory=lambda: np.zeros(0))
    crept_at: float = 0.0
    crept: Floats = field(default_factory=lambda: np.zeros(0))
    creep_covariance: Floats = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.play_radius.ndim != 1 or not self.play_radius.size:
            raise ValueError(f"play_radius has the shape {self.play_radius.shape}: must be a list of half-widths")
        if self.play_weight.ndim not in (2, 3) or self.play_weight.shape[-2] != len(self.play_radius):
            raise ValueError(
                f"play_weight has the shape {self.play_weight.shape}: must be {len(self.play_radius)} rows"
            )
        if self.creep_spectrum.size and self.creep_spectrum.shape[-1] != len(self.creep_time):
            raise ValueError(
                f"creep_spectrum has the shape {self.creep_spectrum.shape}: must be {len(self.creep_time)} columns"
            )
        expected = (2, 1 + len(self.creep_time), 1 + len(self.creep_time))
        if self.creep_covariance.size and self.creep_covariance.shape != expected:
            raise ValueError(f"creep_covariance has the shape {self.creep_covariance.shape}: must be {expected}")
        if len({shape for shape in self._own if shape}) > 1:
            raise ValueError(f"play_weight, duhem_slope, duhem_weight, creep_spectrum: of {self._own} actuators")
        for name in (item.name for item in fields(self)):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} holds values that are not finite")
        if (self.play_radius < 0.0).any():
            raise ValueError(f"play_radius = {self.play_radius.min():g}: must not be negative")
        if not 0.0 <= self.creep_rate <= 0.2:
            raise ValueError(f"creep_rate = {self.creep_rate:g} per decade: must be 0 to 0.2")
        if (self.creep_time <= 0.0).any():
            raise ValueError(f"creep_time = {self.creep_time.min():g} s: must be positive")

    @classmethod
    def linear(cls, creep_rate: float = 0.0) -> HysteresisModel:
        """No hysteresis: but for creep of so much per decade the effective signal is the signal."""
        none = np.zeros(0)
        return cls(np.zeros(1), np.ones((1, 1)), none, 0.0, creep_rate, CREEP_TIMES if creep_rate else none)

    @cached_property
    def remembers(self) -> bool:
        """Whether the effective signal depends on anything but the signal."""
        return bool((self.play_radius > 0.0).any()) or bool(self.duhem_slope.size) or self.creep_rate > 0.0

    @cached_property
    def is_identity(self) -> bool:
        """Whether the effective signal is the signal."""
        return not self.remembers and self.play_weight.shape[-1] == 1 and bool((self.play_weight == 1.0).all())

    def same_as(self, other: HysteresisModel) -> bool:
        """Whether two laws are the same, number for number."""
        names = (item.name for item in fields(self))
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)

    @cached_property
    def _duhem(self) -> DuhemOperator | None:
        return DuhemOperator(self.duhem_slope) if self.duhem_slope.size else None

    @cached_property
    def creep_share(self) -> Floats:
        """(J,) or (N, J) weight of each creep element; zeros without creep."""
        count = len(self.creep_time)
        if count < 2:
            return np.zeros(count)
        even = self.creep_rate * np.log10(self.creep_time[-1] / self.creep_time[0]) / (count - 1)
        return np.asarray(even * (self.creep_spectrum if self.creep_spectrum.size else np.ones(count)))

    @property
    def actuators(self) -> int:
        """Number of actuators that have laws of their own; 0 = one law for any number of them."""
        return max(shape[0] if shape else 0 for shape in self._own)

    @property
    def _own(self) -> tuple[tuple[int, ...], ...]:
        slope = self.duhem_slope.shape[:-2]
        return self.play_weight.shape[:-2], slope, np.shape(self.duhem_weight), self.creep_spectrum.shape[:-1]

    # --- states ---

    def demagnetised(self, actuators: int, time: float, middle: float = 0.0) -> HysteresisState:
        """The state after a degauss that ended at `middle`, long rested there."""
        play = np.full((actuators, len(self.play_radius)), middle)
        none, crept = np.zeros(actuators), np.zeros((actuators, len(self.creep_time)))
        state = HysteresisState(time, np.full(actuators, middle), play, none, none, crept, crept.sum(axis=0))
        position = self._position(play, state.fading)
        return replace(state, position=position, crept=np.repeat(position[:, None], len(self.creep_time), axis=1))

    def degaussed(self, state: HysteresisState, time: float, middle: float = 0.0) -> HysteresisState:
        """The state after a degauss that ended at `middle`; creep remembers what was before."""
        waited = self.advance(state, time)
        fresh = self.demagnetised(len(state.signals), waited.time, middle)
        return replace(fresh, crept=waited.crept, crept_sigma=waited.crept_sigma)

    def rested(
        self, signals: Floats, time: float, middle: float = 0.0, record: CreepRecord | None = None
    ) -> HysteresisState:
        """The state at `time` (s) of a mirror that stands at `signals` (N,), if it has stood there since it was known.

        That is since `record`, or since a calibration. Elements slower than that is ago hold what they held then; what
        was held meanwhile is in doubt.
        """
        moved = self.move(self.demagnetised(len(signals), time, middle), signals, time)
        settled = np.repeat(moved.position[:, None], len(self.creep_time), axis=1)
        sigma = np.full(len(self.creep_time), UNSEEN)
        if record is None or record.time > time or not np.array_equal(record.creep_time, self.creep_time):
            held = np.repeat(self.crept[:, None], len(self.creep_time), axis=1)
            record = CreepRecord(self.crept_at, self.creep_time, held, np.zeros(len(self.creep_time)))
        if record.crept.shape == settled.shape and time >= record.time:
            left = np.exp(-(time - record.time) / self.creep_time)
            settled += (record.crept - settled) * left
            sigma = np.hypot(sigma * (1.0 - left), record.crept_sigma * left)
        return replace(moved, crept=settled, crept_sigma=sigma)

    def advance(self, state: HysteresisState, time: float) -> HysteresisState:
        """The same signals at a later time (s). A time before the state's is taken as the state's."""
        elapsed = time - state.time
        if not elapsed > 0.0:
            return state
        if not self.creep_rate:
            return replace(state, time=time)
        rest = np.exp(-elapsed / self.creep_time)
        crept = state.position[:, None] + (state.crept - state.position[:, None]) * rest
        return replace(state, time=time, crept=crept, crept_sigma=state.crept_sigma * rest)

    def move(self, state: HysteresisState, signals: Floats, time: float) -> HysteresisState:
        """Wait until `time` (s), then go to `signals` (N,) on a straight way."""
        state = self.advance(state, time)
        play, fading = self._moved(state, signals)
        return replace(state, signals=signals, play=play, fading=fading, position=self._position(play, fading))

    def effective(self, state: HysteresisState) -> Floats:
        """(N,) effective signal, hysteresis and creep."""
        return np.asarray(state.position + self.creep(state))

    def creep(self, state: HysteresisState) -> Floats:
        """(N,) the part of the effective signal that changes by itself."""
        return np.asarray((self.creep_share * state.crept).sum(axis=1))

    def position_for(self, state: HysteresisState, effective: Floats, ahead: float = 0.0) -> Floats:
        """(N,) static effective signals that, taken at the state's time, become `effective` (N,) `ahead` s later."""
        rest = np.exp(-ahead / self.creep_time)
        faded = (self.creep_share * state.crept) @ rest
        return np.asarray((effective - faded) / (1.0 + self.creep_share @ (1.0 - rest)))

    def position_at(self, state: HysteresisState, signals: Floats) -> Floats:
        """(N,) static effective signal that a straight move from `state` to `signals` (N,) would lead to."""
        return self._position(*self._moved(state, signals))

    def _moved(self, state: HysteresisState, signals: Floats) -> tuple[Floats, Floats]:
        column = signals[:, None]
        # Faster than np.clip for arrays of this size.
        play = np.minimum(np.maximum(state.play, column - self.play_radius), column + self.play_radius)
        if self._duhem is None:
            return play, state.fading
        return play, self._duhem.move(state.fading, signals - state.signals)

    def _position(self, play: Floats, fading: Floats) -> Floats:
        powers = self.play_weight.shape[-1]
        total = play * self.play_weight[..., powers - 1]
        for power in range(powers - 2, -1, -1):  # Horner: ((w3 p + w2) p + w1) p
            total = (total + self.play_weight[..., power]) * play
        result = total.sum(axis=1)
        if self._duhem is not None:
            result = result + self.duhem_weight * fading
        return np.asarray(result)

    # --- what can be inverted ---

    def slope_min(self, low: float = -1.0, high: float = 1.0) -> float:
        """Smallest slope of the effective signal over signals of `low` .. `high`, on any way.

        After a turn the operators set in one by one, narrow ones first; what has set in follows the signal at a
        distance of its half-width. Those of half-width r have set in only where the turn can lie 2 r behind.
        """
        order = np.argsort(self.play_radius)
        radius, weight = self.play_radius[order], self.play_weight[..., order, :]
        signal, way = np.linspace(low, high, 201)[:, None], np.array([1.0, -1.0])[:, None, None]
        behind = np.where(way > 0.0, signal - low, high - signal)
        value = signal - way * radius
        weight = weight[..., None, None, :, :]  # a row for each way and signal
        slope = np.zeros(np.broadcast_shapes(value.shape, weight.shape[:-1]))
        for power in range(weight.shape[-1], 0, -1):
            slope = slope * value + power * weight[..., power - 1]
        slope = np.where(2.0 * radius <= behind, slope, 0.0)
        smallest = np.cumsum(slope, axis=-1).min(axis=(-3, -2, -1))
        if self._duhem is not None:
            least, most = self._duhem.slope_range
            smallest = smallest + np.minimum(self.duhem_weight * least, self.duhem_weight * most)
        return float(np.min(smallest))

    def span(self) -> Floats:
        """Effective signal at +1 less that at -1 in a full cycle that closes, of each law: (1,) or (N,)."""
        count = self.actuators or 1
        state = self.demagnetised(count, 0.0)
        for turn in (1.0, -1.0, 1.0, -1.0):
            state = self.move(state, np.full(count, turn), 0.0)
        low = state.position
        return np.asarray(self.move(state, np.ones(count), 0.0).position - low)

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
            crept=factors * self.crept if self.crept.size else self.crept,
        )
