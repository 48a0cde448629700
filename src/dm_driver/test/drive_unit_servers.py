"""Small drive units for tests: real sockets and a real pseudo-terminal, with decoders written from docs/protocols.md.

A frame is recorded as a dictionary {connector channel: code}.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import threading
import tty
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dm_driver.electronics.frame_format import FrameFormat

EDAC40_TABLE = [
    *(6, 7, 4, 5, 2, 3, 0, 1, 22, 23, 20, 21, 18, 19, 16, 17, 14, 15, 12, 13),
    *(10, 11, 8, 9, 38, 39, 36, 37, 34, 35, 32, 33, 30, 31, 28, 29, 26, 27, 24, 25),
]
DAC40_TABLE = [
    *(7, 15, 23, 31, 39, 6, 14, 22, 30, 38, 5, 13, 21, 29, 37, 4, 12, 20, 28, 36),
    *(3, 11, 19, 27, 35, 2, 10, 18, 26, 34, 1, 9, 17, 25, 33, 0, 8, 16, 24, 32),
]
#: Connector channels of actuators 1, 2, ... of a trihex mirror.
TRIHEX = [
    *(14, 16, 38, 23, 26, 1, 8, 10, 13, 37, 18, 36, 25, 28, 22, 7, 5, 2, 6),
    *(19, 17, 32, 15, 11, 35, 34, 39, 33, 31, 21, 27, 29, 24, 9, 3, 4, 12),
]
MAC = b"00-04-A3-12-34-56"

Frame = dict[int, int]


def decode_edac40(data: bytes) -> tuple[Frame | None, bytes]:
    """Take one frame off the front of `data`: (frame or None when it is incomplete, the rest)."""
    if len(data) < 6:
        return None, data
    mask = int.from_bytes(data[:5], "little")
    physical = [bit for bit in range(40) if mask >> bit & 1]
    length = 6 + 2 * len(physical)
    assert data[5] == 0, f"command {data[5]} was sent"
    assert physical, "an empty frame was sent"
    if len(data) < length:
        return None, data
    frame = {}
    for position, channel in enumerate(physical):
        frame[EDAC40_TABLE.index(channel)] = data[6 + 2 * position] + 256 * data[7 + 2 * position]
    return frame, data[length:]


def signals_of(frames: list[Frame]) -> np.ndarray:
    """(frames, 37) signals on an EDAC40's wire: code 0 is -6 V, full scale +6 V, gain 80, 0..300 V."""
    codes = np.array([[frame[channel] for channel in TRIHEX] for frame in frames], dtype=float)
    return (codes / 65535 * 12 - 6) * 80 / 150 - 1


def decode_dac40(data: bytes) -> Frame:
    """Decode the 130 bytes of a USB DAC-40 frame."""
    assert len(data) == 130 and data[0] == 0xFF and data[129] == 0
    frame = {}
    for group in range(8):
        part = data[1 + 16 * group : 17 + 16 * group]
        assert part[0] == 0
        address = sum((4, 2, 1)[i] for i in range(3) if part[1 + i] == 0x1F)
        assert address == group and set(part[1:4]) <= {0x00, 0x1F}
        for chip in range(5):
            code = 0
            for byte in part[4:16]:
                assert byte < 32
                code = 2 * code + (byte >> chip & 1)
            frame[DAC40_TABLE[5 * group + chip]] = code
    return frame


def crc16_modbus(data: bytes) -> int:
    """Bit by bit, as the Modbus specification tells it."""
    register = 0xFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0xA001 if register & 1 else 0)
    return register


def decode_framed(data: bytes) -> Frame:
    """Decode the 86 bytes that `FramedSerialUnit` takes."""
    assert len(data) == 86 and data[:2] == b"\xa5\x5a" and data[84:] == b"\r\n"
    assert data[82] + 256 * data[83] == crc16_modbus(data[2:82])
    words = [data[2 + 2 * k] + 256 * data[3 + 2 * k] for k in range(40)]
    # Two's complement about mid scale, the last channel first.
    return {39 - k: (word + 0x8000) % 0x10000 for k, word in enumerate(words)}


