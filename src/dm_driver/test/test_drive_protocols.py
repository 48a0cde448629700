"""Frames against the vendor's test vectors, and discovery."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_driver.electronics import discover, discovery, edac40, usb_dac40
from dm_driver.output.wiring import TABLES
from drive_unit_servers import Edac40UdpUnit, decode_dac40, decode_edac40

Codes = dict[int, int]


def edac40_frame(values: Codes) -> bytes:
    codes, wired = np.zeros(40, dtype=np.uint16), np.zeros(40, dtype=np.bool_)
    for channel, code in values.items():
        codes[channel], wired[channel] = code, True
    return edac40.encode_frame(codes, wired)


TRIHEX = TABLES["trihex"]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({0: 0x1234}, "40 00 00 00 00 00 34 12"),
        ({0: 0x0001, 1: 0x0203, 39: 0xABCD}, "c0 00 00 02 00 00 01 00 03 02 cd ab"),
        ({TRIHEX[0]: 0x7FFF, TRIHEX[1]: 0x8000, TRIHEX[2]: 0xFFFF}, "00 40 01 01 00 00 00 80 ff 7f ff ff"),
    ],
)
def test_edac40_vectors(values: Codes, expected: str) -> None:
    assert edac40_frame(values) == bytes.fromhex(expected)


@settings(max_examples=60)
@given(st.dictionaries(st.integers(0, 39), st.integers(0, 65535), min_size=1))
def test_edac40_frames_decode_to_what_was_encoded(values: Codes) -> None:
    frame = edac40_frame(values)
    assert len(frame) == 6 + 2 * len(values)
    assert decode_edac40(frame) == (values, b"")


def test_edac40_channel_table_is_its_own_inverse() -> None:
    table = edac40.PHYSICAL_CHANNEL
    assert (table[table] == np.arange(40)).all()


def test_usb_dac40_frame_of_one_bit() -> None:
    """Channel 7 is chip 0 of group 0: its bits are bit 0 of bytes 5..16, most significant first."""
    codes = np.zeros(40, dtype=np.uint16)
    codes[7] = 0x801
    frame = usb_dac40.encode_frame(codes)
    expected = bytearray(130)
    expected[0] = 0xFF
    for group in range(8):
        for i, bit in enumerate((4, 2, 1)):
            expected[1 + 16 * group + 1 + i] = 0x1F if group & bit else 0
    expected[5] = 1
    expected[16] = 1
    assert frame == bytes(expected)


def test_usb_dac40_channel_32_is_chip_4_of_group_7() -> None:
    codes = np.zeros(40, dtype=np.uint16)
    codes[32] = 0xFFF
    frame = usb_dac40.encode_frame(codes)
    assert frame[1 + 16 * 7 :] == bytes([0, 0x1F, 0x1F, 0x1F]) + bytes([16] * 12) + b"\0"


@settings(max_examples=40)
@given(st.lists(st.integers(0, 4095), min_size=40, max_size=40))
def test_usb_dac40_frames_decode_to_what_was_encoded(codes: list[int]) -> None:
    frame = usb_dac40.encode_frame(np.array(codes, dtype=np.uint16))
    assert decode_dac40(frame) == dict(enumerate(codes))


REPLY = b"EDAC40         \r\n00-04-a3-12-34-56\r\n"


def test_discovery_reply() -> None:
    assert discovery.parse_reply(REPLY, "10.0.0.7") == discovery.Unit("EDAC40", "00-04-A3-12-34-56", "10.0.0.7")


@pytest.mark.parametrize(
    "reply",
    [b"", b"EDAC40", REPLY[:33], REPLY.replace(b"EDAC40", b"MCHPXX"), REPLY.replace(b"-", b":"), b"\xff" * 40],
)
def test_other_replies_are_not_units(reply: bytes) -> None:
    assert discovery.parse_reply(reply, "10.0.0.7") is None


@pytest.mark.slow
def test_discovery_over_the_loopback(capsys: pytest.CaptureFixture[str]) -> None:
    with Edac40UdpUnit() as unit:
        port = unit.discovery_port  # type: ignore[attr-defined]
        units = discovery.discover("127.0.0.1", port, 1.0)
        assert units == [discovery.Unit("EDAC40", "00-04-A3-12-34-56", "127.0.0.1")]
        assert unit.questions[0] == b"Discovery: Who is out there?"  # type: ignore[attr-defined]
        assert discover.main(["--address", "127.0.0.1", "--port", str(port), "--timeout", "1.0"]) == 0
        assert capsys.readouterr().out == "EDAC40  00-04-A3-12-34-56  127.0.0.1\n"
        unit.unplug()
        assert discover.main(["--address", "127.0.0.1", "--port", str(port), "--timeout", "0.05"]) == 1
        assert "no EDAC40 answered" in capsys.readouterr().err
        assert discover.main(["--address", "192.168..5"]) == 1
        assert "discovery failed at 192.168..5:30303" in capsys.readouterr().err
