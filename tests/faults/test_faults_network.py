"""Driver and controller on two hosts with a bad cable between them."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from fault_injection import fault as faults
from fault_injection.fault import Fault, FaultRecord, run_faults
from fault_injection.faults.registry import select
from fault_injection.rigs.netem import Netem, bad_network
from studies.network_namespaces import NotPermittedError, inside

pytestmark = pytest.mark.processes

DATAGRAMS = 2000


@pytest.fixture
def wire() -> Iterator[tuple[Netem, socket.socket, socket.socket]]:
    """A cable, and a socket on each of its hosts."""
    try:
        with bad_network(Random(3)) as (left, right, cable):
            ends: list[socket.socket] = []
            for number, host in enumerate((left, right), 1):
                with inside(host):
                    end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                end.bind((f"10.77.0.{number}", 5000))
                end.settimeout(5.0)
                ends.append(end)
            ends[0].sendto(b"first", ("10.77.0.2", 5000))  # the two learn each other's addresses
            assert ends[1].recv(10) == b"first"
            yield cable, ends[0], ends[1]
            for end in ends:
                end.close()
    except NotPermittedError as reason:
        pytest.skip(str(reason))


def received(end: socket.socket, wait_s: float = 1.0) -> int:
    """Datagrams until none comes for so long."""
    end.settimeout(wait_s)
    count = 0
    try:
        while end.recv(10):
            count += 1
    except TimeoutError:
        return count
    raise AssertionError("an empty datagram")


def test_the_cable_loses_the_share_it_is_told(wire: tuple[Netem, socket.socket, socket.socket]) -> None:
    cable, left, right = wire
    cable.loss = 0.05
    got = 0
    for _ in range(20):
        for _ in range(DATAGRAMS // 20):
            left.sendto(b"x", ("10.77.0.2", 5000))
        got += received(right, 0.25)
    got += received(right)  # those that a busy machine delivers late
    assert 1.0 - got / DATAGRAMS == pytest.approx(0.05, abs=0.02)  # four standard deviations


def test_a_cable_that_is_cut_carries_nothing(wire: tuple[Netem, socket.socket, socket.socket]) -> None:
    cable, left, right = wire
    cable.plugged = False
    left.sendto(b"x", ("10.77.0.2", 5000))
    assert received(right) == 0
    cable.plugged = True
    left.sendto(b"x", ("10.77.0.2", 5000))
    assert received(right) == 1


@pytest.mark.parametrize("name", ["frames_lost", "frames_delayed", "partition", "late_joiner"])
def test_a_bad_network_harms_and_loses_nothing(name: str, tmp_path: Path, domain: int) -> None:
    (record,) = run_faults(select([name]), tmp_path, domain, seed=2013)
    if record.skipped:
        pytest.skip(record.skipped)
    assert record.harmless, str(record.figures())
    assert len(record.recovery_s) == record.injected > 0


def test_what_is_not_permitted_is_left_out_with_the_reason(tmp_path: Path) -> None:
    def run(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
        raise faults.NotPermittedError("no namespaces here")

    (record,) = run_faults([Fault("net", "", run)], tmp_path, 0)
    assert record.harmless
    assert record.figures()["skipped"] == "no namespaces here" and record.figures()["injected"] == 0
