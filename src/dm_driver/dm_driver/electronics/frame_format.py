"""The frame of a serial drive unit as its data sheet describes it: header, one word per channel, check sum, end.

    header | word of each channel, in `channel_order` | check sum | terminator

A word is `offset + scale * code`, in two's complement when negative. Words follow each other without gaps: with
`word_bits` 16 each has two bytes, with 12 two words share three.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from dm_common.values import parameter, real, switch, text, whole, wholes
from dm_driver.electronics.check_sums import CHECK_SUMS

BYTE_ORDERS: Final = ("big", "little")
PARITIES: Final = ("none", "even", "odd")
#: Codes are handed over as 16-bit numbers.
MOST_BITS: Final = 16
MOST_WORD_BITS: Final = 32


@dataclass(frozen=True)
class FrameFormat:
    """Frames and line of one unit.

    Raises:
        ValueError: values that are each allowed but contradict each other, naming the parameters.
    """

    channels: int = parameter(whole(40, 1, 4096), "Output channels of the unit.")
    bits: int = parameter(whole(16, 1, MOST_BITS), "Bits of a code; full scale is 2^bits - 1.")
    header: str = parameter(text(""), "Bytes before the words, hexadecimal, for example 'A5 5A'.")
    terminator: str = parameter(text(""), "Bytes after the check sum, hexadecimal.")
    channel_order: Sequence[int] = parameter(
        wholes([], 0, 4095), "Connector channels (from 0) in the order in which they are sent; empty = 0, 1, 2, ..."
    )
    word_bits: int = parameter(
        whole(0, 0, MOST_WORD_BITS),
        "Bits of a word on the wire, no gaps between words; 0 = framed_serial.bits rounded up to whole bytes.",
    )
    byte_order: Literal["big", "little"] = parameter(
        text("big", choices=BYTE_ORDERS),
        "big: words begin with their most significant bit; little: with their least significant byte and bit.",
    )
    scale: int = parameter(whole(1, -(2**31), 2**31), "word = offset + scale * code.")
    offset: int = parameter(
        whole(0, -(2**31), 2**32), "word = offset + scale * code; negative words in two's complement."
    )
    checksum: str = parameter(text("none", choices=tuple(CHECK_SUMS)), "Check sum.")
    checksum_covers_header: bool = parameter(switch(True), "The check sum includes the header.")
    checksum_byte_order: Literal["big", "little"] = parameter(
        text("big", choices=BYTE_ORDERS), "Byte order of check sums of two bytes."
    )
    opening: str = parameter(text(""), "Bytes sent once after opening, hexadecimal.")
    reply: str = parameter(
        text(""),
        "Reply of the unit to every frame, within electronics.timeout, hexadecimal; empty = it does not reply.",
    )
    baud_rate: int = parameter(whole(115200, 50, 10_000_000, "bit/s"), "Baud rate of the line.")
    parity: str = parameter(text("none", choices=PARITIES), "Parity bit.")
    stop_bits: int = parameter(whole(1, 1, 2), "Stop bits.")
    frame_rate: float = parameter(real(0.0, 0.0, 1e6, "Hz"), "Most frames per second; 0 = as many as the line carries.")

    def __post_init__(self) -> None:
        for name in ("header", "terminator", "opening", "reply"):
            try:
                bytes.fromhex(getattr(self, name))
            except ValueError:
                raise ValueError(
                    f"framed_serial.{name} = {getattr(self, name)!r}: must be bytes as pairs of hexadecimal digits,"
                    " such as 'A5 5A'; empty = none"
                ) from None
        if len(self.channel_order) and sorted(self.channel_order) != list(range(self.channels)):
            raise ValueError(
                f"framed_serial.channel_order = {list(self.channel_order)}: must hold each of 0 to {self.channels - 1}"
                " (framed_serial.channels) once, or be empty"
            )
        self._check_words()
        if not 0.0 <= self.frame_rate <= self.line_rate:
            raise ValueError(
                f"framed_serial.frame_rate = {self.frame_rate:g} Hz: must be 0 to {self.line_rate:.4g} Hz, what"
                f" {self.baud_rate} bit/s carry of frames of {self.frame_length} bytes"
            )

    def _check_words(self) -> None:
        if self.word_bits and not self.bits <= self.word_bits <= MOST_WORD_BITS:
            raise ValueError(
                f"framed_serial.word_bits = {self.word_bits}: must be {self.bits} (framed_serial.bits) to"
                f" {MOST_WORD_BITS}, or 0"
            )
        if self.scale == 0:
            raise ValueError("framed_serial.scale = 0: must not be zero")
        ends = self.offset, self.offset + self.scale * self.max_code
        bits = self.bits_per_word
        lowest, highest = (-(1 << bits - 1), (1 << bits - 1) - 1) if min(ends) < 0 else (0, (1 << bits) - 1)
        if min(ends) < lowest or max(ends) > highest:
            raise ValueError(
                f"framed_serial.scale = {self.scale}, framed_serial.offset = {self.offset}: words reach from"
                f" {min(ends)} to {max(ends)}, must be {lowest} to {highest} in {bits} bits (framed_serial.word_bits)"
            )

    @property
    def max_code(self) -> int:
        """Code of full scale."""
        return (1 << self.bits) - 1

    @property
    def bits_per_word(self) -> int:
        """Bits that a word takes on the wire."""
        return self.word_bits or -(-self.bits // 8) * 8

    @property
    def frame_length(self) -> int:
        """Bytes of one frame."""
        words = -(-self.channels * self.bits_per_word // 8)
        ends = len(bytes.fromhex(self.header)) + len(bytes.fromhex(self.terminator))
        return ends + words + CHECK_SUMS[self.checksum].length

    @property
    def line_rate(self) -> float:
        """Frames per second that the line carries, answers included, Hz."""
        bits_per_byte = 9 + self.stop_bits + (self.parity != "none")  # one start bit
        return self.baud_rate / (bits_per_byte * (self.frame_length + len(bytes.fromhex(self.reply))))

    @cached_property
    def _order(self) -> NDArray[np.intp]:
        return np.array(self.channel_order if len(self.channel_order) else range(self.channels), dtype=np.intp)

    @cached_property
    def _ends(self) -> tuple[bytes, bytes]:
        return bytes.fromhex(self.header), bytes.fromhex(self.terminator)

    def encode(self, codes: NDArray[np.uint16]) -> bytes:
        """The frame that sets all channels.

        Args:
            codes: (C,) 0..max_code by connector channel.
        """
        words = self.offset + self.scale * codes[self._order].astype(np.int64)
        places = np.arange(self.bits_per_word)
        if self.byte_order == "big":
            places = places[::-1]
        # A shift keeps the sign, so that negative words come out in two's complement.
        bits = (words[:, None] >> places & 1).astype(np.uint8)
        payload = np.packbits(bits, bitorder=self.byte_order).tobytes()
        header, terminator = self._ends
        check = CHECK_SUMS[self.checksum]
        value = check.of(header + payload if self.checksum_covers_header else payload)
        return header + payload + value.to_bytes(check.length, self.checksum_byte_order) + terminator
