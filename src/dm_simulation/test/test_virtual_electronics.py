"""The virtual drive electronics: published test vectors, sockets and a pseudo-terminal, and the watch on the frames."""

from __future__ import annotations

import errno
import os
import socket
import struct
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import serial

from dm_simulation.electronics.drive_unit import TRIHEX, DriveConfig, DriveUnit
from dm_simulation.electronics.frames import FrameError, decode_dac40, decode_edac40
from dm_simulation.electronics.monitor import Monitor, MonitorConfig
from dm_simulation.electronics.server import ElectronicsServer, PortsConfig
from dm_simulation.mirror.plate import Plate, PlateConfig, neighbour_pairs
from waiting import wait_until

# The decoders, against the published vectors and a frame put together bit by bit.


def test_edac40_vectors() -> None:
    one = decode_edac40(bytes.fromhex("40 00 00 00 00 00 34 12"))
    assert (one.command, list(one.channels), list(one.values)) == (0, [0], [0x1234])
    three = decode_edac40(bytes.fromhex("c0 00 00 02 00 00 01 00 03 02 cd ab"))
    # Physical channels 6, 7, 25 are connector channels 0, 1, 39; the values come in order of the physical ones.
    assert dict(zip(three.channels.tolist(), three.values.tolist(), strict=True)) == {0: 1, 1: 0x0203, 39: 0xABCD}
    trihex = decode_edac40(bytes.fromhex("00 40 01 01 00 00 00 80 ff 7f ff ff"))
    by_channel = dict(zip(trihex.channels.tolist(), trihex.values.tolist(), strict=True))
    assert [by_channel[channel] for channel in TRIHEX[:3]] == [0x7FFF, 0x8000, 0xFFFF]


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        ("40 00 00 00 00 00 34", "at least 8"),
        ("40 00 00 00 00 00 34 12 00", "its mask asks for 8"),
        ("00 00 00 00 00 00 34 12", "empty channel mask"),
        ("40 00 00 00 00 05 34 12", "unknown EDAC40 command 5"),
    ],
)
def test_edac40_refuses_what_is_no_frame(frame: str, reason: str) -> None:
    with pytest.raises(FrameError, match=reason):
        decode_edac40(bytes.fromhex(frame))


DAC40_TABLE = (
    *(7, 15, 23, 31, 39, 6, 14, 22, 30, 38, 5, 13, 21, 29, 37, 4, 12, 20, 28, 36),
    *(3, 11, 19, 27, 35, 2, 10, 18, 26, 34, 1, 9, 17, 25, 33, 0, 8, 16, 24, 32),
)


def dac40_frame(codes: list[int]) -> bytes:
    """Bit by bit, as the description of the frame says."""
    frame = bytearray([0xFF])
    for group in range(8):
        frame.append(0)
        for bit in (2, 1, 0):
            frame.append(0x1F if group >> bit & 1 else 0)
        for bit in range(11, -1, -1):
            byte = 0
            for chip in range(5):
                byte |= (codes[DAC40_TABLE[5 * group + chip]] >> bit & 1) << chip
            frame.append(byte)
    frame.append(0)
    assert len(frame) == 130
    return bytes(frame)


def test_dac40_round_trip() -> None:
    codes = [(37 * channel + 5) % 4096 for channel in range(40)]
    decoded = decode_dac40(dac40_frame(codes))
    assert decoded is not None
    assert decoded.tolist() == codes
    assert decode_dac40(bytes(130)) is None


@pytest.mark.parametrize(
    ("position", "value", "reason"), [(129, 1, "last 0x01"), (2, 0x1F, "addresses"), (6, 0x20, "five")]
)
def test_dac40_refuses_what_is_no_frame(position: int, value: int, reason: str) -> None:
    frame = bytearray(dac40_frame([0] * 40))
    frame[position] = value
    with pytest.raises(FrameError, match=reason):
        decode_dac40(bytes(frame))


# Codes to volts to signals.


def edac40_all(code: int) -> bytes:
    return b"\xff" * 5 + b"\0" + struct.pack("<40H", *[code] * 40)


