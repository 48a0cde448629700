"""EDAC40: 40 channels, 16 bit, over Ethernet (docs/protocols.md, EDAC40).

The unit acknowledges nothing and cannot be read back. Only command 0 (value) is ever sent: offset, gain and global
offset live in its non-volatile memory and shift every voltage.
"""

import fcntl
import os
import re
import socket
import struct
import termios
import time
from typing import Final

import numpy as np
from numpy.typing import NDArray
from serial.urlhandler import protocol_socket

from dm_common import Bools
from dm_driver.electronics.base import DriveElectronics, ElectronicsSettings, LinkError
from dm_driver.electronics.discovery import Probe

CHANNELS: Final = 40
MAX_CODE: Final = 0xFFFF
COMMAND_VALUE: Final = 0

#: Pause between two checks for an acknowledgement, s; one takes 0.1 to 0.3 ms over a direct cable.
_ACKNOWLEDGEMENT_PERIOD_S: Final = 1e-4
#: Number of times that a frame over UDP is repeated, once at each check of the link, while it is the last one.
_REPEATS: Final = 2

#: Connector channel -> physical channel, both 0-based. The permutation is its own inverse.
PHYSICAL_CHANNEL: Final[NDArray[np.intp]] = np.array(
    [
        *(6, 7, 4, 5, 2, 3, 0, 1, 22, 23, 20, 21, 18, 19, 16, 17, 14, 15, 12, 13),
        *(10, 11, 8, 9, 38, 39, 36, 37, 34, 35, 32, 33, 30, 31, 28, 29, 26, 27, 24, 25),
    ]
)


def encode_frame(codes: NDArray[np.uint16], wired: Bools) -> bytes:
    """Return the frame that sets the `wired` channels to `codes`.

    Args:
        codes: (40,) 0..65535 by connector channel.
        wired: (40,) bool by connector channel.

    Returns:
        8 to 86 bytes: channel mask (40 bit, little-endian, by physical channel), the command byte, then one u16
        little-endian per set bit in order of rising physical channel.
    """
    mask = wired[PHYSICAL_CHANNEL]
    values = codes[PHYSICAL_CHANNEL][mask].astype("<u2")
    return np.packbits(mask, bitorder="little").tobytes() + bytes([COMMAND_VALUE]) + values.tobytes()


#: Characters that pySerial would take for part of its URL, and that no host name or IPv4 address holds.
_NO_ADDRESS: Final = re.compile(r"[^\w.-]", re.ASCII)


class _Edac40(DriveElectronics):
    channels = CHANNELS
    max_code = MAX_CODE
    needs = ("address", "the EDAC40's host name or IPv4 address")
    _protocol: str

    def __init__(self, settings: ElectronicsSettings) -> None:
        super().__init__(settings)
        if _NO_ADDRESS.search(settings.address):
            raise ValueError(
                f"electronics.address = {settings.address!r}: must be {self.needs[1]}; its port is electronics.port"
            )

    @property
    def where(self) -> str:
        return f"EDAC40 at {self._settings.address}:{self._settings.port} ({self._protocol})"


