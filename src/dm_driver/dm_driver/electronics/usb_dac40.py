"""USB DAC-40: 40 channels, 12 bit, behind an FTDI virtual serial port (docs/protocols.md, USB DAC-40)."""

from typing import Final

import numpy as np
import serial
from numpy.typing import NDArray

from dm_common import Bools
from dm_driver.electronics.base import SERIAL_PORT, DriveElectronics

CHANNELS: Final = 40
MAX_CODE: Final = 0xFFF
FRAME_LENGTH: Final = 130

_GROUPS: Final = 8
_CHIPS: Final = 5
_BITS: Final = 12
_GROUP_LENGTH: Final = 16

#: Channel of DAC chip c in group g at index 5 g + c.
CHANNEL_ORDER: Final[NDArray[np.intp]] = np.array(
    [
        *(7, 15, 23, 31, 39, 6, 14, 22, 30, 38, 5, 13, 21, 29, 37, 4, 12, 20, 28, 36),
        *(3, 11, 19, 27, 35, 2, 10, 18, 26, 34, 1, 9, 17, 25, 33, 0, 8, 16, 24, 32),
    ]
)
_CHIP_BIT: Final = (1 << np.arange(_CHIPS)).astype(np.uint8)
_BIT_SHIFT: Final = np.arange(_BITS - 1, -1, -1, dtype=np.uint16)
#: Each group begins with a zero byte and its address, three bits from the most significant on.
_ADDRESSES: Final = np.where(np.arange(_GROUPS)[:, None] >> np.array([2, 1, 0]) & 1, 0x1F, 0x00).astype(np.uint8)


def encode_frame(codes: NDArray[np.uint16]) -> bytes:
    """Return the 130-byte frame that sets all 40 channels.

    Args:
        codes: (40,) 0..4095 by connector channel.
    """
    chips = codes[CHANNEL_ORDER].reshape(_GROUPS, 1, _CHIPS)
    bits = (chips >> _BIT_SHIFT[:, None] & 1).astype(np.uint8)  # group, bit from the most significant, chip
    frame = np.zeros(FRAME_LENGTH, dtype=np.uint8)
    frame[0] = 0xFF
    groups = frame[1:-1].reshape(_GROUPS, _GROUP_LENGTH)
    groups[:, 1:4] = _ADDRESSES
    groups[:, 4:] = bits @ _CHIP_BIT
    return frame.tobytes()


class UsbDac40(DriveElectronics):
    """USB DAC-40. Every frame sets all 40 channels, connected or not."""

    channels = CHANNELS
    max_code = MAX_CODE
    needs = SERIAL_PORT

    @property
    def where(self) -> str:
        return f"USB DAC-40 at {self._settings.serial_port}"

    def _do_open(self) -> None:
        # Exclusive: two writers on one unit would tear each other's frames.
        self._link = serial.Serial(self._settings.serial_port, timeout=0, exclusive=True)
        self._send(bytes(FRAME_LENGTH))  # ends any frame that an earlier program left half sent

    def _do_write(self, codes: NDArray[np.uint16], wired: Bools) -> None:
        self._send(encode_frame(codes))

    def _do_check(self) -> None:
        _ = self._link.in_waiting  # fails on a device that has been unplugged
