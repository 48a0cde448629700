"""The units on the wire: an EDAC40 on loopback TCP and UDP with discovery, a serial unit on a pseudo-terminal.

One thread owns all sockets and, through `run()`, everything that frames change: frames are carried out in the order of
their arrival, and a request for the state sees every frame that was sent before it.
"""

import errno
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from dm_common.values import parameter, text, whole
from dm_simulation.electronics import frames
from dm_simulation.electronics.drive_unit import DriveUnit
from dm_simulation.electronics.event_loop import EventLoop
from dm_simulation.electronics.framed_unit import FramedConfig
from dm_simulation.electronics.frames import FrameError
from dm_simulation.electronics.serial_terminal import SerialTerminal

LOOPBACK = "127.0.0.1"
#: Port value that leaves a service out; 0 lets the system choose one.
OFF = -1
PORT_TEXT = "on 127.0.0.1; 0 = any free port, -1 = not offered."
DISCOVERY_QUESTION = b"Discovery: Who is out there?"
DISCOVERY_ANSWER = b"EDAC40".ljust(17) + b"02-00-00-DA-C4-00\r\n"


@dataclass(frozen=True)
class PortsConfig:
    """Ports and paths of the units, and the protocol of the serial port (by default that of a USB DAC-40)."""

    tcp_port: int = parameter(whole(1234, -1, 65535), f"EDAC40 over TCP {PORT_TEXT}")
    udp_port: int = parameter(whole(1234, -1, 65535), f"EDAC40 over UDP {PORT_TEXT}")
    discovery_port: int = parameter(whole(30303, -1, 65535), f"EDAC40 discovery {PORT_TEXT}")
    pty_link: str = parameter(
        text("", path=True),
        "Path of a symbolic link to the pseudo-terminal of the USB DAC-40 or the framed unit; empty = not offered.",
    )
    framed: FramedConfig = field(default_factory=FramedConfig)


