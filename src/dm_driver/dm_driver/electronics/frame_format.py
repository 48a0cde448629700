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

from dm_driver.electronics.check_sums import CHECK_SUMS

BYTE_ORDERS: Final = ("big", "little")
PARITIES: Final = ("none", "even", "odd")
#: Codes are handed over as 16-bit numbers.
MOST_BITS: Final = 16
MOST_WORD_BITS: Final = 32


def parse_hex(name: str, text: str) -> bytes:
    """Bytes of "A5 5A".

    Raises:
        ValueError: naming the parameter and its value.
    """
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise ValueError(
            f"{name} = {text!r}: must be bytes as pairs of hexadecimal digits, such as 'A5 5A'; empty = none"
        ) from None


@dataclass(frozen=True)
class FrameFormat:
    """One unit's frames and line. The names are those of the parameters `framed_serial.*`.

    Attributes:
        channels: output channels C.
        bits: of a code; full scale is 2^bits - 1.
        header, terminator: bytes before and after, hexadecimal.
        channel_order: connector channels (from 0) in the order of their words; empty = 0, 1, 2, ...
        word_bits: of a word on the wire; 0 = `bits` rounded up to whole bytes.
        byte_order: "big": words begin with their most significant bit; "little": bytes, and bits in them, from the
            least significant on.
        scale, offset: integers that make a word of a code.
        checksum: a key of `CHECK_SUMS`.
        checksum_covers_header: whether the header counts.
        checksum_byte_order: of check sums of two bytes.
        opening: bytes sent once after opening, hexadecimal.
        reply: what the unit answers to every frame, hexadecimal; empty = it does not answer.
        baud_rate: bit/s.
        parity: none, even or odd.
        stop_bits: 1 or 2.
        frame_rate: most frames per second, Hz; 0 = as fast as the line carries them.

    Raises:
        ValueError: values that are each allowed and do not fit each other, naming the parameters.
    """

    channels: int = 40
    bits: int = 16
    header: str = ""
    terminator: str = ""
    channel_order: Sequence[int] = ()
    word_bits: int = 0
    byte_order: str = "big"
    scale: int = 1
    offset: int = 0
    checksum: str = "none"
    checksum_covers_header: bool = True
    checksum_byte_order: str = "big"
    opening: str = ""
    reply: str = ""
    baud_rate: int = 115200
    parity: str = "none"
    stop_bits: int = 1
    frame_rate: float = 0.0

    def __post_init__(self) -> None:
        for name in ("header", "terminator", "opening", "reply"):
            parse_hex(f"framed_serial.{name}", getattr(self, name))
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
        payload = np.packbits(bits, bitorder=_order(self.byte_order)).tobytes()
        header, terminator = self._ends
        check = CHECK_SUMS[self.checksum]
        value = check.of(header + payload if self.checksum_covers_header else payload)
        return header + payload + value.to_bytes(check.length, _order(self.checksum_byte_order)) + terminator


def _order(name: str) -> Literal["big", "little"]:
    return "big" if name == "big" else "little"