def test_from_codes_to_signals() -> None:
    unit = DriveUnit(DriveConfig())
    np.testing.assert_allclose(unit.signals(), -1)  # 0 V after power-up
    unit.take_edac40(decode_edac40(edac40_all(round(150 / 400 * 65535))))
    np.testing.assert_allclose(unit.actuator_volts(), 150, atol=0.004)
    np.testing.assert_allclose(unit.signals(), 0, atol=3e-5)
    unit.take_shares(np.ones(40))
    np.testing.assert_allclose(unit.actuator_volts(), 400)
    np.testing.assert_allclose(unit.signals(), 400 / 150 - 1)  # beyond the range: told, not hidden


def test_factory_settings_give_minus_six_volts_at_code_zero_and_the_amplifier_saturates() -> None:
    factory = DriveConfig(dac_volts_at_zero=-6.0, dac_volts_at_full=6.0)
    unit = DriveUnit(factory)
    np.testing.assert_allclose(unit.actuator_volts(), 0, atol=1e-9)
    unit.take_edac40(decode_edac40(edac40_all(0)))
    np.testing.assert_allclose(unit.actuator_volts(), 0)  # -480 V asked, 0 V is the least the amplifier gives
    unit = DriveUnit(replace(factory, amplifier_min=-1000.0, amplifier_max=1000.0))
    unit.take_edac40(decode_edac40(edac40_all(0)))
    np.testing.assert_allclose(unit.actuator_volts(), -480)


def test_a_unit_of_either_sign_is_at_zero_volts_after_power_up() -> None:
    bimorph = DriveConfig(40, -6.0, 6.0, 80.0, -480.0, 480.0, volts_min=-200.0, volts_max=400.0)
    unit = DriveUnit(bimorph)
    np.testing.assert_allclose(unit.actuator_volts(), 0, atol=1e-9)
    np.testing.assert_allclose(unit.signals(), -1 / 3)
    unit.take_shares(np.zeros(40))
    np.testing.assert_allclose(unit.actuator_volts(), -480)


def test_true_wiring_and_channels_not_in_the_mask_hold() -> None:
    swapped = (TRIHEX[1], TRIHEX[0], *TRIHEX[2:])
    unit = DriveUnit(DriveConfig(wiring=swapped))
    unit.take_edac40(decode_edac40(bytes.fromhex("00 40 01 01 00 00 00 80 ff 7f ff ff")))
    codes = unit.actuator_volts() / 400 * 65535
    np.testing.assert_allclose(codes[:3], [0x8000, 0x7FFF, 0xFFFF])
    np.testing.assert_allclose(codes[3:], 0)


def test_settings_frames_change_the_outputs_and_are_counted() -> None:
    """dac = IN (M + 1)/65536 + C - 32768, and the global offset shifts by four steps each."""
    unit = DriveUnit(DriveConfig())
    unit.take_edac40(decode_edac40(edac40_all(0x4000)))
    offset = bytearray(edac40_all(0x8000 + 256))
    offset[5] = 1
    unit.take_edac40(decode_edac40(bytes(offset)))
    np.testing.assert_allclose(unit.outputs * 65535, 0x4000 + 256)
    gain = bytearray(edac40_all(0x7FFF))
    gain[5] = 2
    unit.take_edac40(decode_edac40(bytes(gain)))
    np.testing.assert_allclose(unit.outputs * 65535, 0x2000 + 256)
    assert unit.settings_frames == 2


@pytest.mark.parametrize(
    ("config", "name"),
    [
        (DriveConfig(wiring=(1,) * 37), "wiring"),
        (DriveConfig(wiring=()), "wiring"),
        (DriveConfig(wiring=(*TRIHEX[:-1], 40)), "wiring"),
        (DriveConfig(dac_volts_at_full=0.0), "dac_volts_at_full"),
        (DriveConfig(volts_max=0.0), "volts.max"),
        (DriveConfig(volts_min=-300.0, squared=True), "volts.max squared - volts.min squared"),
        (DriveConfig(volts_min=-200.0), "volts.min = -200 V: must be 0 to 400 V, where electronics"),
        (DriveConfig(volts_min=-200.0, amplifier_min=-480.0), "volts.min = -200 V: must be 0 to 400 V"),
        (DriveConfig(dac_volts_at_full=3.0), "volts.max = 300 V: must be 0 to 240 V"),
        (DriveConfig(volts_max=450.0), "volts.max = 450 V: must be 0 to 400 V"),
        (DriveConfig(amplifier_min=500.0), "amplifier_min = 500 V: must be below electronics.amplifier_max, 400 V"),
    ],
)
def test_inconsistent_configurations_are_refused(config: DriveConfig, name: str) -> None:
    with pytest.raises(ValueError, match=name):
        DriveUnit(config)


