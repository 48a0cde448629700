"""Reading HDF5 in a separate process: damaged files can crash the HDF5 library or make it loop forever.

The library trusts the files it reads. Flipped bits in a file's structure make it follow wild pointers, loop or allocate
without bounds (seen with HDF5 2.0 in the fuzzing of :mod:`fault_injection`). So a helper process reads the bytes, with
limits on memory and computing time, and returns plain arrays and texts. If it dies, the file counts as damaged, and the
next file gets a new helper. The helper ends together with the process that started it.
"""

import atexit
import json
import os
import struct
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass, field
from io import FileIO
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

#: Limit of computing time per file: a fixed part [s] plus one by size [s/byte]. A 12-megapixel map takes 0.3 s.
CPU_BASE_S = 1
CPU_PER_BYTE_S = 2e-7
#: Wall time after which the helper is killed, whatever it waits for [s].
WALL_LIMIT_S = 60.0

_LENGTH = struct.Struct("<Q")
_HEAD_MAX = 1 << 26
#: Memory that the shared file may keep between two files to save reallocating it [bytes].
_KEPT = 1 << 24


class SandboxError(Exception):
    """The helper died on the file, or could not be started."""


@dataclass(frozen=True)
class Answer:
    """Result of the helper: single values, arrays by name, or the error of the reader.

    Attributes:
        error, error_kind: the message and class name of the reader's exception; empty when it raised none.
    """

    facts: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, NDArray[Any]] = field(default_factory=dict)
    error: str = ""
    error_kind: str = ""


def send(stream: IO[bytes], head: dict[str, Any]) -> None:
    """Write a message: length, then JSON."""
    text = json.dumps(head).encode()
    stream.write(_LENGTH.pack(len(text)) + text)
    stream.flush()


def receive(stream: IO[bytes]) -> dict[str, Any] | None:
    """Read the JSON of a message; None at the end of the stream."""
    prefix = stream.read(_LENGTH.size)
    if len(prefix) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(prefix)
    if length > _HEAD_MAX:
        return None
    text = stream.read(length)
    return dict(json.loads(text)) if len(text) == length else None


class Hdf5Sandbox:
    """One helper process, started when it is first needed; several threads take turns."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._shared: FileIO | None = None  # file in memory through which contents pass; faster than a pipe
        atexit.register(self.close)

    def read(self, task: str, content: bytes) -> Answer:
        """Have `content` read by the reader `task` of :mod:`dm_calibration.map_files.hdf5_process`.

        Raises:
            SandboxError: the helper died, took too long, or could not be started.
        """
        with self._turn:
            process, shared = self._running()
            assert process.stdin is not None and process.stdout is not None
            # Killing the helper ends every read and write below.
            watchdog = threading.Timer(WALL_LIMIT_S, process.kill)
            watchdog.daemon = True
            watchdog.start()
            try:
                shared.seek(0)
                shared.write(content)
                send(process.stdin, {"task": task, "length": len(content)})
                head = receive(process.stdout)
                if head is not None:
                    shared.seek(0)
                    arrays = {name: np.load(shared, allow_pickle=False) for name in head.pop("arrays")}
                    return Answer(arrays=arrays, **head)
            except (OSError, ValueError, MemoryError, EOFError):
                pass  # reported below, with the exit status of the helper
            finally:
                watchdog.cancel()
                if os.fstat(shared.fileno()).st_size > _KEPT:
                    shared.truncate(0)
            raise SandboxError(self._end(process))

    def close(self) -> None:
        """End the helper; the next read starts another."""
        with self._turn:
            if self._process is not None:
                self._end(self._process)

    def _running(self) -> tuple[subprocess.Popen[bytes], FileIO]:
        if self._process is None or self._process.poll() is not None or self._shared is None:
            if self._process is not None:
                self._end(self._process)
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}
            try:
                self._shared = FileIO(os.memfd_create("hdf5"), "r+")
                descriptor = self._shared.fileno()
                # A session of its own: Ctrl-C in the terminal reaches only the node, which ends the helper itself.
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "dm_calibration.map_files.hdf5_process", str(descriptor)],
                    pass_fds=[descriptor],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                    env=environment,
                    start_new_session=True,
                )
            except OSError as error:
                raise SandboxError(f"the process that reads HDF5 files cannot be started: {error}") from error
        return self._process, self._shared

    def _end(self, process: subprocess.Popen[bytes]) -> str:
        """End the helper; return a sentence with its exit status."""
        self._process = None
        for stream in (process.stdin, process.stdout, self._shared):
            if stream is not None:
                with suppress(OSError):
                    stream.close()
        try:
            status = process.wait(1.0)
        except subprocess.TimeoutExpired:
            process.kill()
            status = process.wait()
        return f"reading it ended the helper process with status {status}"


#: :meth:`Hdf5Sandbox.read` of the one helper of this process.
read_in_sandbox = Hdf5Sandbox().read
