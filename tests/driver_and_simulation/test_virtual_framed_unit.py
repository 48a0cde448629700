"""The virtual serial unit of one's own: what the driver encodes it decodes, and what is wrong it rejects."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dm_driver.electronics.base import ElectronicsSettings
from dm_driver.electronics.check_sums import CHECK_SUMS
from dm_driver.electronics.frame_format import FrameFormat
from dm_driver.electronics.framed_serial import FramedSerial
from dm_simulation.electronics.drive_unit import DriveConfig, DriveUnit
from dm_simulation.electronics.framed_unit import CHECK_LENGTH, FramedConfig, FramedDecoder, check_value
from dm_simulation.electronics.frames import FrameError
from dm_simulation.electronics.server import OFF, ElectronicsServer, PortsConfig
from support import wait_until

SHEET: dict[str, Any] = {
    "channels": 24,
    "bits": 14,
    "header": "A5 5A",
    "terminator": "0D",
    "scale": 4,
    "checksum": "crc16_ccitt_false",
    "reply": "06",
}


@pytest.mark.parametrize("name", sorted(CHECK_SUMS))
@settings(max_examples=25)
@given(data=st.binary(max_size=60))
def test_both_sides_compute_the_same_check_sums(name: str, data: bytes) -> None:
    assert check_value(name, data) == CHECK_SUMS[name].of(data)
    assert CHECK_LENGTH[name] == CHECK_SUMS[name].length


@pytest.mark.slow
@settings(max_examples=100)
@given(st.data())
def test_what_the_driver_encodes_the_unit_decodes(data: st.DataObject) -> None:
    channels, bits = data.draw(st.integers(1, 50)), data.draw(st.integers(1, 16))
    width = data.draw(st.sampled_from([0, *range(bits, 33)]))
    scale, offset = data.draw(st.sampled_from([(1, 0), (-1, 2**bits - 1), (1, -(2 ** (bits - 1))), (4, 0), (-3, 7)]))
    sheet: dict[str, Any] = {
        "channels": channels,
        "bits": bits,
        "word_bits": width,
        "scale": scale,
        "offset": offset,
        "header": data.draw(st.sampled_from(["", "AA", "A5 5A 01"])),
        "terminator": data.draw(st.sampled_from(["", "0D 0A"])),
        "channel_order": tuple(data.draw(st.permutations(range(channels)))),
        "byte_order": data.draw(st.sampled_from(["big", "little"])),
        "checksum": data.draw(st.sampled_from(sorted(CHECK_SUMS))),
        "checksum_covers_header": data.draw(st.booleans()),
        "checksum_byte_order": data.draw(st.sampled_from(["big", "little"])),
    }
    try:
        format = FrameFormat(**sheet)
    except ValueError:
        assume(False)
    codes = np.array(data.draw(st.lists(st.integers(0, 2**bits - 1), min_size=channels, max_size=channels)), np.uint16)
    stream = bytearray(format.encode(codes))
    assert len(stream) == format.frame_length
    outputs = FramedDecoder(FramedConfig(**sheet)).take(stream)
    assert outputs is not None and not stream
    assert np.rint(outputs * (2**bits - 1)).tolist() == codes.tolist()


@pytest.mark.parametrize(("place", "words"), [(0, "no header"), (10, "check sum"), (51, "check sum"), (52, "ends in")])
def test_a_damaged_frame_is_rejected_and_the_next_one_taken(place: int, words: str) -> None:
    decoder = FramedDecoder(FramedConfig(**SHEET))
    good = FrameFormat(**SHEET).encode(np.arange(24, dtype=np.uint16))
    bad = bytearray(good)
    bad[place] ^= 0x04
    stream = bad + good
    with pytest.raises(FrameError, match=words):
        decoder.take(stream)
    assert decoder.take(stream) is not None


@pytest.mark.parametrize("opening", ["55", "A5", "A5 5A", "A5 5A 01"])
def test_an_opening_may_begin_as_frames_do(opening: str) -> None:
    decoder = FramedDecoder(FramedConfig(**SHEET | {"opening": opening}))
    frame = FrameFormat(**SHEET).encode(np.arange(24, dtype=np.uint16))
    stream = bytearray.fromhex(opening) + frame + frame
    for _frame in range(2):
        assert decoder.take(stream) is not None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"header": "A"}, r"framed\.header = 'A'"),
        ({"channel_order": (0, 1)}, r"framed\.channel_order = \[0, 1\]: must hold each of 0 to 23"),
        ({"word_bits": 8}, r"framed\.word_bits = 8: must be at least framed\.bits = 14"),
        ({"scale": 0}, r"framed\.scale = 0"),
    ],
)
def test_a_senseless_sheet_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        FramedDecoder(FramedConfig(**SHEET | changes))


def test_more_words_than_outputs_are_refused(tmp_path: Path) -> None:
    ports = PortsConfig(OFF, OFF, OFF, str(tmp_path / "tty"), FramedConfig(**SHEET | {"channels": 41}))
    with pytest.raises(ValueError, match=r"framed\.channels = 41: must not exceed 40, the outputs"):
        ElectronicsServer(DriveUnit(DriveConfig(wiring=range(19), channels=24)), ports, lambda: None)


@pytest.fixture
def link(tmp_path: Path) -> Iterator[tuple[DriveUnit, ElectronicsServer, Path]]:
    unit, path = DriveUnit(DriveConfig(wiring=range(19), channels=24)), tmp_path / "made" / "tty"
    server = ElectronicsServer(
        unit, PortsConfig(OFF, OFF, OFF, str(path), FramedConfig(**SHEET, opening="55")), lambda: None
    )
    yield unit, server, path
    server.close()


def test_the_driver_and_the_unit_on_a_terminal(link: tuple[DriveUnit, ElectronicsServer, Path]) -> None:
    unit, server, path = link
    codes = np.linspace(0, 2**14 - 1, 24).astype(np.uint16)
    where = ElectronicsSettings(serial_port=str(path), frame=FrameFormat(**SHEET, opening="55"), timeout_s=10.0)
    with FramedSerial(where) as electronics:
        electronics.write(codes, np.ones(24, dtype=np.bool_))
        shares = server.run(lambda: unit.outputs[:24].copy())
    np.testing.assert_allclose(shares, codes / (2**14 - 1))
    np.testing.assert_allclose(unit.actuator_volts(), np.clip(400 * shares[:19], 0, 400))
    assert server.malformed_count == 0


def test_what_is_no_frame_is_counted(link: tuple[DriveUnit, ElectronicsServer, Path]) -> None:
    _unit, server, path = link
    frame = FrameFormat(**SHEET | {"reply": "", "checksum": "crc16_xmodem"})
    with FramedSerial(ElectronicsSettings(serial_port=str(path), frame=frame)) as electronics:
        electronics.write(np.zeros(24, dtype=np.uint16), np.ones(24, dtype=np.bool_))
        wait_until(lambda: server.malformed_count == 1)