# The monitor.


def test_monitor_counts_what_breaks_a_limit() -> None:
    plate = Plate(PlateConfig(order=12))
    monitor = Monitor(
        MonitorConfig(jump=0.1, neighbour_difference=0.5), neighbour_pairs(plate.x, plate.y), np.zeros(37)
    )
    shape = np.full(37, 0.1)
    assert monitor.watch(shape) == ""
    shape[0] = 0.65
    assert "actuator 1 jumped by 0.5500, limit 0.1" in monitor.watch(shape)
    assert "differ by 0.5500" in monitor.watch(shape)
    assert "to 1.3000, allowed -1 to 1" in monitor.watch(np.full(37, 1.3))
    record = monitor.record
    assert (record.frames, record.jumps, record.neighbour_violations, record.range_violations) == (4, 2, 2, 1)
    assert record.largest_jump == pytest.approx(1.2)
    assert record.highest_signal == pytest.approx(1.3)
    assert record.violations == 5


def test_monitor_of_a_single_actuator_has_no_neighbours_to_compare() -> None:
    monitor = Monitor(MonitorConfig(jump=0.1), neighbour_pairs(np.zeros(1), np.zeros(1)), np.zeros(1))
    assert monitor.watch(np.full(1, 0.1)) == ""
    assert monitor.record.largest_neighbour_difference == 0.0


# The server, over real sockets.


class ServedUnit:
    """A server on free ports, and what it told."""

    def __init__(self, folder: Path) -> None:
        self.unit = DriveUnit(DriveConfig())
        self.updates = 0
        self.events: list[str] = []
        self.severe: list[str] = []
        self.link = folder / "ttyDAC40"
        ports = PortsConfig(0, 0, 0, str(self.link))
        self.server = ElectronicsServer(self.unit, ports, self.count, self.take)

    def count(self) -> None:
        self.updates += 1

    def take(self, severe: bool, text: str) -> None:
        self.events.append(text)
        if severe:
            self.severe.append(text)

    def port(self, name: str) -> int:
        return int(self.server.endpoints[name])

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port("tcp_port")), timeout=5)

    def codes(self) -> list[int]:
        """Sees every frame sent before the call."""
        return self.server.run(lambda: np.rint(self.unit.outputs * 65535).astype(int).tolist())


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[ServedUnit]:
    made = ServedUnit(tmp_path)
    yield made
    made.server.close()


def test_tcp_frames_in_any_pieces_and_in_order(bench: ServedUnit) -> None:
    stream = b"".join(edac40_all(code) for code in (1, 2, 3, 400))
    with bench.connect() as client:
        client.sendall(stream[:7])
        client.sendall(stream[7:200])
        client.sendall(stream[200:])
        wait_until(lambda: bench.updates == 4)
        assert bench.codes() == [400] * 40
    assert bench.server.malformed_count == 0


def test_a_question_sees_every_frame_sent_before_it(bench: ServedUnit) -> None:
    with bench.connect() as client:
        client.sendall(edac40_all(7))
        wait_until(lambda: bench.updates == 1)
        for code in range(1000, 1050):
            client.sendall(edac40_all(code))
            assert bench.codes() == [code] * 40


def test_a_question_asked_while_another_is_answered_sees_the_frames_before_it(bench: ServedUnit) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def slow() -> None:
        begun.set()
        go_on.wait(10)

    with bench.connect() as client, ThreadPoolExecutor(2) as pool:
        client.sendall(edac40_all(1))
        wait_until(lambda: bench.updates == 1)
        first = pool.submit(bench.server.run, slow)
        assert begun.wait(10)
        client.sendall(edac40_all(2))
        second = pool.submit(bench.codes)
        time.sleep(0.05)  # for the second question to be handed in; without it the test is only weaker
        go_on.set()
        first.result(10)
        assert second.result(10) == [2] * 40


def test_a_second_tcp_client_is_refused_until_the_first_has_gone(bench: ServedUnit) -> None:
    first = bench.connect()
    first.sendall(edac40_all(5))
    wait_until(lambda: bench.updates == 1)
    with pytest.raises(ConnectionRefusedError):
        bench.connect()
    first.close()
    wait_until(lambda: any("TCP client gone" in event for event in bench.events))
    assert bench.codes() == [5] * 40  # outputs hold when the client dies
    with bench.connect() as third:
        third.sendall(edac40_all(6))
        wait_until(lambda: bench.updates == 2)


