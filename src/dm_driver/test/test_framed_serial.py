"""Frames of a serial unit described by parameters: check sums, words, what is refused, the pace, the answer."""

from __future__ import annotations

import os
import select
import termios
import threading
import time
import tty
from collections.abc import Iterator
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import serial
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_common.messages import time_message
from dm_common.ros.parameters import REQUIRED
from dm_driver.degauss import degauss_move
from dm_driver.driver_configuration import build_configuration
from dm_driver.driver_messages import mirror_info_message
from dm_driver.driver_parameters import PARAMETERS
from dm_driver.electronics.base import ElectronicsSettings, LinkError
from dm_driver.electronics.check_sums import CHECK_SUMS
from dm_driver.electronics.frame_format import FrameFormat
from dm_driver.electronics.framed_serial import FramedSerial
from waiting import wait_until

ALL_ON = np.ones(4, dtype=np.bool_)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("none", 0),
        ("sum8", 0xDD),
        ("sum8_complement", 0x23),
        ("xor8", 0x31),
        ("crc16_modbus", 0x4B37),
        ("crc16_arc", 0xBB3D),
        ("crc16_ccitt_false", 0x29B1),
        ("crc16_xmodem", 0x31C3),
        ("crc16_kermit", 0x2189),
    ],
)
def test_check_sums_have_the_published_check_values(name: str, value: int) -> None:
    assert CHECK_SUMS[name].of(b"123456789") == value


def frame(codes: list[int], **format: Any) -> str:
    return FrameFormat(channels=len(codes), **format).encode(np.array(codes, dtype=np.uint16)).hex(" ")


@pytest.mark.parametrize(
    ("format", "expected"),
    [
        ({}, "12 34 ab cd"),
        ({"byte_order": "little"}, "34 12 cd ab"),
        ({"channel_order": (1, 0)}, "ab cd 12 34"),
        ({"header": "AA", "terminator": "0D 0A"}, "aa 12 34 ab cd 0d 0a"),
        ({"header": "AA", "checksum": "sum8"}, "aa 12 34 ab cd 68"),
        ({"header": "AA", "checksum": "sum8", "checksum_covers_header": False}, "aa 12 34 ab cd be"),
        ({"word_bits": 24}, "00 12 34 00 ab cd"),
        ({"offset": -32768}, "92 34 2b cd"),
        ({"offset": 65535, "scale": -1}, "ed cb 54 32"),
    ],
)
def test_frames_of_two_channels(format: dict[str, Any], expected: str) -> None:
    assert frame([0x1234, 0xABCD], **format) == expected


@pytest.mark.parametrize(
    ("format", "expected"),
    [
        ({}, "01 23 0a bc"),
        ({"word_bits": 12}, "12 3a bc"),
        ({"word_bits": 12, "byte_order": "little"}, "23 c1 ab"),
        ({"scale": 16}, "12 30 ab c0"),
    ],
)
def test_frames_of_twelve_bits(format: dict[str, Any], expected: str) -> None:
    assert frame([0x123, 0xABC], bits=12, **format) == expected


@settings(max_examples=50)
@given(
    st.lists(st.integers(0, 2**10 - 1), min_size=1, max_size=30),
    st.integers(10, 32),
    st.sampled_from(["big", "little"]),
)
def test_words_of_any_width_can_be_read_back(codes: list[int], width: int, order: Any) -> None:
    sent = FrameFormat(channels=len(codes), bits=10, word_bits=width, byte_order=order).encode(
        np.array(codes, dtype=np.uint16)
    )
    number = int.from_bytes(sent, order)
    spare = 8 * len(sent) - width * len(codes)
    shifts = [width * k if order == "little" else spare + width * (len(codes) - 1 - k) for k in range(len(codes))]
    assert [number >> shift & (1 << width) - 1 for shift in shifts] == codes


