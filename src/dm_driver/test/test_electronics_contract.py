"""What every back end must do, against real sockets and a real pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dm_driver.electronics import BACK_ENDS
from dm_driver.electronics.base import CodeError, DriveElectronics, ElectronicsSettings, LinkError, NotOpenError
from dm_driver.electronics.edac40 import Edac40Tcp
from drive_unit_servers import UNITS, DriveUnit, Edac40TcpUnit, Edac40UdpUnit
from waiting import wait_until

CHANNELS = 40
MICROSCOPE_MISSING = "no microscope; run it with: ./dm exec python -m pip install -r requirements/test-oracles.txt"


#: By name; the device server of python-microscope is a program of its own.
KINDS = [
    pytest.param(kind, marks=pytest.mark.processes) if kind == "microscope" else kind for kind in sorted(BACK_ENDS)
]


@pytest.fixture(params=KINDS)
def unit(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[DriveUnit]:
    if request.param == "microscope":
        pytest.importorskip("microscope", reason=MICROSCOPE_MISSING)
    with UNITS[request.param](tmp_path) as server:
        yield server


@pytest.fixture
def electronics(unit: DriveUnit) -> Iterator[DriveElectronics]:
    back_end = BACK_ENDS[unit.kind](settings_of(unit))
    yield back_end
    back_end.close()


def settings_of(unit: DriveUnit) -> ElectronicsSettings:
    values: dict[str, Any] = unit.settings
    return ElectronicsSettings(timeout_s=1.0, **values)


def random_frame(electronics: DriveElectronics, seed: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    codes = generator.integers(0, electronics.max_code, CHANNELS, dtype=np.uint16, endpoint=True)
    wired = generator.random(CHANNELS) < 0.8
    wired[seed % CHANNELS] = True
    return codes, wired


def fail_soon(action: Any, timeout_s: float = 5.0) -> None:
    """Repeat `action` until it raises LinkError."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        try:
            action()
        except LinkError:
            return
        time.sleep(0.02)
    raise AssertionError("the broken link was not noticed")


