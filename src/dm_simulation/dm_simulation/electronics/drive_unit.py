"""The drive electronics behind the wire: DAC registers, output stage, amplifier, cables to the actuators."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dm_common.values import parameter, real, whole
from dm_simulation.electronics import frames
from dm_simulation.mirror.zernike import Array

#: Actuator 1..37 of a PDM30-37 (trihex) -> connector channel, 0-based.
TRIHEX = (
    *(14, 16, 38, 23, 26, 1, 8, 10, 13, 37, 18, 36, 25, 28, 22, 7, 5, 2, 6),
    *(19, 17, 32, 15, 11, 35, 34, 39, 33, 31, 21, 27, 29, 24, 9, 3, 4, 12),
)
EDAC40_FULL_SCALE = 65535
FACTORY_GLOBAL_OFFSET = 0x2000


@dataclass(frozen=True)
class DriveConfig:
    """Hardware, stored settings and wiring.

    Attributes:
        volts_min, volts_max: V at the actuator for signals -1 and +1.
        wiring: connector channel (0-based) that actuator 1, 2, ... is really connected to.
        squared: whether signals are linear in the square of the volts, as for a membrane.
    """

    channels: int = parameter(
        whole(frames.CHANNELS, 1, 4096), "Channels at the connector; EDAC40 and USB DAC-40 have 40."
    )
    dac_volts_at_zero: float = parameter(
        real(0.0, -100.0, 100.0, "V"), "DAC output at code 0, as stored in the unit's NVRAM."
    )
    dac_volts_at_full: float = parameter(real(5.0, -100.0, 100.0, "V"), "DAC output at full-scale code, likewise.")
    amplifier_gain: float = parameter(real(80.0, -1e4, 1e4), "Actuator V per DAC V.")
    amplifier_min: float = parameter(real(0.0, -1e4, 1e4, "V"), "Lowest actuator volts, where the amplifier saturates.")
    amplifier_max: float = parameter(real(400.0, -1e4, 1e4, "V"), "Highest actuator volts.")
    volts_min: float = 0.0
    volts_max: float = 300.0
    squared: bool = False
    wiring: Sequence[int] = TRIHEX


class DriveUnit:
    """Outputs that hold their values until the next frame, whoever sent it.

    After power-up every actuator is at 0 V, or as near as the DAC reaches.

    Raises:
        ValueError: an inconsistent configuration; the message names the parameter.
    """

    def __init__(self, config: DriveConfig) -> None:
        self.config = config
        wiring = np.asarray(config.wiring, int)
        self._span = config.dac_volts_at_full - config.dac_volts_at_zero
        self._power = 2 if config.squared else 1
        #: Quantity at signals -1 and +1: V, or V^2 if `squared`.
        self._low, self._high = config.volts_min**self._power, config.volts_max**self._power
        last = config.channels - 1
        if not wiring.size or len(np.unique(wiring)) != len(wiring) or wiring.min() < 0 or wiring.max() > last:
            raise ValueError(f"wiring = {list(config.wiring)}: must be different channels from 0 to {last}")
        square = " squared" if config.squared else ""
        for name, value in (
            ("electronics.dac_volts_at_full - electronics.dac_volts_at_zero", self._span),
            ("electronics.amplifier_gain", config.amplifier_gain),
            (f"volts.max{square} - volts.min{square}", self._high - self._low),
        ):
            if value == 0:
                raise ValueError(f"{name} = 0: must not be zero")
        if config.amplifier_min >= config.amplifier_max:
            raise ValueError(
                f"electronics.amplifier_min = {config.amplifier_min:g} V: must be below electronics.amplifier_max, "
                f"{config.amplifier_max:g} V"
            )
        reach = np.sort(self._volts(np.array([0.0, 1.0])))
        slack = 1e-9 * (reach[1] - reach[0])
        for name, volts in (("volts.min", config.volts_min), ("volts.max", config.volts_max)):
            if not reach[0] - slack <= volts <= reach[1] + slack:
                raise ValueError(
                    f"{name} = {volts:g} V: must be {reach[0]:g} to {reach[1]:g} V, where electronics.dac_volts_*, "
                    "electronics.amplifier_gain, _min and _max end, or no frame reaches that signal"
                )
        self._wiring = wiring
        at_rest = np.clip(-config.dac_volts_at_zero / self._span, 0, 1)
        #: Outputs as fractions of the DAC's range; a unit of few channels still has the registers of an EDAC40.
        self.outputs: Array = np.full(max(frames.CHANNELS, config.channels), at_rest)
        #: Values, offsets and gains of the channels, in the order of the commands that set them.
        self._registers = np.repeat([[0], [0x8000], [0xFFFF]], frames.CHANNELS, axis=1)
        self._global_offset = FACTORY_GLOBAL_OFFSET
        self.settings_frames = 0

    def take_edac40(self, frame: frames.EdacFrame) -> None:
        """Carry out an EDAC40 frame. Only value frames occur in normal operation; the others are counted."""
        self.settings_frames += frame.command != frames.EDAC40_VALUE
        if frame.command == frames.EDAC40_SAVE:
            return
        touched = slice(None) if frame.command == frames.EDAC40_GLOBAL_OFFSET else frame.channels
        if frame.command == frames.EDAC40_GLOBAL_OFFSET:
            self._global_offset = int(frame.values[-1]) & 0x3FFF
        else:
            self._registers[frame.command, touched] = frame.values
        code, offset, gain = self._registers[:, touched]
        dac = code * (gain + 1) // 65536 + offset - 0x8000
        shift = 4 * (self._global_offset - FACTORY_GLOBAL_OFFSET)
        self.outputs[: frames.CHANNELS][touched] = (np.clip(dac, 0, EDAC40_FULL_SCALE) - shift) / EDAC40_FULL_SCALE

    def take_shares(self, outputs: Array) -> None:
        """Carry out a frame of a serial unit: its channels (C,) as shares of the DAC's range."""
        self.outputs[: len(outputs)] = outputs

    def actuator_volts(self) -> Array:
        """Volts at the actuators (N,)."""
        return self._volts(self.outputs[self._wiring])

    def _volts(self, outputs: Array) -> Array:
        """Volts behind the amplifier for shares of the DAC's range."""
        config = self.config
        dac_volts = config.dac_volts_at_zero + self._span * outputs
        return np.clip(config.amplifier_gain * dac_volts, config.amplifier_min, config.amplifier_max)

    def signals(self) -> Array:
        """Normalised signals (N,) that the actuators really get; beyond -1..+1 when driven too far."""
        return 2 * (self.actuator_volts() ** self._power - self._low) / (self._high - self._low) - 1
