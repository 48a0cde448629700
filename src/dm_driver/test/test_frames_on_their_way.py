"""Frames that may be lost on their way must not become steps."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from dm_driver.driver_configuration import build_configuration
from dm_driver.driver_parameters import PARAMETERS
from dm_driver.electronics.base import ElectronicsSettings, LinkError
from dm_driver.electronics.edac40 import Edac40Tcp, Edac40Udp, encode_frame

WIRED = np.ones(40, dtype=np.bool_)
DOUBT = 1000


def codes(value: int) -> np.ndarray:
    return np.full(40, value, dtype=np.uint16)


@pytest.fixture
def deaf() -> Iterator[socket.socket]:
    """A listener whose connections take little and read nothing."""
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        listener.bind(("127.0.0.1", 0))
        listener.listen(1)
        yield listener


def until_something_waits(unit: Edac40Tcp) -> None:
    """Send the same shape until the unit's TCP takes no more."""
    for _ in range(1000):
        unit.write(codes(0), WIRED)
        if unit._on_the_way():
            time.sleep(0.1)  # time for an acknowledgement
            if unit._on_the_way():
                return
    raise AssertionError("everything was taken")


@pytest.mark.slow
def test_a_large_change_waits_for_the_acknowledgement_and_is_not_sent_without(deaf: socket.socket) -> None:
    with Edac40Tcp(ElectronicsSettings("127.0.0.1", deaf.getsockname()[1], timeout_s=0.5, doubt=DOUBT)) as unit:
        connection, _ = deaf.accept()
        until_something_waits(unit)
        unit.write(codes(DOUBT // 2), WIRED)
        with pytest.raises(LinkError, match=r"no acknowledgement within 0.5 s|timed out"):
            unit.write(codes(DOUBT), WIRED)
    connection.settimeout(5.0)
    arrived = b""
    try:
        while part := connection.recv(65536):
            arrived += part
    except ConnectionResetError:
        pass
    assert encode_frame(codes(DOUBT), WIRED) not in arrived
    connection.close()


def test_a_process_that_stands_still_while_it_waits_asks_once_more() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        with Edac40Tcp(ElectronicsSettings("127.0.0.1", listener.getsockname()[1], timeout_s=0.1, doubt=DOUBT)) as unit:
            unit.write(codes(0), WIRED)
            answers = iter((86, 0))  # bytes on their way

            def asked() -> int:
                time.sleep(0.2)
                return next(answers)

            unit._on_the_way = asked  # type: ignore[method-assign]
            unit.write(codes(60_000), WIRED)


def test_a_large_change_goes_at_once_when_everything_has_arrived() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        with Edac40Tcp(ElectronicsSettings("127.0.0.1", listener.getsockname()[1], timeout_s=5.0, doubt=DOUBT)) as unit:
            connection, _ = listener.accept()
            frames = [codes(value) for value in (0, 60_000, 0, 60_000)]
            for frame in frames:
                unit.write(frame, WIRED)
            wanted = b"".join(encode_frame(frame, WIRED) for frame in frames)
            connection.settimeout(5.0)
            assert connection.recv(len(wanted), socket.MSG_WAITALL) == wanted
            connection.close()


def test_the_last_datagram_is_sent_three_times_in_all() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        server.settimeout(0.2)
        with Edac40Udp(ElectronicsSettings("127.0.0.1", server.getsockname()[1])) as unit:
            unit.write(codes(7), WIRED)
            for _ in range(5):
                unit.check()
            arrived = []
            with pytest.raises(TimeoutError):
                while True:
                    arrived.append(server.recv(2048))
    assert arrived == 3 * [encode_frame(codes(7), WIRED)]


def configured(kind: str, **more: Any) -> Any:
    values = {parameter.name: parameter.default for parameter in PARAMETERS}
    volts = {"volts.dac_at_zero": 0.0, "volts.dac_at_full": 5.0, "volts.amplifier_gain": 80.0}
    place = {"mirror.serial": "1", "electronics.kind": kind, "electronics.address": "127.0.0.1"}
    return build_configuration(values | volts | place | {"volts.min": 0.0, "volts.max": 300.0} | more)


def test_ramps_are_finer_where_frames_may_be_lost() -> None:
    tcp, udp = configured("edac40_tcp"), configured("edac40_udp")
    assert tcp.limiter.limits.step == pytest.approx(0.1)
    assert udp.limiter.limits.step == pytest.approx(0.1 / 3)
    assert tcp.settings.doubt == math.floor(0.1 / tcp.output.scale.resolution)


def test_waiting_for_acknowledgements_can_be_switched_off() -> None:
    assert configured("edac40_tcp", **{"electronics.await_arrival": False}).settings.doubt == 0