class Edac40Tcp(_Edac40):
    """EDAC40 over TCP. The unit takes one client at a time.

    When a unit vanishes, it is not known which of the frames under way it took, but the last frame, which is sent again
    when the unit is back, must not be a large step from its outputs. So a frame that differs from what has certainly
    arrived by more than half of `doubt` waits for the acknowledgement by the unit's TCP: the last frame is then at most
    `doubt` away from any frame that may be at the outputs. Small changes never wait.
    """

    _protocol = "TCP"

    def __init__(self, settings: ElectronicsSettings) -> None:
        super().__init__(settings)
        self._arrived: NDArray[np.uint16] | None = None  # codes that the unit's TCP has acknowledged
        self._last: NDArray[np.uint16] | None = None  # codes that were sent last

    def _do_open(self) -> None:
        self._arrived = self._last = None
        url = f"socket://{self._settings.address}:{self._settings.port}"
        self._link = protocol_socket.Serial(url, timeout=0)
        # A duplicate of the descriptor shares its options, which pySerial does not offer.
        with socket.socket(fileno=os.dup(self._link.fileno())) as options:
            # Nagle's algorithm would hold back a frame until the one before is acknowledged (up to 40 ms), then send
            # several in one segment.
            options.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # A pulled cable closes nothing: let the kernel find out while idle, and give up on unacknowledged frames.
            options.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            options.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 1)
            options.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
            options.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
            options.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, max(1, round(self._timeout_s * 1000)))

    def _do_write(self, codes: NDArray[np.uint16], wired: Bools) -> None:
        self._do_check()  # the first frame after the unit closed would be swallowed without an error
        if self._settings.doubt:
            self._await_arrival(codes)
        self._send(encode_frame(codes, wired))
        self._last = codes.copy()

    def _await_arrival(self, codes: NDArray[np.uint16]) -> None:
        """Wait until `codes` may be sent: see the docstring of the class.

        Raises:
            LinkError: no acknowledgement within the timeout.
        """
        if self._last is None:
            return
        deadline = time.monotonic() + self._timeout_s
        while True:
            now = time.monotonic()  # taken first: after this process was stopped, the unit is asked once more
            if not self._on_the_way():
                break
            if self._arrived is not None:
                away = np.abs(codes.astype(np.int64) - self._arrived).max()
                if 2 * away <= self._settings.doubt:
                    return
            if now > deadline:
                raise LinkError(f"no acknowledgement within {self._timeout_s:g} s")
            time.sleep(_ACKNOWLEDGEMENT_PERIOD_S)
            self._do_check()
        self._arrived = self._last

    def _on_the_way(self) -> int:
        """Bytes that the unit's TCP has not acknowledged yet."""
        answer = fcntl.ioctl(self._link.fileno(), termios.TIOCOUTQ, bytes(4))
        return int(struct.unpack("i", answer)[0])

    def _do_check(self) -> None:
        # The unit never sends: a readable link has ended (read raises), or holds stray bytes (dropped). Only once:
        # another service, at a wrong address, may send without end.
        self._link.read(4096)


class Edac40Udp(_Edac40):
    """EDAC40 over UDP.

    A datagram to a unit that is off is lost without an error. A connected socket at least notices a host that is up
    but has no such port; with `discovery_port` the unit must answer discovery when the link is opened and, while it
    is up, within `timeout_s`.

    Datagrams may be lost, doubled or reordered unnoticed. So ramps are cut finer: with one lost or out of order the
    outputs still change by less than `limits.step`. And the last frame is sent again, so that the shape that stays at
    the outputs is complete.
    """

    _protocol = "UDP"
    frames_per_step = 3

    def __init__(self, settings: ElectronicsSettings) -> None:
        super().__init__(settings)
        self._probe: Probe | None = None
        self._unanswered_since: float | None = None
        self._frame = b""
        self._repeats = 0

    def _do_open(self) -> None:
        self._repeats = 0
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.settimeout(self._timeout_s)
        self._link.connect((self._settings.address, self._settings.port))
        self._unanswered_since = None
        if self._settings.discovery_port:
            self._probe = Probe(self._settings.address, self._settings.discovery_port)
            self._probe.query()
            if next(self._probe.answers(self._timeout_s), None) is None:
                raise LinkError(
                    f"no answer to discovery on UDP port {self._settings.discovery_port} within {self._timeout_s:g} s"
                )

    def _do_write(self, codes: NDArray[np.uint16], wired: Bools) -> None:
        self._frame = encode_frame(codes, wired)
        self._repeats = _REPEATS
        self._link.send(self._frame)

    def _do_check(self) -> None:
        pending = self._link.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if pending:
            raise OSError(pending, os.strerror(pending))
        if self._repeats:
            self._repeats -= 1
            self._link.send(self._frame)
        if self._probe is None:
            return
        # The answer to a question is read at the next check, so that a frame never waits for the network.
        now = time.monotonic()
        if list(self._probe.answers(0.0)):  # all: a duplicate would look like life after the unit has gone
            self._unanswered_since = None
        if self._unanswered_since is None:
            self._unanswered_since = now
        elif now - self._unanswered_since > self._timeout_s:
            raise LinkError(f"no answer to discovery for {now - self._unanswered_since:.2f} s")
        self._probe.query()

    def _do_close(self) -> None:
        super()._do_close()
        probe, self._probe = self._probe, None
        if probe is not None:
            probe.close()