class ElectronicsServer:
    """Serves one drive unit.

    Args:
        on_update: called in the server's thread after every frame that was carried out.
        on_event: called with (severe, text) for the log; severe: bytes that are not a frame, or a frame that could not
            be carried out.

    Attributes:
        run: runs a task in the server's thread, after every frame that has arrived; see `EventLoop.run`.
        endpoints: actual "tcp_port", "udp_port", "discovery_port" and "pty", as far as they are offered.
        malformed_count: number of inputs that were not a frame; the reasons are reported as events.

    Raises:
        OSError: a port is taken; the message names it.
    """

    def __init__(
        self,
        unit: DriveUnit,
        ports: PortsConfig,
        on_update: Callable[[], None],
        on_event: Callable[[bool, str], None] = lambda severe, text: None,
    ) -> None:
        self._unit = unit
        self._ports = ports
        self._on_update = on_update
        self._on_event = on_event
        self.endpoints: dict[str, int | str] = {}
        self.malformed_count = 0
        self.plugged = False
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._datagrams: list[socket.socket] = []
        self._stream = bytearray()
        self._loop = EventLoop("electronics", lambda error: on_event(True, f"failed, {type(error).__name__}: {error}"))
        self.run = self._loop.run
        try:
            self._terminal = SerialTerminal(unit, ports.framed, self._loop, on_update, self._reject)
        except ValueError:
            self._loop.close()
            raise
        try:
            self.run(self._plug)
        except BaseException:
            self.close()
            raise

    def set_plugged(self, plugged: bool) -> None:
        """Unplug the data cable, or plug it in again on the same ports. The outputs hold their values meanwhile."""
        if plugged != self.plugged:
            self.run(self._plug if plugged else self._unplug)
            self._on_event(False, "plugged in" if plugged else "unplugged: outputs hold")

    def close(self) -> None:
        """Stop serving; free ports and link."""
        self.run(self._unplug)
        self._loop.close()

    def _plug(self) -> None:
        ports = self._ports
        try:
            if ports.tcp_port != OFF:
                self._listen(int(self.endpoints.get("tcp_port", ports.tcp_port)))
            if ports.udp_port != OFF:
                self._bind_udp("udp_port", ports.udp_port, self._on_datagram)
            if ports.discovery_port != OFF:
                self._bind_udp("discovery_port", ports.discovery_port, self._on_discovery)
            if ports.pty_link:
                link = Path(ports.pty_link).expanduser()
                self._terminal.open(link)
                self.endpoints["pty"] = str(link)
        except BaseException:
            self._unplug()
            raise
        self.plugged = True

    def _unplug(self) -> None:
        self.plugged = False
        self._drop_client("unplugged")
        for endpoint in (*self._datagrams, self._listener):
            if endpoint is not None:
                self._loop.forget(endpoint)
                endpoint.close()
        self._datagrams.clear()
        self._listener = None
        self._terminal.close()

    def _reject(self, source: str, reason: str, data: bytes = b"") -> None:
        self.malformed_count += 1
        shown = f" ({data[:16].hex(' ')}{' ...' if len(data) > 16 else ''})" if data else ""
        self._on_event(True, f"malformed frame, {source}: {reason}{shown}")

    def _take_edac40(self, frame: bytes) -> None:
        self._unit.take_edac40(frames.decode_edac40(frame))
        self._on_update()

    # EDAC40 over TCP: one client. While it is connected the port is bound but not listening, so that a second client is
    # refused, as the real unit does.

    def _listen(self, port: int) -> None:
        placeholder = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        placeholder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        placeholder.setblocking(False)
        self._listener = placeholder
        # A connection that was pending when the port was closed keeps the port in use for a moment longer.
        _bind(placeholder, port, "electronics.tcp_port", patience_s=0.0 if self._client is None else 1.0)
        self.endpoints["tcp_port"] = placeholder.getsockname()[1]
        if self._client is None:
            placeholder.listen(1)
            self._loop.watch(placeholder, self._on_connect)

    def _on_connect(self) -> None:
        assert self._listener is not None
        try:
            client, _ = self._listener.accept()
        except OSError:
            return
        self._loop.forget(self._listener)
        self._listener.close()
        client.setblocking(False)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._client = client
        self._stream.clear()
        self._loop.watch(client, self._on_stream)
        self._listen(int(self.endpoints["tcp_port"]))
        self._on_event(False, "TCP client connected")

    def _drop_client(self, reason: str) -> None:
        if self._client is None:
            return
        self._loop.forget(self._client)
        self._client.close()
        self._client = None
        if self._stream:
            self._reject("TCP", "connection ended inside a frame", bytes(self._stream))
            self._stream.clear()
        self._on_event(False, f"TCP client gone: {reason}")

    def _on_stream(self) -> None:
        assert self._client is not None and self._listener is not None
        try:
            received = self._client.recv(65536)
            # Acknowledge at once, as small network stacks do; Linux would wait 40 ms for more.
            self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        except BlockingIOError:
            return
        except OSError as error:
            received, reason = b"", str(error)
        else:
            reason = "connection closed"
        if not received:
            self._drop_client(reason)
            self._listener.listen(1)
            self._loop.watch(self._listener, self._on_connect)
            return
        self._stream += received
        try:
            while len(self._stream) >= frames.EDAC40_HEADER:
                length = frames.edac40_length(bytes(self._stream[: frames.EDAC40_HEADER]))
                if len(self._stream) < length:
                    return
                frame = bytes(self._stream[:length])
                del self._stream[:length]
                self._take_edac40(frame)
        except FrameError as error:
            # A stream has no frame marks: after a bad header the rest of the data received cannot be interpreted.
            self._reject("TCP", str(error), bytes(self._stream))
            self._stream.clear()

    def _bind_udp(self, name: str, port: int, handler: Callable[[socket.socket], None]) -> None:
        endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        endpoint.setblocking(False)
        self._datagrams.append(endpoint)
        _bind(endpoint, int(self.endpoints.get(name, port)), f"electronics.{name}")
        self.endpoints[name] = endpoint.getsockname()[1]
        self._loop.watch(endpoint, lambda: handler(endpoint))

    def _on_datagram(self, endpoint: socket.socket) -> None:
        while True:
            try:
                datagram = endpoint.recv(2048)
            except OSError:
                return
            try:
                self._take_edac40(datagram)
            except FrameError as error:
                self._reject("UDP", str(error), datagram)

    def _on_discovery(self, endpoint: socket.socket) -> None:
        while True:
            try:
                question, sender = endpoint.recvfrom(2048)
            except OSError:
                return
            if question == DISCOVERY_QUESTION:
                endpoint.sendto(DISCOVERY_ANSWER, sender)
            else:
                self._reject("discovery", "unknown question", question)


class PortError(OSError):
    """A port of this machine is not available.

    Args:
        name: of the parameter that sets it.
        port: as set there.
        error: the reason.
    """

    def __init__(self, name: str, port: int, error: OSError) -> None:
        super().__init__(f"{name} = {port}: {error.strerror}")
        self.port = port


def _bind(endpoint: socket.socket, port: int, name: str, patience_s: float = 0.0) -> None:
    deadline = time.monotonic() + patience_s
    while True:
        try:
            return endpoint.bind((LOOPBACK, port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE or time.monotonic() >= deadline:
                raise PortError(name, port, error) from None
        time.sleep(0.005)