@pytest.mark.parametrize(
    ("format", "words"),
    [
        ({"header": "A5 5"}, r"framed_serial.header = 'A5 5': must be bytes as pairs of hexadecimal digits"),
        ({"channels": 2, "channel_order": (0, 2)}, r"channel_order = \[0, 2\]: must hold each of 0 to 1"),
        ({"word_bits": 12}, r"framed_serial.word_bits = 12: must be 16 \(framed_serial.bits\) to 32"),
        ({"scale": 2}, r"words reach from 0 to 131070, must be 0 to 65535 in 16 bits"),
        ({"offset": -40000}, r"words reach from -40000 to 25535, must be -32768 to 32767"),
        ({"scale": 0}, r"framed_serial.scale = 0: must not be zero"),
        ({"frame_rate": 1000.0}, r"frame_rate = 1000 Hz: must be 0 to 144 Hz, what 115200 bit/s carry .* 80 bytes"),
    ],
)
def test_what_cannot_be_is_refused(format: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        FrameFormat(**format)


def whole_configuration() -> dict[str, Any]:
    """Of a unit with 40 channels of 16 bit at 115200 bit/s."""
    values = {parameter.name: parameter.default for parameter in PARAMETERS if parameter.default is not REQUIRED}
    values |= {"mirror.serial": "1", "electronics.kind": "framed_serial", "electronics.serial_port": "/dev/ttyUSB0"}
    values |= {"volts.dac_at_zero": 0.0, "volts.dac_at_full": 5.0, "volts.amplifier_gain": 80.0}
    return values | {"volts.min": 0.0, "volts.max": 300.0}


def test_the_driver_names_a_wrong_parameter() -> None:
    values = whole_configuration()
    assert build_configuration(values).electronics.channels == 40
    with pytest.raises(ValueError, match=r"framed_serial\.terminator = 'CR'"):
        build_configuration(values | {"framed_serial.terminator": "CR"})
    with pytest.raises(ValueError, match=r"actuator 3 on channel 38; must be 0 to 37"):
        build_configuration(values | {"framed_serial.channels": 38})


def test_the_slew_rate_is_what_the_line_carries() -> None:
    configuration = build_configuration(whole_configuration())
    limiter, rate = configuration.limiter, configuration.electronics.frames_per_second
    assert rate == 144.0
    assert limiter.limits.slew_rate == pytest.approx(0.1 * rate)
    info = mirror_info_message(whole_configuration(), configuration, "mirror", time_message(0))
    assert info.slew_rate_max == pytest.approx(0.1 * rate)
    start = np.full(37, -1.0)
    for target, frames in ((start + 1.0, 10), (start + 0.11, 2), (start + 0.05, 1)):
        assert limiter.ramp_time(start, target) == pytest.approx((frames - 1) / rate)
    slow = build_configuration(whole_configuration() | {"limits.slew_rate": 2.0}).limiter
    assert slow.limits.slew_rate == 2.0
    assert slow.ramp_time(start, start + 1.0) == pytest.approx(0.9 / 2.0)


@pytest.mark.parametrize(("amplitude", "steps"), [(0.0, 100), (0.01, 1000), (0.3, 7)])
def test_a_degauss_needs_no_more_frames_than_its_duration_has(amplitude: float, steps: int) -> None:
    limiter = build_configuration(whole_configuration()).limiter
    move = degauss_move(limiter.limits, amplitude, steps, np.full(37, 0.5))
    frames = sum(1 for _ in limiter.path(np.full(37, 1.0), move.way()))
    assert frames / limiter.limits.frames_per_second <= move.duration


def test_a_degauss_that_the_line_makes_too_long_is_refused() -> None:
    slow = whole_configuration() | {"framed_serial.baud_rate": 4800}
    with pytest.raises(ValueError, match=r"100: would take 190 s at .* = 0.6 1/s and 6 frames per second, must be at"):
        build_configuration(slow)


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """A pseudo-terminal: the unit's end, and the name of the driver's."""
    unit, terminal = os.openpty()
    tty.setraw(terminal)
    yield unit, os.ttyname(terminal)
    os.close(unit)
    os.close(terminal)


def read(line: int, count: int) -> bytes:
    """Just so many bytes; one read may return a part of what is there."""
    content = b""
    while len(content) < count:
        content += os.read(line, count - len(content))
    assert not select.select([line], [], [], 0.1)[0], "more than expected"
    return content


FOUR = FrameFormat(channels=4, bits=8)
CODES = np.arange(4, dtype=np.uint16)


def of_four(line: tuple[int, str], timeout_s: float = 1.0, **format: Any) -> FramedSerial:
    """The unit of four channels at the line, with some of its frame otherwise."""
    return FramedSerial(ElectronicsSettings(serial_port=line[1], frame=replace(FOUR, **format), timeout_s=timeout_s))


@pytest.mark.parametrize("error", [termios.error(22, "Invalid argument"), ValueError("Failed to set custom baud rate")])
def test_a_port_without_the_parity_or_speed_is_no_defect(
    line: tuple[int, str], monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(serial, "Serial", Mock(side_effect=error))
    with pytest.raises(LinkError, match=rf"cannot open framed serial unit at /dev/pts/\d+: .*{error.args[-1]}"):
        of_four(line).open()


def test_a_missing_answer_breaks_the_link(line: tuple[int, str]) -> None:
    with of_four(line, timeout_s=0.1, reply="06") as electronics:
        os.write(line[0], b"\x06")  # before the question: it must not count
        wait_until(lambda: electronics._link is not None and electronics._link.in_waiting)
        with pytest.raises(LinkError, match=r"answered nothing within 0\.1 s, not 06"):
            electronics.write(CODES, ALL_ON)
        assert not electronics.is_open


def test_a_wrong_answer_breaks_the_link(line: tuple[int, str]) -> None:
    def refuse() -> None:
        os.read(line[0], 4)
        os.write(line[0], b"\x15")

    unit = threading.Thread(target=refuse)
    with of_four(line, timeout_s=10.0, reply="06") as electronics:
        unit.start()
        with pytest.raises(LinkError, match="answered 15 "):
            electronics.write(CODES, ALL_ON)
    unit.join()


def test_the_pause_counts_from_the_frame_and_not_from_its_answer(line: tuple[int, str]) -> None:
    """Else a frame, its answer and the pause after it would take twice what the slew rate promises."""
    answered: list[float] = []
    with of_four(line, timeout_s=20.0, reply="06") as electronics:

        def answer() -> None:
            os.read(line[0], 4)
            wait_until(lambda: electronics.sent_at > 0.0)
            answered.append(time.monotonic())
            os.write(line[0], b"\x06")

        unit = threading.Thread(target=answer)
        unit.start()
        electronics.write(CODES, ALL_ON)
        unit.join()
        assert 0.0 < electronics.sent_at <= answered[0]


def test_the_opening_comes_once(line: tuple[int, str]) -> None:
    with of_four(line, opening="01 02") as electronics:
        electronics.write(CODES, ALL_ON)
        electronics.write(CODES, ALL_ON)
    assert read(line[0], 10) == bytes([1, 2, 0, 1, 2, 3, 0, 1, 2, 3])


def test_frames_keep_their_distance(line: tuple[int, str]) -> None:
    """No faster than asked for; how much slower depends on the machine and is not judged."""
    with of_four(line, frame_rate=50.0) as electronics:
        begun = time.monotonic()
        for _ in range(6):
            electronics.write(CODES, ALL_ON)
    assert time.monotonic() - begun >= 5 / 50
