"""Decoders of the bytes on the wire, written from the units' protocol descriptions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CHANNELS = 40

#: Connector channel of each physical channel of the EDAC40 (both 0-based). The permutation is its own inverse.
EDAC40_CONNECTOR = np.array(
    [
        *(6, 7, 4, 5, 2, 3, 0, 1, 22, 23, 20, 21, 18, 19, 16, 17, 14, 15, 12, 13),
        *(10, 11, 8, 9, 38, 39, 36, 37, 34, 35, 32, 33, 30, 31, 28, 29, 26, 27, 24, 25),
    ]
)
EDAC40_VALUE, EDAC40_OFFSET, EDAC40_GAIN, EDAC40_GLOBAL_OFFSET, EDAC40_SAVE = range(5)
EDAC40_HEADER = 6

#: Connector channel that bit c of group g of a USB DAC-40 frame belongs to: element 5 g + c.
DAC40_CHANNEL = np.array(
    [
        *(7, 15, 23, 31, 39, 6, 14, 22, 30, 38, 5, 13, 21, 29, 37, 4, 12, 20, 28, 36),
        *(3, 11, 19, 27, 35, 2, 10, 18, 26, 34, 1, 9, 17, 25, 33, 0, 8, 16, 24, 32),
    ]
)
DAC40_FRAME = 130
DAC40_START = 0xFF
DAC40_FULL_SCALE = 4095


class FrameError(ValueError):
    """Bytes that are not a valid frame; the message says why."""


@dataclass(frozen=True)
class EdacFrame:
    """One EDAC40 frame: command 0-4, connector channels (0-based) and their 16-bit values."""

    command: int
    channels: NDArray[np.intp]
    values: NDArray[np.uint16]


def edac40_length(header: bytes) -> int:
    """Length of the frame that starts with these six bytes. Raises FrameError: unknown command or empty mask."""
    if header[5] > EDAC40_SAVE:
        raise FrameError(f"unknown EDAC40 command {header[5]}")
    channels = int.from_bytes(header[:5], "little").bit_count()
    if channels == 0:
        raise FrameError("EDAC40 frame with an empty channel mask")
    return EDAC40_HEADER + 2 * channels


def decode_edac40(frame: bytes) -> EdacFrame:
    """Decode one whole EDAC40 frame. Raises FrameError: wrong length for its mask, unknown command, empty mask."""
    if len(frame) < EDAC40_HEADER + 2:
        raise FrameError(f"EDAC40 frame of {len(frame)} bytes, at least 8 are needed")
    length = edac40_length(frame[:EDAC40_HEADER])
    if len(frame) != length:
        raise FrameError(f"EDAC40 frame of {len(frame)} bytes, its mask asks for {length}")
    mask = np.unpackbits(np.frombuffer(frame[:5], np.uint8), bitorder="little")
    physical = np.flatnonzero(mask)
    return EdacFrame(frame[5], EDAC40_CONNECTOR[physical], np.frombuffer(frame[EDAC40_HEADER:], "<u2"))


def decode_dac40(frame: bytes) -> NDArray[np.int64] | None:
    """Decode one USB DAC-40 frame of 130 bytes: codes 0..4095 (40,) by connector channel, or None for the opening
    block of 130 zeros.

    Raises:
        FrameError: a byte that the format fixes has another value.
    """
    if not any(frame):
        return None
    if frame[0] != DAC40_START or frame[-1] != 0:
        raise FrameError(f"USB DAC-40 frame with first byte 0x{frame[0]:02X} and last 0x{frame[-1]:02X}, not FF and 00")
    groups = np.frombuffer(frame, np.uint8)[1:129].reshape(8, 16)
    number = np.arange(8)[:, None]
    address = np.where(number >> np.array([2, 1, 0]) & 1, 0x1F, 0)
    if groups[:, 0].any() or (groups[:, 1:4] != address).any():
        raise FrameError("USB DAC-40 frame with wrong group addresses")
    data = groups[:, 4:]
    if (data > 0x1F).any():
        raise FrameError("USB DAC-40 data byte with more than five bits")
    bits = data[:, :, None] >> np.arange(5) & 1  # group, bit from the most significant, chip
    values = np.einsum("gbc,b->gc", bits.astype(np.int64), 1 << np.arange(11, -1, -1))
    codes = np.empty(CHANNELS, np.int64)
    codes[DAC40_CHANNEL] = values.ravel()
    return codes


def take_dac40(stream: bytearray) -> NDArray[np.float64] | None:
    """Take one USB DAC-40 frame off the front of `stream`: outputs (40,) as shares of full scale, or None when there is
    no whole frame yet. An opening block is taken off too.

    Raises:
        FrameError: bytes that are not a frame, which are removed up to the next start byte, as the unit does.
    """
    while len(stream) >= DAC40_FRAME:
        try:
            codes = decode_dac40(bytes(stream[:DAC40_FRAME]))
        except FrameError as error:
            start = stream.find(DAC40_START, 1)
            skipped = bytes(stream[:start] if start > 0 else stream)
            del stream[: len(skipped)]
            raise FrameError(f"{error} ({skipped[:16].hex(' ')})") from None
        del stream[:DAC40_FRAME]
        if codes is not None:
            return codes / DAC40_FULL_SCALE
    return None
