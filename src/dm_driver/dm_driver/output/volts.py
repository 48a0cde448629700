"""From the normalised signal to the DAC code and back: signal - actuator volts - DAC volts - code.

Signal -1 is `volts_min` at the actuator, +1 is `volts_max`, and between them the volts are linear in the signal (the
vendor's code = max_code (u + 1) / 2 holds when that range is the DAC's whole range), or their square is: electrodes
attract a membrane with the square of the voltage. The amplifier divides by its gain to DAC volts, and the DAC is linear
between its voltages at code 0 and at full scale.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dm_common import Floats

#: Fewer codes than this between signal -1 and +1 are taken for a mistake in the configuration.
MIN_CODES = 100
_CODE_SLACK = 1e-6

LINEAR: Final = "linear"
SQUARE: Final = "square"
#: Laws of the drive: the power of the volts that is linear in the signal.
LAWS: Final = {LINEAR: 1, SQUARE: 2}


@dataclass(frozen=True)
class VoltScale:
    """The voltages of one drive unit, amplifier and mirror.

    Attributes:
        max_code: DAC code of full scale.
        dac_volts_at_zero: V at the DAC output for code 0.
        dac_volts_at_full: V at the DAC output for `max_code`.
        amplifier_gain: V at the actuator per V at the DAC.
        volts_min: V at the actuator for signal -1.
        volts_max: V at the actuator for signal +1.
        law: one of `LAWS`.

    Raises:
        ValueError: the values contradict each other; the message names the driver's parameters.
    """

    max_code: int
    dac_volts_at_zero: float
    dac_volts_at_full: float
    amplifier_gain: float
    volts_min: float
    volts_max: float
    law: str = LINEAR

    def __post_init__(self) -> None:
        if self.dac_volts_at_zero == self.dac_volts_at_full:
            raise ValueError(
                f"volts.dac_at_zero = volts.dac_at_full = {self.dac_volts_at_zero:g} V: must differ, else no code"
                " changes the output"
            )
        if self.amplifier_gain == 0.0:
            raise ValueError("volts.amplifier_gain = 0: must not be zero")
        if not self.volts_max > self.volts_min:
            raise ValueError(f"volts.max = {self.volts_max:g} V: must be above volts.min = {self.volts_min:g} V")
        if self.law == SQUARE and self.volts_min < 0.0:
            raise ValueError(f"volts.min = {self.volts_min:g} V: must be at least 0 with drive.law = {SQUARE!r}")
        low, high = sorted((self.dac_volts_at_zero, self.dac_volts_at_full))
        slack = 1e-9 * (high - low)
        for name, value in (("volts.min", self.volts_min), ("volts.max", self.volts_max)):
            needed = value / self.amplifier_gain
            if not low - slack <= needed <= high + slack:
                reach = sorted((low * self.amplifier_gain, high * self.amplifier_gain))
                raise ValueError(
                    f"{name} = {value:g} V needs {needed:g} V at the DAC, which reaches {low:g} to {high:g} V;"
                    f" with volts.amplifier_gain = {self.amplifier_gain:g} it must be {reach[0]:g} to {reach[1]:g} V"
                )
        codes = self._code_range[1] - self._code_range[0] + 1
        if codes < MIN_CODES:
            raise ValueError(
                f"volts.min to volts.max ({self.volts_min:g} to {self.volts_max:g} V) spans only {codes} of"
                f" {self.max_code} codes: must be at least {MIN_CODES}; check volts.amplifier_gain ="
                f" {self.amplifier_gain:g}"
            )

    def volts(self, signals: Floats) -> Floats:
        """Actuator volts of normalised signals."""
        low, span = self._powers
        return np.asarray((low + (signals + 1.0) * (0.5 * span)) ** (1.0 / LAWS[self.law]), dtype=np.float64)

    def codes(self, signals: Floats) -> NDArray[np.uint16]:
        """Nearest codes of normalised signals; never one whose voltage lies outside volts_min..volts_max.

        Raises:
            ValueError: a signal is not finite or outside -1..+1.
        """
        if not bool((np.abs(signals) <= 1.0).all()):  # also false for NaN
            raise ValueError(f"signals = {signals}: must be finite and in -1 to 1")
        return np.clip(np.rint(self.exact_codes(signals)), *self._code_range).astype(np.uint16)

    def exact_codes(self, signals: Floats) -> Floats:
        """Codes of normalised signals, not rounded."""
        dac_volts = self.volts(signals) / self.amplifier_gain
        return np.asarray((dac_volts - self.dac_volts_at_zero) * (self.max_code / self._dac_span), dtype=np.float64)

    def signals_of_codes(self, codes: NDArray[np.uint16 | np.float64]) -> Floats:
        """Normalised signals at the actuators for these codes."""
        low, span = self._powers
        return np.asarray((self.volts_of_codes(codes) ** LAWS[self.law] - low) * (2.0 / span) - 1.0, dtype=np.float64)

    def volts_of_codes(self, codes: NDArray[np.uint16 | np.float64]) -> Floats:
        """Actuator volts for these codes."""
        dac_volts = self.dac_volts_at_zero + codes * (self._dac_span / self.max_code)
        return np.asarray(dac_volts * self.amplifier_gain, dtype=np.float64)

    @property
    def signal_at_zero(self) -> float:
        """Signal at which an actuator is at 0 V, or as near to it as volts_min..volts_max allows."""
        low, span = self._powers
        return min(max(-1.0 - 2.0 * low / span, -1.0), 1.0)

    @property
    def resolution(self) -> float:
        """Normalised signal step of the last code, which is the largest; quantisation moves no signal inside the range
        by more than half of it.
        """
        volts_per_code = abs(self._dac_span * self.amplifier_gain) / self.max_code
        power = LAWS[self.law]
        return 2.0 * power * self.volts_max ** (power - 1) * volts_per_code / self._powers[1]

    @property
    def _powers(self) -> tuple[float, float]:
        """The quantity that is linear in the signal: its value at signal -1, and its change from -1 to +1."""
        low = self.volts_min ** LAWS[self.law]
        return low, self.volts_max ** LAWS[self.law] - low

    @property
    def _dac_span(self) -> float:
        return self.dac_volts_at_full - self.dac_volts_at_zero

    @cached_property
    def _code_range(self) -> tuple[int, int]:
        """Smallest and largest code inside volts_min..volts_max."""
        ends = np.sort(self.exact_codes(np.array([-1.0, 1.0])))
        return math.ceil(ends[0] - _CODE_SLACK), math.floor(ends[1] + _CODE_SLACK)
