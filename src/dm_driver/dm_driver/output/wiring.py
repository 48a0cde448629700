"""Which connector channel drives which actuator (docs/protocols.md, wiring): shapes to codes and back."""

from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dm_common import Bools, Floats
from dm_common.mirror import actuators_text
from dm_driver.output.volts import VoltScale
from dm_driver.safety_limiter import Shape

CUSTOM: Final = "custom"
#: In a custom list: no channel drives this actuator.
NOT_WIRED: Final = -1

#: Connector channels, 0-based, of actuators 1, 2, 3, ...; channels 0 and 20 are connected by none of these cables.
TABLES: Final[dict[str, tuple[int, ...]]] = {
    "trihex": (
        *(14, 16, 38, 23, 26, 1, 8, 10, 13, 37, 18, 36, 25, 28, 22, 7, 5, 2, 6),
        *(19, 17, 32, 15, 11, 35, 34, 39, 33, 31, 21, 27, 29, 24, 9, 3, 4, 12),
    ),
    "37ch_30mm": (
        *(10, 13, 14, 16, 8, 5, 6, 11, 15, 9, 18, 19, 17, 12, 4, 1, 3, 2, 7),
        *(33, 34, 35, 36, 37, 38, 27, 26, 25, 24, 23, 21, 22, 28, 29, 30, 32, 31),
    ),
    "37ch_30mm_v2005": (
        *(10, 4, 12, 36, 29, 23, 3, 6, 14, 19, 17, 34, 38, 31, 25, 22, 7, 5, 1),
        *(8, 16, 18, 15, 13, 11, 30, 32, 37, 33, 27, 21, 24, 26, 28, 9, 35, 2),
    ),
}


def wiring_table(name: str, custom: Sequence[int], actuators: int, channels: int) -> NDArray[np.intp]:
    """Return the connector channel, 0..channels-1 or `NOT_WIRED`, of every actuator: (N,).

    Args:
        name: a key of `TABLES`, or "custom".
        custom: the channels of actuators 1, 2, ... when `name` is "custom", else empty; `NOT_WIRED` for an actuator
            without a channel.
        channels: number of channels of the drive unit.

    Raises:
        ValueError: unknown name, wrong length, a channel out of range or used twice.
    """
    if name != CUSTOM and name not in TABLES:
        raise ValueError(f"mirror.wiring = {name!r}: unknown; must be one of {', '.join((*TABLES, CUSTOM))}")
    if name == CUSTOM:
        source, table, lowest = "mirror.channels", tuple(custom), NOT_WIRED
    else:
        source, table, lowest = f"mirror.wiring = {name!r}", TABLES[name], 0
        if custom:
            raise ValueError(
                f"mirror.channels is given but mirror.wiring = {name!r}: set mirror.wiring to {CUSTOM!r}, or leave"
                " mirror.channels empty"
            )
    if len(table) != actuators:
        raise ValueError(
            f"{source} lists {len(table)} channels: must be {actuators}, one per actuator (mirror.actuators)"
        )
    for number, channel in enumerate(table, start=1):
        if not lowest <= channel < channels:
            raise ValueError(f"{source}: actuator {number} on channel {channel}; must be {lowest} to {channels - 1}")
    counts = Counter(channel for channel in table if channel != NOT_WIRED)
    twice = {channel: count for channel, count in counts.items() if count > 1}
    if twice:
        text = "; ".join(
            f"channel {channel} by {actuators_text(i for i, c in enumerate(table, 1) if c == channel)}"
            for channel in twice
        )
        raise ValueError(f"{source}: used more than once: {text}")
    if not counts:
        raise ValueError(f"{source}: no actuator has a channel")
    return np.array(table, dtype=np.intp)


class OutputStage:
    """Wiring and volt scale of one mirror on one drive unit, which has this number of `channels`."""

    def __init__(self, scale: VoltScale, channel_of_actuator: NDArray[np.intp], channels: int) -> None:
        self.scale = scale
        #: (N,) True where the actuator has a channel.
        self.connected: Bools = channel_of_actuator != NOT_WIRED
        #: (channels,) True where an actuator is connected.
        self.wired: Bools = np.zeros(channels, dtype=np.bool_)
        #: (N,) connector channel of each actuator, `NOT_WIRED` for those without one.
        self.channels = channel_of_actuator
        self.wired[channel_of_actuator[self.connected]] = True
        # Units that always set every channel get 0 V, or what is nearest in the range, on those without an actuator.
        self._rest = np.full(channels, scale.codes(np.array([scale.signal_at_zero]))[0], dtype=np.uint16)

    def codes(self, shape: Shape) -> NDArray[np.uint16]:
        """(channels,) codes for a shape of (N,) signals -1..+1."""
        codes = self._rest.copy()
        codes[self.channels[self.connected]] = self.scale.codes(shape)[self.connected]
        return codes

    def outcome(self, codes: NDArray[np.uint16]) -> tuple[Shape, Floats]:
        """(N,) signals and (N,) V at the actuators for these codes; one without a channel is at rest."""
        of_actuator = np.where(self.connected, codes[self.channels], self._rest[0])
        return self.scale.signals_of_codes(of_actuator), self.scale.volts_of_codes(of_actuator)
