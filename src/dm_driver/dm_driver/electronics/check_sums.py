"""Check sums of serial frames, by the names that data sheets use.

CRC parameters: Williams, "A Painless Guide to CRC Error Detection Algorithms"; names and check values as in the
catalogue of parametrised CRC algorithms (Cook).
"""

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


def crc16(polynomial: int, start: int, reflect: bool) -> CheckSum:
    """A CRC of 16 bits without final inversion.

    Args:
        polynomial: without its highest term, most significant bit first.
        start: of the register.
        reflect: bytes enter with their least significant bit first, and the value leaves mirrored.
    """
    divisor = int(f"{polynomial:016b}"[::-1], 2) if reflect else polynomial

    def step(register: int) -> int:
        if reflect:
            return register >> 1 ^ (divisor if register & 1 else 0)
        return (register << 1 ^ (divisor if register & 0x8000 else 0)) & 0xFFFF

    # One look-up per byte instead of eight steps: a frame goes out hundreds of times per second.
    table = [reduce(lambda register, _: step(register), range(8), n if reflect else n << 8) for n in range(256)]

    def value(data: bytes) -> int:
        register = start
        for byte in data:
            if reflect:
                register = register >> 8 ^ table[(register ^ byte) & 0xFF]
            else:
                register = (register << 8 & 0xFFFF) ^ table[register >> 8 ^ byte]
        return register

    return CheckSum(2, value)


CHECK_SUMS: Final[dict[str, CheckSum]] = {
    "none": CheckSum(0, lambda data: 0),
    "sum8": CheckSum(1, lambda data: sum(data) & 0xFF),
    "sum8_complement": CheckSum(1, lambda data: -sum(data) & 0xFF),
    "xor8": CheckSum(1, lambda data: reduce(xor, data, 0)),
    "crc16_modbus": crc16(0x8005, 0xFFFF, reflect=True),
    "crc16_arc": crc16(0x8005, 0x0000, reflect=True),
    "crc16_ccitt_false": crc16(0x1021, 0xFFFF, reflect=False),
    "crc16_xmodem": crc16(0x1021, 0x0000, reflect=False),
    "crc16_kermit": crc16(0x1021, 0x0000, reflect=True),
}
