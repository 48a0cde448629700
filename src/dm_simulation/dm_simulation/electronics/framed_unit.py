"""A custom serial drive unit: the format of its frames, as its data sheet gives it, and their decoder."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from dm_common.values import parameter, switch, text, whole, wholes
from dm_simulation.electronics.frames import FrameError

BYTE_ORDERS: Final = ("big", "little")
#: Bytes of each check sum.
CHECK_LENGTH: Final = {
    "none": 0,
    "sum8": 1,
    "sum8_complement": 1,
    "xor8": 1,
    "crc16_modbus": 2,
    "crc16_arc": 2,
    "crc16_ccitt_false": 2,
    "crc16_xmodem": 2,
    "crc16_kermit": 2,
}


@dataclass(frozen=True)
class FramedConfig:
    """Frame format of the unit, from its data sheet."""

    channels: int = parameter(whole(0, 0, 4096), "Words in a frame of the serial unit; 0 = it is a USB DAC-40.")
    bits: int = parameter(whole(16, 1, 16), "Bits of a code of the serial unit.")
    header: str = parameter(text(""), "Bytes before the words, hexadecimal.")
    terminator: str = parameter(text(""), "Bytes after the check sum, hexadecimal.")
    opening: str = parameter(text(""), "Bytes that may come before a frame and are ignored, hexadecimal.")
    reply: str = parameter(text(""), "Answer to every frame, hexadecimal.")
    channel_order: tuple[int, ...] = parameter(
        wholes([], 0, 4095), "Channels (from 0) in the order in which they are sent; empty = 0, 1, 2, ..."
    )
    word_bits: int = parameter(whole(0, 0, 32), "Bits of a word, without gaps; 0 = bits rounded up to whole bytes.")
    byte_order: Literal["big", "little"] = parameter(
        text("big", choices=BYTE_ORDERS), "Order of bytes and bits in a frame."
    )
    scale: int = parameter(whole(1, -(2**31), 2**31), "word = offset + scale * code.")
    offset: int = parameter(whole(0, -(2**31), 2**32), "word = offset + scale * code.")
    checksum: str = parameter(text("none", choices=tuple(CHECK_LENGTH)), "Check sum.")
    checksum_covers_header: bool = parameter(switch(True), "The check sum includes the header.")
    checksum_byte_order: Literal["big", "little"] = parameter(text("big", choices=BYTE_ORDERS), "Of two-byte sums.")


def check_value(kind: str, data: bytes) -> int:
    """The check sum of `data`, bit by bit."""
    if kind == "none":
        return 0
    if kind.startswith("sum8"):
        total = sum(data) % 256
        return total if kind == "sum8" else (256 - total) % 256
    if kind == "xor8":
        parity = 0
        for byte in data:
            parity ^= byte
        return parity
    mirrored = kind in ("crc16_modbus", "crc16_arc", "crc16_kermit")
    divisor = 0x8005 if kind in ("crc16_modbus", "crc16_arc") else 0x1021
    remainder = 0xFFFF if kind in ("crc16_modbus", "crc16_ccitt_false") else 0
    for byte in data:
        for place in range(8) if mirrored else range(7, -1, -1):
            out = remainder >> 15 ^ byte >> place & 1
            remainder = (remainder << 1 & 0xFFFF) ^ (divisor if out else 0)
    return sum((remainder >> k & 1) << (15 - k) for k in range(16)) if mirrored else remainder


class FramedDecoder:
    """Finds frames in a stream. Raises ValueError for an inconsistent description; the message names the parameter."""

    def __init__(self, config: FramedConfig) -> None:
        parts = []
        for name in ("header", "terminator", "opening", "reply"):
            try:
                parts.append(bytes.fromhex(getattr(config, name)))
            except ValueError:
                raise ValueError(f"framed.{name} = {getattr(config, name)!r}: must be hexadecimal bytes") from None
        self._header, self._terminator, self._opening, self.reply = parts
        if config.channel_order and sorted(config.channel_order) != list(range(config.channels)):
            raise ValueError(
                f"framed.channel_order = {list(config.channel_order)}: must hold each of 0 to {config.channels - 1} "
                "once, or be empty"
            )
        width = config.word_bits or (config.bits + 7) // 8 * 8
        if width < config.bits:
            raise ValueError(f"framed.word_bits = {width}: must be at least framed.bits = {config.bits}")
        if config.scale == 0:
            raise ValueError("framed.scale = 0: must not be zero")
        self.config = config
        self._width = width
        self._payload = (config.channels * width + 7) // 8
        self._check = CHECK_LENGTH[config.checksum]
        self._length = len(self._header) + self._payload + self._check + len(self._terminator)
        self._order = np.array(config.channel_order or range(config.channels))

    def take(self, stream: bytearray) -> NDArray[np.float64] | None:
        """Take one frame off the front of `stream`: outputs (channels,) as shares of full scale, or None when there is
        no whole frame yet.

        Raises:
            FrameError: bytes that are not a frame; they are removed as well.
        """
        if self._opening and stream.startswith(self._opening + self._header):
            del stream[: len(self._opening)]
        start = stream.find(self._header)
        if start != 0 and len(stream) >= self._length:
            skipped = bytes(stream[:start] if start > 0 else stream)
            del stream[: len(skipped)]
            raise FrameError(f"no header in front ({skipped[:16].hex(' ')})")
        if len(stream) < self._length:
            return None
        frame = bytes(stream[: self._length])
        del stream[: self._length]
        return self._decode(frame)

    def _decode(self, frame: bytes) -> NDArray[np.float64]:
        config, begin = self.config, len(self._header)
        payload = frame[begin : begin + self._payload]
        after = begin + self._payload
        check, end = frame[after : after + self._check], frame[after + self._check :]
        got = int.from_bytes(check, config.checksum_byte_order)
        expected = check_value(config.checksum, self._header + payload if config.checksum_covers_header else payload)
        if got != expected:
            raise FrameError(f"check sum {got:#x}, computed {expected:#x}")
        if end != self._terminator:
            raise FrameError(f"ends in {end.hex(' ')}, not {self._terminator.hex(' ')}")
        # The whole payload as one number: word k lies k widths from its beginning.
        number = int.from_bytes(payload, config.byte_order)
        spare = 8 * len(payload) - config.channels * self._width
        outputs = np.empty(config.channels)
        full = 2**config.bits - 1
        signed = min(config.offset, config.offset + config.scale * full) < 0
        for k, channel in enumerate(self._order):
            shift = spare + self._width * (config.channels - 1 - k) if config.byte_order == "big" else self._width * k
            word = number >> shift & (1 << self._width) - 1
            if signed and word >> self._width - 1:
                word -= 1 << self._width
            code, rest = divmod(word - config.offset, config.scale)
            if rest or not 0 <= code <= full:
                raise FrameError(f"word {word} of channel {channel} stands for no code from 0 to {full}")
            outputs[channel] = code / full
        return outputs