class DriveUnit:
    """A unit that can be unplugged and plugged in again; use as a context manager."""

    kind = ""

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self.raw = b""
        self.errors: list[str] = []
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def settings(self) -> dict[str, object]:
        """Keyword arguments of ElectronicsSettings."""
        raise NotImplementedError

    def __enter__(self) -> DriveUnit:
        self.plug()
        return self

    def __exit__(self, *_exception: object) -> None:
        self.unplug()
        assert not self.errors, self.errors

    def plug(self) -> None:
        self._stop.clear()
        self._open()
        self._thread = threading.Thread(target=self._guarded, daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        if self._thread is not None:
            self._stop.set()
            self._thread.join()
            self._thread = None
            self._close()

    def _guarded(self) -> None:
        try:
            self._serve()
        except Exception as error:
            self.errors.append(f"{type(error).__name__}: {error}")

    def _open(self) -> None: ...

    def _close(self) -> None: ...

    def _serve(self) -> None: ...


class Edac40TcpUnit(DriveUnit):
    kind = "edac40_tcp"

    def __init__(self) -> None:
        super().__init__()
        self.port = 0
        self.clients = 0
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None

    @property
    def settings(self) -> dict[str, object]:
        return {"address": "127.0.0.1", "port": self.port}

    def _open(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", self.port))
        self.port = self._listener.getsockname()[1]

    def drop_client(self) -> None:
        """Close the connection as the unit does when it restarts; it goes on listening."""
        client, self._client = self._client, None
        if client is not None:
            client.shutdown(socket.SHUT_RDWR)

    def _close(self) -> None:
        for link in (self._client, self._listener):
            if link is not None:
                link.close()
        self._client = self._listener = None

    def _serve(self) -> None:
        assert self._listener is not None
        buffer = b""
        client: socket.socket | None = None
        while not self._stop.is_set():
            watched = [self._listener] + ([client] if client is not None else [])
            for ready in select.select(watched, [], [], 0.02)[0]:
                if ready is self._listener:
                    newcomer, _ = self._listener.accept()
                    if client is not None:
                        newcomer.close()  # one client at a time
                    else:
                        client = self._client = newcomer
                        buffer = b""
                        self.clients += 1
                elif client is not None:
                    try:
                        data = client.recv(4096)
                    except ConnectionResetError:
                        data = b""
                    if not data:
                        client.close()
                        client = self._client = None
                        continue
                    self.raw += data
                    buffer += data
                    while True:
                        frame, buffer = decode_edac40(buffer)
                        if frame is None:
                            break
                        self.frames.append(frame)


class Edac40UdpUnit(DriveUnit):
    kind = "edac40_udp"

    def __init__(self, discovery: bool = True, copies: int = 1) -> None:
        super().__init__()
        self.port = 0
        self.discovery_port = 0
        self.questions: list[bytes] = []
        self._discovery, self._copies = discovery, copies
        self._sockets: list[socket.socket] = []

    @property
    def settings(self) -> dict[str, object]:
        return {"address": "127.0.0.1", "port": self.port, "discovery_port": self.discovery_port}

    def _open(self) -> None:
        for name in ("port", "discovery_port") if self._discovery else ("port",):
            link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            link.bind(("127.0.0.1", getattr(self, name)))
            setattr(self, name, link.getsockname()[1])
            self._sockets.append(link)

    def _close(self) -> None:
        for link in self._sockets:
            link.close()
        self._sockets = []

    def _serve(self) -> None:
        while not self._stop.is_set():
            for ready in select.select(self._sockets, [], [], 0.02)[0]:
                data, sender = ready.recvfrom(4096)
                if ready is self._sockets[0]:
                    self.raw += data
                    frame, rest = decode_edac40(data)
                    assert frame is not None and not rest
                    self.frames.append(frame)
                else:
                    self.questions.append(data)
                    if data == b"Discovery: Who is out there?":
                        for _ in range(self._copies):
                            ready.sendto(b"EDAC40".ljust(15) + b"\r\n" + MAC + b"\r\n", sender)


class UsbDac40Unit(DriveUnit):
    kind = "usb_dac40"
    opening = bytes(130)
    frame_length = 130

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._path = folder / "ttyUSB-test"
        self._master = self._slave = -1

    @property
    def settings(self) -> dict[str, object]:
        return {"serial_port": str(self._path)}

    def _open(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self._path.symlink_to(os.ttyname(self._slave))

    def _close(self) -> None:
        self._path.unlink()
        os.close(self._master)
        os.close(self._slave)

    def _serve(self) -> None:
        buffer = b""
        while not self._stop.is_set():
            if not select.select([self._master], [], [], 0.02)[0]:
                continue
            data = os.read(self._master, 4096)
            self.raw += data
            buffer = (buffer + data).removeprefix(self.opening)
            while len(buffer) >= self.frame_length:
                part, buffer = buffer[: self.frame_length], buffer[self.frame_length :]
                self._take(part)

    def _take(self, part: bytes) -> None:
        self.frames.append(decode_dac40(part))


class FramedSerialUnit(UsbDac40Unit):
    """A unit whose frames need every part of the description."""

    kind = "framed_serial"
    opening = b"\x55\x55"
    frame_length = 86

    @property
    def settings(self) -> dict[str, object]:
        frame = FrameFormat(
            channels=40,
            bits=16,
            header="A5 5A",
            terminator="0D 0A",
            channel_order=tuple(range(39, -1, -1)),
            byte_order="little",
            offset=-32768,
            checksum="crc16_modbus",
            checksum_covers_header=False,
            checksum_byte_order="little",
            opening="55 55",
            reply="06",
            baud_rate=921600,
        )
        return {"serial_port": str(self._path), "frame": frame}

    def _take(self, part: bytes) -> None:
        self.frames.append(decode_framed(part))
        os.write(self._master, b"\x06")


#: What the device server of python-microscope is to serve; it prints every pattern that the mirror takes.
DEVICES = """
from microscope.device_server import device
from microscope.simulators import SimulatedDeformableMirror

class Mirror(SimulatedDeformableMirror):
    def _do_apply_pattern(self, pattern):
        super()._do_apply_pattern(pattern)
        print("pattern", *self.get_current_pattern(), flush=True)

DEVICES = [device(Mirror, "127.0.0.1", {port}, conf={{"n_actuators": 40}})]
"""


class MicroscopeUnit(DriveUnit):
    """The simulated mirror of python-microscope behind its device server, the program that people start."""

    kind = "microscope"

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder, self._port = folder, 0

    @property
    def settings(self) -> dict[str, object]:
        return {"address": f"PYRO:Mirror@127.0.0.1:{self._port}", "channels": 40}

    def _open(self) -> None:
        devices = self._folder / "devices.py"
        devices.write_text(DEVICES.format(port=self._port))
        self._server = subprocess.Popen(
            [sys.executable, "-m", "microscope.device_server", devices],
            cwd=self._folder,  # for its logs
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,  # it serves each device from a process of its own
        )
        assert self._server.stdout is not None
        self._lines = iter(self._server.stdout)
        serving = next(line for line in self._lines if "Serving PYRO:Mirror@" in line)
        self._port = int(serving.rpartition(":")[2])

    def _serve(self) -> None:
        for line in self._lines:
            if line.startswith("pattern "):
                pattern = np.array(line.split()[1:], dtype=float)
                assert pattern.min() >= 0.0 and pattern.max() <= 1.0
                self.frames.append(dict(enumerate(np.rint(0xFFFF * pattern).astype(int).tolist())))

    def unplug(self) -> None:
        if self._thread is not None:
            os.killpg(self._server.pid, signal.SIGKILL)  # which ends `_serve`
            self._server.wait()
        super().unplug()


UNITS: dict[str, Callable[[Path], DriveUnit]] = {
    "edac40_tcp": lambda folder: Edac40TcpUnit(),
    "edac40_udp": lambda folder: Edac40UdpUnit(),
    "usb_dac40": UsbDac40Unit,
    "framed_serial": FramedSerialUnit,
    "microscope": MicroscopeUnit,
}