def test_malformed_frames_are_recorded_and_change_nothing(bench: ServedUnit) -> None:
    with bench.connect() as client:
        client.sendall(bytes.fromhex("40 00 00 00 00 09 34 12"))
        wait_until(lambda: bench.server.malformed_count == 1)
        client.sendall(edac40_all(9))
        wait_until(lambda: bench.updates == 1)
        client.sendall(edac40_all(10)[:50])
    wait_until(lambda: bench.server.malformed_count == 2)
    first, second = bench.severe
    assert first.startswith("malformed") and "TCP client connected" in bench.events
    assert "unknown EDAC40 command 9" in first and "inside a frame" in second
    assert bench.codes() == [9] * 40


def test_udp_and_discovery(bench: ServedUnit) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5)
        client.sendto(edac40_all(77), ("127.0.0.1", bench.port("udp_port")))
        wait_until(lambda: bench.updates == 1)
        client.sendto(edac40_all(78)[:-1], ("127.0.0.1", bench.port("udp_port")))
        wait_until(lambda: bench.server.malformed_count == 1)
        assert bench.codes() == [77] * 40
        client.sendto(b"Discovery: Who is out there?", ("127.0.0.1", bench.port("discovery_port")))
        answer = client.recv(1024)
    assert answer[:6] == b"EDAC40"
    assert answer[6:17].strip(b" ") == b""
    assert len(answer[17:34].split(b"-")) == 6


def test_usb_dac40_on_a_pseudo_terminal(bench: ServedUnit) -> None:
    codes = [(101 * channel) % 4096 for channel in range(40)]
    with serial.Serial(str(bench.link), 115200, timeout=1) as port:
        port.write(bytes(130))
        frame = dac40_frame(codes)
        port.write(frame[:60])
        port.flush()
        port.write(frame[60:])
        wait_until(lambda: bench.updates == 1)
    held = bench.server.run(lambda: np.rint(bench.unit.outputs * 4095).astype(int).tolist())
    assert held == codes  # also after the client closed the port
    with serial.Serial(str(bench.link), 115200, timeout=1) as port:
        port.write(b"\x01\x02\x03" + dac40_frame([4095] * 40) + dac40_frame([1] * 40))
        wait_until(lambda: bench.updates >= 3)
    assert bench.server.malformed_count >= 1
    assert bench.server.run(lambda: np.rint(bench.unit.outputs * 4095).astype(int).tolist()) == [1] * 40


def test_unplugging_and_plugging_in_again(bench: ServedUnit) -> None:
    client = bench.connect()
    client.sendall(edac40_all(50))
    wait_until(lambda: bench.updates == 1)
    ports = dict(bench.server.endpoints)
    bench.server.set_plugged(False)
    client.settimeout(5)
    with client:
        try:
            assert client.recv(1) == b""
        except ConnectionResetError:
            pass
    with pytest.raises(ConnectionRefusedError):
        bench.connect()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as datagrams:
        datagrams.connect(("127.0.0.1", bench.port("udp_port")))
        with pytest.raises(OSError) as refused:
            for _ in range(50):
                datagrams.send(edac40_all(1))
                time.sleep(0.01)
        assert refused.value.errno == errno.ECONNREFUSED
    assert not os.path.lexists(bench.link)
    assert bench.codes() == [50] * 40
    bench.server.set_plugged(True)
    assert dict(bench.server.endpoints) == ports
    with bench.connect() as again:
        again.sendall(edac40_all(51))
        wait_until(lambda: bench.updates == 2)


def test_a_taken_port_is_named(bench: ServedUnit) -> None:
    taken = bench.port("tcp_port")
    with pytest.raises(OSError, match=f"electronics.tcp_port = {taken}"):
        ElectronicsServer(bench.unit, PortsConfig(taken, -1, -1), lambda: None)


def test_a_link_that_is_a_file_is_left_alone(bench: ServedUnit, tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("data")
    with pytest.raises(OSError, match="pty_link"):
        ElectronicsServer(bench.unit, PortsConfig(-1, -1, -1, str(precious)), lambda: None)
    assert precious.read_text() == "data"
