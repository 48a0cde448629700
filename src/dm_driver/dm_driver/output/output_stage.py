"""From a shape in actuator order to the codes of all connector channels, and back to what stands at the actuators."""

import numpy as np
from numpy.typing import NDArray

from dm_driver.output.volts import VoltScale
from dm_driver.output.wiring import NOT_WIRED
from dm_driver.safety_limiter import Shape


class OutputStage:
    """Wiring and volt scale of one mirror on one drive unit.

    Args:
        scale: signal to code.
        channel_of_actuator: (N,) connector channels, `NOT_WIRED` for actuators without one.
        channels: channels of the drive unit.
    """

    def __init__(self, scale: VoltScale, channel_of_actuator: NDArray[np.intp], channels: int) -> None:
        self.scale = scale
        #: (N,) True where the actuator has a channel.
        self.connected: NDArray[np.bool_] = channel_of_actuator != NOT_WIRED
        #: (channels,) True where an actuator is connected.
        self.wired: NDArray[np.bool_] = np.zeros(channels, dtype=np.bool_)
        #: (N,) connector channel of each actuator, `NOT_WIRED` for those without one.
        self.channels = channel_of_actuator
        self.wired[channel_of_actuator[self.connected]] = True
        # Units that always set every channel get the lowest actuator voltage on those without an actuator.
        self._rest = np.full(channels, scale.codes(np.array([-1.0]))[0], dtype=np.uint16)

    def codes(self, shape: Shape) -> NDArray[np.uint16]:
        """(channels,) codes for a shape of (N,) signals -1..+1."""
        codes = self._rest.copy()
        codes[self.channels[self.connected]] = self.scale.codes(shape)[self.connected]
        return codes

    def outcome(self, codes: NDArray[np.uint16]) -> tuple[Shape, NDArray[np.float64]]:
        """(N,) signals and (N,) V at the actuators for these codes; an actuator without a channel rests at -1."""
        of_actuator = np.where(self.connected, codes[self.channels], self._rest[0])
        return self.scale.signals_of_codes(of_actuator), self.scale.volts_of_codes(of_actuator)
