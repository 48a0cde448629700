"""Faults of the network between driver and unit: half-open TCP, lost and reordered datagrams, silent discovery."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from random import Random

import numpy as np
from dm_msgs.msg import ActuatorState, ErrorCode
from dm_msgs.srv import SetSignals

from fault_injection.fault import Fault, FaultRecord
from fault_injection.faults.driver_faults import far_shape, shape
from fault_injection.rigs.common_steps import checked
from fault_injection.rigs.driver_rig import ACTUATORS, DriverRig
from fault_injection.rigs.relays import DatagramRelay, VanishingLink

ROUNDS = 3
#: Share of the datagrams that are lost, doubled, or held back until the next one has passed.
LOST, DOUBLED, HELD_BACK = 0.05, 0.05, 0.05
#: Moves through the bad network.
_MOVES = 20


# Half-open TCP


def _vanishing(restart: bool, random: Random, rig: DriverRig, link: VanishingLink) -> None:
    rig.begin(SetSignals, SetSignals.Request(signals=far_shape(rig, random).tolist()))
    rig.wait_moving(random.randint(1, 6))
    link.set_up(False)
    time.sleep(random.uniform(0.2, 3.0))
    if restart:
        link.restart_unit()
    link.set_up(True)


def _half_open(restart: bool) -> Fault:
    def run(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
        with (
            VanishingLink() as link,
            DriverRig(folder, domain, via=link.port, electronics__address=link.address) as rig,
            checked(rig, record),
        ):
            link.unit_port = rig.port
            rig.recover(shape(random))
            for _ in range(ROUNDS):
                _vanishing(restart, random, rig, link)
                record.injected += 1
                record.recovery_s.append(rig.recover(shape(random)))

    if restart:
        return Fault("half_open_restart", "the unit vanishes in a move, forgets the connection, and is back", run)
    return Fault("half_open", "the unit vanishes in a move, without FIN or RST, and is back", run)


# Datagrams


class Storm:
    """Loses, doubles and reorders datagrams; never two in a row."""

    def __init__(self, random: Random) -> None:
        self._random = random
        self._held: bytes | None = None
        self._calm = 0
        self.struck = 0

    def __call__(self, datagram: bytes) -> list[bytes]:
        held, self._held = self._held, None
        if held is not None:
            self._calm = 2
            return [datagram, held]
        self._calm -= 1
        draw = self._random.random()
        if self._calm >= 0 or draw > LOST + DOUBLED + HELD_BACK:
            return [datagram]
        self.struck += 1
        self._calm = 2
        if draw < LOST:
            return []
        if draw < LOST + DOUBLED:
            return [datagram, datagram]
        self._held = datagram
        return []


@contextmanager
def _udp_rig(
    folder: Path, domain: int, record: FaultRecord
) -> Iterator[tuple[DriverRig, DatagramRelay, DatagramRelay]]:
    """A rig over UDP whose frames and discovery pass through relays, at first undisturbed."""
    with (
        DatagramRelay(0, lambda datagram: [datagram]) as frames,
        DatagramRelay(0, lambda datagram: [datagram]) as discovery,
        DriverRig(folder, domain, "edac40_udp", frames.port, electronics__discovery_port=discovery.port) as rig,
        checked(rig, record),
    ):
        frames.lead_to(rig.port)
        discovery.lead_to(int(rig.bench.electronics.endpoints["discovery_port"]))
        yield rig, frames, discovery


def _bad_network(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
    with _udp_rig(folder, domain, record) as (rig, frames, _discovery):
        rig.recover(shape(random))
        storm = Storm(random)
        frames.weather = storm
        for _ in range(_MOVES):
            wanted = shape(random)
            answer = rig.set_signals(wanted)
            if answer.error_code != ErrorCode.OK:
                record.remarks.append(answer.message)
                continue
            # The last datagram of a move may be the lost one: it is sent again at the next look at the link.
            rig.wait(partial(rig.stands_at, wanted), "the accepted shape at the actuators", 5.0)
        frames.weather = lambda datagram: [datagram]
        record.injected += storm.struck
        record.recovery_s.append(rig.recover(shape(random)))


def _udp_unplugged(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
    with _udp_rig(folder, domain, record) as (rig, _frames, _discovery):
        rig.recover(shape(random))
        for _ in range(ROUNDS):
            rig.bench.electronics.set_plugged(False)
            rig.wait_for_driver_state(ActuatorState.STATE_LINK_LOST)
            time.sleep(random.uniform(0.0, 1.0))
            rig.bench.electronics.set_plugged(True)
            record.injected += 1
            record.recovery_s.append(rig.recover(shape(random)))


def _discovery_silent(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
    with _udp_rig(folder, domain, record) as (rig, _frames, discovery):
        rig.recover(shape(random))
        for _ in range(ROUNDS):
            discovery.weather = lambda datagram: []
            rig.wait_for_driver_state(ActuatorState.STATE_LINK_LOST)
            discovery.weather = lambda datagram: [datagram]
            record.injected += 1
            record.recovery_s.append(rig.recover(shape(random)))


# Another publisher


def _competing(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
    """Somebody else goes on publishing at 100 Hz while our moves run."""
    with DriverRig(folder, domain) as rig, checked(rig, record):
        rig.recover(shape(random))
        for _ in range(ROUNDS):
            end = threading.Event()
            thread = threading.Thread(target=_compete, args=(rig, Random(random.random()), end))
            thread.start()
            try:
                for _ in range(10):
                    answer = rig.set_signals(shape(random))
                    if answer.error_code not in (ErrorCode.OK, ErrorCode.PREEMPTED):
                        record.lost += 1
                        record.remarks.append(f"a move against another publisher: {answer.message}")
            finally:
                end.set()
                thread.join()
            record.injected += 1
            record.recovery_s.append(rig.recover(shape(random)))


def _compete(rig: DriverRig, random: Random, end: threading.Event) -> None:
    while not end.wait(0.01):
        rig.publish(np.full(ACTUATORS, random.uniform(-1.0, 1.0)))


FAULTS: tuple[Fault, ...] = (
    _half_open(False),
    _half_open(True),
    Fault("udp_bad_network", "EDAC40 over UDP: datagrams are lost, doubled and reordered during moves", _bad_network),
    Fault("udp_unplugged", "EDAC40 over UDP: cable pulled, and put back", _udp_unplugged),
    Fault("discovery_silent", "EDAC40 over UDP: the unit does not answer discovery for a while", _discovery_silent),
    Fault("competing_publisher", "another publisher goes on at 100 Hz while our moves run", _competing),
)