class TestContract:
    def test_every_unit_takes_forty_channels(self, electronics: DriveElectronics) -> None:
        assert electronics.channels == CHANNELS
        assert electronics.max_code in (0xFFF, 0xFFFF)

    def test_codes_arrive_on_their_channels_in_order(self, unit: DriveUnit, electronics: DriveElectronics) -> None:
        sent = [random_frame(electronics, seed) for seed in range(25)]
        with electronics:
            for codes, wired in sent:
                electronics.write(codes, wired)
            wait_until(lambda: len(unit.frames) == len(sent), what="all frames")
        for (codes, wired), frame in zip(sent, unit.frames, strict=True):
            assert set(np.flatnonzero(wired)) <= set(frame)
            for channel in np.flatnonzero(wired):
                assert frame[int(channel)] == codes[channel]

    def test_full_scale_and_zero(self, unit: DriveUnit, electronics: DriveElectronics) -> None:
        every = np.ones(CHANNELS, dtype=np.bool_)
        with electronics:
            for code in (0, electronics.max_code):
                electronics.write(np.full(CHANNELS, code, dtype=np.uint16), every)
            wait_until(lambda: len(unit.frames) == 2)
        assert set(unit.frames[0].values()) == {0}
        assert set(unit.frames[1].values()) == {electronics.max_code}

    def test_opening_and_closing_twice_is_harmless_and_writes_no_outputs(
        self, unit: DriveUnit, electronics: DriveElectronics
    ) -> None:
        for _ in range(2):
            electronics.open()
            assert electronics.is_open
        electronics.check()
        for _ in range(2):
            electronics.close()
            assert not electronics.is_open
        assert unit.frames == []

    def test_bad_codes_are_refused_and_nothing_is_sent(self, unit: DriveUnit, electronics: DriveElectronics) -> None:
        codes, wired = np.zeros(CHANNELS, dtype=np.uint16), np.ones(CHANNELS, dtype=np.bool_)
        too_large = np.full(CHANNELS, electronics.max_code + 1, dtype=np.uint32)
        with electronics:
            cases: tuple[tuple[Any, Any], ...] = (
                (codes[:-1], wired),
                (codes.astype(np.int16), wired),
                (codes.astype(np.float64), wired),
                (too_large, wired),
                (codes, wired[:-1]),
                (codes, wired.astype(np.uint8)),
                (codes, np.zeros(CHANNELS, dtype=np.bool_)),
            )
            for bad_codes, bad_wired in cases:
                with pytest.raises(CodeError):
                    electronics.write(bad_codes, bad_wired)
            electronics.write(codes, wired)
            wait_until(lambda: unit.frames)
        assert len(unit.frames) == 1

    def test_a_closed_link_is_not_written_to(self, electronics: DriveElectronics) -> None:
        codes, wired = random_frame(electronics, 1)
        with pytest.raises(NotOpenError):
            electronics.write(codes, wired)
        with pytest.raises(NotOpenError):
            electronics.check()

    @pytest.mark.slow
    @pytest.mark.parametrize("how", ["write", "check"])
    def test_an_unplugged_unit_is_noticed_and_its_return_taken(
        self, unit: DriveUnit, electronics: DriveElectronics, how: str
    ) -> None:
        codes, wired = random_frame(electronics, 2)
        electronics.open()
        electronics.write(codes, wired)
        wait_until(lambda: unit.frames)
        unit.unplug()
        # A datagram alone never fails when discovery is there to tell.
        fail_soon(
            electronics.check
            if how == "check" or unit.kind == "edac40_udp"
            else lambda: electronics.write(codes, wired)
        )
        assert not electronics.is_open
        with pytest.raises(NotOpenError):
            electronics.write(codes, wired)
        with pytest.raises(LinkError, match="cannot open"):
            electronics.open()
        unit.plug()
        frames = len(unit.frames)
        electronics.open()
        electronics.write(codes, wired)
        wait_until(lambda: len(unit.frames) > frames)

    @pytest.mark.slow
    def test_a_unit_that_is_off_cannot_be_opened(self, unit: DriveUnit, electronics: DriveElectronics) -> None:
        unit.unplug()
        with pytest.raises(LinkError, match=r"cannot open .*(127\.0\.0\.1|ttyUSB)"):
            electronics.open()

    @pytest.mark.slow
    def test_a_standing_link_passes_every_check(self, unit: DriveUnit, electronics: DriveElectronics) -> None:
        with electronics:
            end = time.monotonic() + 1.5  # well beyond the time-out
            while time.monotonic() < end:
                electronics.check()
                time.sleep(0.05)

    @pytest.mark.slow
    def test_a_process_that_stands_still_in_a_write_loses_no_link(
        self, unit: DriveUnit, electronics: DriveElectronics, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """It was stopped, or others kept it from running, for longer than the time-out: the unit has its frame."""

        def then_still(write: Any) -> Any:
            def written(*arguments: Any) -> Any:
                length = write(*arguments)
                if threading.current_thread() is threading.main_thread():
                    time.sleep(1.2)
                return length

            return written

        codes, wired = random_frame(electronics, 3)
        electronics.open()
        monkeypatch.setattr(os, "write", then_still(os.write))
        monkeypatch.setattr(socket.socket, "send", then_still(socket.socket.send), raising=False)
        electronics.write(codes, wired)
        electronics.check()
        wait_until(lambda: unit.frames)

    def test_a_missing_setting_is_named(self, unit: DriveUnit) -> None:
        with pytest.raises(ValueError, match=r"electronics\.(address|serial_port) is empty"):
            BACK_ENDS[unit.kind](ElectronicsSettings())


def test_what_a_makers_library_raises_breaks_the_link(monkeypatch: pytest.MonkeyPatch) -> None:
    def apply_pattern(_pattern: np.ndarray) -> None:
        raise RuntimeError("overheated")

    mirror = SimpleNamespace(n_actuators=CHANNELS, apply_pattern=apply_pattern, _pyroRelease=lambda: None)
    pyro = SimpleNamespace(Proxy=lambda _address: mirror, errors=SimpleNamespace(PyroError=OSError))
    monkeypatch.setitem(sys.modules, "Pyro4", pyro)
    with BACK_ENDS["microscope"](ElectronicsSettings("PYRO:Mirror@127.0.0.1:8000")) as electronics:
        with pytest.raises(LinkError, match="overheated"):
            electronics.write(*random_frame(electronics, 1))
        assert not electronics.is_open


@pytest.mark.parametrize("kind", ["edac40_tcp", "edac40_udp"])
@pytest.mark.parametrize("address", ["10.0.0.5:1234", "socket://10.0.0.5", "10.0.0.5/24", "fe80::1", " 10.0.0.5"])
def test_an_address_holds_no_port_and_nothing_else(kind: str, address: str) -> None:
    with pytest.raises(ValueError, match=r"host name or IPv4 address; its port is electronics.port"):
        BACK_ENDS[kind](ElectronicsSettings(address))


@pytest.mark.slow
def test_tcp_notices_between_writes_that_the_unit_closed() -> None:
    with Edac40TcpUnit() as unit:
        electronics = BACK_ENDS["edac40_tcp"](settings_of(unit))
        codes, wired = random_frame(electronics, 3)
        electronics.open()
        electronics.write(codes, wired)
        wait_until(lambda: unit.frames)
        unit.drop_client()  # type: ignore[attr-defined]
        fail_soon(electronics.check)
        electronics.open()
        electronics.write(codes, wired)
        wait_until(lambda: len(unit.frames) == 2)
        electronics.close()


def test_another_service_that_sends_without_end_holds_nobody_up() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        electronics = Edac40Tcp(ElectronicsSettings("127.0.0.1", listener.getsockname()[1]))
        electronics.open()
        service, _ = listener.accept()

        def send() -> None:
            with contextlib.suppress(OSError):
                while True:
                    service.sendall(bytes(65536))

        endless, check = (threading.Thread(target=work, daemon=True) for work in (send, electronics.check))
        endless.start()
        check.start()
        check.join(5.0)
        returned = not check.is_alive()
        service.shutdown(socket.SHUT_RDWR)  # which ends both
        endless.join(5.0)
        check.join(5.0)
        service.close()
        electronics.close()
    assert returned


@pytest.mark.slow
def test_a_second_tcp_client_finds_the_unit_taken() -> None:
    with Edac40TcpUnit() as unit:
        with BACK_ENDS["edac40_tcp"](settings_of(unit)) as first:
            wait_until(lambda: unit.clients == 1)  # type: ignore[attr-defined]
            second = BACK_ENDS["edac40_tcp"](settings_of(unit))
            second.open()
            fail_soon(second.check)
            first.check()


def test_udp_without_discovery_notices_a_closed_port() -> None:
    with Edac40UdpUnit(discovery=False) as unit:
        electronics = BACK_ENDS["edac40_udp"](settings_of(unit))
        codes, wired = random_frame(electronics, 4)
        with electronics:
            electronics.write(codes, wired)
            wait_until(lambda: unit.frames)
            electronics.check()
            unit.unplug()
            fail_soon(lambda: electronics.write(codes, wired))
            assert not electronics.is_open


@pytest.mark.slow
def test_answers_that_came_twice_are_no_sign_of_life_later() -> None:
    with Edac40UdpUnit(copies=2) as unit, BACK_ENDS["edac40_udp"](settings_of(unit)) as electronics:
        for _ in range(100):
            electronics.check()
            time.sleep(0.005)
        unit.unplug()
        fail_soon(electronics.check, 2.5)  # a hundred old answers would last longer
