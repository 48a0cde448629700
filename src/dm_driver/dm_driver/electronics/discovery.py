"""Discovery of EDAC40 units: one UDP question, one answer per unit (docs/protocols.md, discovery)."""

import re
import select
import socket
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Final

QUESTION: Final = b"Discovery: Who is out there?"
PORT: Final = 30303
BROADCAST: Final = "255.255.255.255"
NAME: Final = "EDAC40"

_MAC = re.compile(rb"[0-9A-Fa-f]{2}(-[0-9A-Fa-f]{2}){5}")
_MAC_BYTES: Final = slice(17, 34)


@dataclass(frozen=True)
class Unit:
    """A unit that answered: its name, its MAC address (`XX-XX-XX-XX-XX-XX`) and its IPv4 address."""

    name: str
    mac: str
    address: str


def parse_reply(reply: bytes, sender: str) -> Unit | None:
    """Return the unit that sent `reply` from the address `sender`, or None when it is not an EDAC40's answer."""
    mac = reply[_MAC_BYTES]
    if not _MAC.fullmatch(mac):
        return None
    name = reply[: _MAC_BYTES.start].decode("ascii", errors="replace").strip()
    if not name.startswith(NAME):
        return None
    return Unit(name, mac.decode("ascii").upper(), sender)


class Probe:
    """A socket that asks and collects answers; the two are separate, so that asking never waits."""

    def __init__(self, address: str, port: int = PORT) -> None:
        try:
            self._destination = (socket.gethostbyname(address), port)
        except UnicodeError as error:  # not a possible name
            raise OSError(f"{address}: {error}") from error
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._socket.setblocking(False)

    def query(self) -> None:
        self._socket.sendto(QUESTION, self._destination)

    def answers(self, timeout_s: float) -> Iterator[Unit]:
        """Yield the units whose answers arrive within `timeout_s`; 0 = those that have arrived."""
        end = time.monotonic() + timeout_s
        while select.select([self._socket], [], [], max(0.0, end - time.monotonic()))[0]:
            try:
                reply, (sender, _port) = self._socket.recvfrom(1500)
            except BlockingIOError:  # a datagram with a wrong checksum wakes select, then is dropped
                continue
            unit = parse_reply(reply, sender)
            if unit is not None:
                yield unit

    def close(self) -> None:
        self._socket.close()


def discover(address: str = BROADCAST, port: int = PORT, timeout_s: float = 1.0) -> list[Unit]:
    """Ask `address` (a broadcast address or one host) and return the units that answer in `timeout_s`, each once.

    Raises:
        OSError: the name is unknown or the network unreachable.
    """
    with closing(Probe(address, port)) as probe:
        probe.query()
        units: dict[str, Unit] = {}
        for unit in probe.answers(timeout_s):
            units.setdefault(unit.mac, unit)
        return list(units.values())
