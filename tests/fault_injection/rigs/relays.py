"""What stands between driver and unit, and can lose what is sent: a link that vanishes, a network that drops datagrams.

The link is a pair of virtual Ethernet interfaces with a relay in a network namespace at its far end, so that the
driver's TCP meets real silence: no FIN, no RST, no acknowledgement. Elsewhere than as root on Linux NotPermittedError
says why there is none.
"""

from __future__ import annotations

import itertools
import os
import select
import socket
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from studies.network_namespaces import inside, ip

_LOOPBACK = "127.0.0.1"
_NUMBERS = itertools.count(1)


class VanishingLink:
    """A way to the unit's TCP port that can vanish without a word. Use as a context manager.

    Args:
        unit_port: where the unit listens on the loopback; may be set later, before the first connection.

    Attributes:
        address, port: what the driver connects to.
    """

    def __init__(self, unit_port: int = 0) -> None:
        self.unit_port = unit_port
        number = (os.getpid() + 7919 * next(_NUMBERS)) % 32_768
        self._name = f"dm-{number}"
        self._near, self._far = f"dmn{number}", f"dmf{number}"
        network = f"198.{18 + number // 16384}.{number // 64 % 256}"  # RFC 2544: for tests of devices
        self._near_address, self.address = f"{network}.{4 * (number % 64) + 1}", f"{network}.{4 * (number % 64) + 2}"
        self.port = 1234
        self._ended = threading.Event()
        self._lock = threading.Lock()
        self._pair: tuple[socket.socket, socket.socket] | None = None

    def __enter__(self) -> Self:
        ip("netns", "add", self._name)
        try:
            ip("link", "add", self._near, "type", "veth", "peer", "name", self._far, "netns", self._name)
            ip("addr", "add", f"{self._near_address}/30", "dev", self._near)
            ip("-n", self._name, "addr", "add", f"{self.address}/30", "dev", self._far)
            ip("link", "set", self._near, "up")
            self.set_up(True)
            self._listener = self._socket()
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind((self.address, self.port))
            self._listener.listen(1)
        except BaseException:
            ip("netns", "del", self._name)
            raise
        self._thread = threading.Thread(target=self._relay, name="relay", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, _type: type[BaseException] | None, _error: BaseException | None, _traceback: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join(5.0)
        self.restart_unit()
        self._listener.close()
        ip("link", "del", self._near)
        ip("netns", "del", self._name)

    def _socket(self) -> socket.socket:
        """A TCP socket that belongs to the namespace for its whole life."""
        with inside(self._name):
            return socket.socket(socket.AF_INET, socket.SOCK_STREAM)

    def set_up(self, up: bool) -> None:
        """Let the link vanish, or bring it back."""
        ip("-n", self._name, "link", "set", self._far, "up" if up else "down")

    def restart_unit(self) -> None:
        """The unit forgets its connection, as at a restart of its network side; its outputs hold."""
        with self._lock:
            pair, self._pair = self._pair, None
        for end in pair or ():
            end.close()

    def _relay(self) -> None:
        while not self._ended.is_set():
            with self._lock:
                pair = self._pair
            try:
                ready = select.select([self._listener, *(pair or ())], [], [], 0.02)[0]
                if self._listener in ready:
                    client, _ = self._listener.accept()
                    self.restart_unit()
                    with self._lock:
                        self._pair = (client, self._connect_unit(client))
                elif pair is not None and ready:
                    content = pair[0].recv(65536) if pair[0] in ready else b""
                    if content:
                        pair[1].sendall(content)
                        pair[0].setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
                    else:
                        self.restart_unit()
            except (OSError, ValueError):  # one end has gone, or was closed meanwhile
                self.restart_unit()

    def _connect_unit(self, client: socket.socket) -> socket.socket:
        """A connection to the unit, which refuses one while it still has the one before."""
        deadline = time.monotonic() + 5.0
        while True:
            try:
                unit = socket.create_connection((_LOOPBACK, self.unit_port), 5.0)
            except OSError:
                if time.monotonic() > deadline:
                    client.close()
                    raise
                time.sleep(0.01)
            else:
                unit.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                return unit


#: What becomes of a datagram: it, nothing, or several, in this order.
Weather = Callable[[bytes], list[bytes]]


class DatagramRelay:
    """A UDP port that hands datagrams on to the unit's, as `weather` lets it, and answers back. A context manager."""

    def __init__(self, unit_port: int, weather: Weather) -> None:
        self._unit = (_LOOPBACK, unit_port)
        self.weather = weather
        self._front = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._front.bind((_LOOPBACK, 0))
        self._back = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.port = int(self._front.getsockname()[1])
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._relay, name="datagrams", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, _type: type[BaseException] | None, _error: BaseException | None, _traceback: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join(5.0)
        self._front.close()
        self._back.close()

    def lead_to(self, unit_port: int) -> None:
        """Where the unit is, when it was not known at first."""
        self._unit = (_LOOPBACK, unit_port)

    def _relay(self) -> None:
        sender = None
        while not self._ended.is_set():
            for ready in select.select([self._front, self._back], [], [], 0.05)[0]:
                try:
                    content, source = ready.recvfrom(65536)
                    if ready is self._back:
                        if sender is not None:
                            self._front.sendto(content, sender)
                        continue
                    sender = source
                    for datagram in self.weather(content):
                        self._back.sendto(datagram, self._unit)
                except OSError:  # nobody listens at the moment
                    pass
