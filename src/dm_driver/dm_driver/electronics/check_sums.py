"""Check sums of serial frames, by the names that data sheets use.

CRC parameters: Williams, "A Painless Guide to CRC Error Detection Algorithms"; names and check values as in the
catalogue of parametrised CRC algorithms (Cook).
"""

from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Final


@dataclass(frozen=True)
class CheckSum:
    """One kind of check sum.

    Attributes:
        length: bytes on the wire.
        of: the value of some bytes.
    """

    length: int
    of: Callable[[bytes], int]


def reflected_crc16(polynomial: int, start: int) -> CheckSum:
    """A 16-bit CRC that takes the least significant bit of each byte first; the value is not inverted.

    Args:
        polynomial: without its highest term, bit-reversed: its least significant bit first.
        start: initial value of the register.
    """

    def of_byte(register: int) -> int:
        for _ in range(8):
            register = register >> 1 ^ (polynomial if register & 1 else 0)
        return register

    # One look-up per byte instead of eight steps: a frame goes out hundreds of times per second.
    table = [of_byte(byte) for byte in range(256)]

    def value(data: bytes) -> int:
        register = start
        for byte in data:
            register = register >> 8 ^ table[(register ^ byte) & 0xFF]
        return register

    return CheckSum(2, value)


CHECK_SUMS: Final[dict[str, CheckSum]] = {
    "none": CheckSum(0, lambda data: 0),
    "sum8": CheckSum(1, lambda data: sum(data) & 0xFF),
    "sum8_complement": CheckSum(1, lambda data: -sum(data) & 0xFF),
    "xor8": CheckSum(1, lambda data: reduce(xor, data, 0)),
    "crc16_modbus": reflected_crc16(0xA001, 0xFFFF),
    "crc16_arc": reflected_crc16(0xA001, 0x0000),
    "crc16_ccitt_false": CheckSum(2, lambda data: crc_hqx(data, 0xFFFF)),
    "crc16_xmodem": CheckSum(2, lambda data: crc_hqx(data, 0x0000)),
    "crc16_kermit": reflected_crc16(0x8408, 0x0000),
}
