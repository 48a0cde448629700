"""Record on disk of what was last sent to the electronics, which survives a killed driver.

No unit can be read back, and its outputs hold when the driver dies. A new driver that knows nothing must write its
first shape in one step; one that finds this record continues from where the old one ended. A shape is recorded *before*
it is sent: the outputs are then at the record or at most one step away from it. The record holds DAC codes, not
rounded, since they mean the same outputs after the parameters `volts.*` have changed.

Two slots are written in turn, each with a checksum, so that one is complete at any moment. The operating system keeps
what a killed process wrote; only a crash of the whole computer may lose the last seconds.
"""

import errno
import fcntl
import logging
import os
import struct
import zlib
from pathlib import Path

import numpy as np

from dm_common.errors import Refusal
from dm_driver.electronics.base import LinkError
from dm_driver.output.volts import VoltScale
from dm_driver.safety_limiter import SafetyLimiter, Shape

_HEAD = struct.Struct("<8sQI")  # magic, number of the write, actuators
_CHECK = struct.Struct("<I")
_MAGIC = b"dmshape2"


class LastShape:
    """The record of one drive unit.

    Args:
        path: the file; its folder is made. None = nothing is kept.

    Raises:
        OSError: the file cannot be made or opened, or the disk is full.
    """

    def __init__(self, path: Path | None, actuators: int) -> None:
        self._actuators = actuators
        self._slot = _HEAD.size + 8 * actuators + _CHECK.size
        self._number = 0
        self._descriptor = -1
        #: Why nothing is kept of what was sent last, as a sentence; "" = it is, or is not wanted.
        self.trouble = ""
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
            try:
                os.posix_fallocate(self._descriptor, 0, 2 * self._slot)  # a disk that fills later takes nothing away
            except OSError:
                self.close()
                raise

    def claim(self) -> None:
        """Keep other drivers with this record away from the unit, until :meth:`close` or the end of the process.

        Raises:
            LinkError: another driver has it. A unit on UDP would take the frames of both.
        """
        try:
            if self._descriptor >= 0:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise LinkError("another driver on this machine is connected to this unit; waiting for its end") from error
        except OSError:  # a file system without locks
            return

    def load(self) -> Shape | None:
        """(N,) codes of the newest complete record; None if there is none for this number of actuators, or if it was
        noted or loaded by this object before.

        Raises:
            OSError: the file cannot be read.
        """
        if self._descriptor < 0:
            return None
        newest = None
        for at in (0, self._slot):
            number, shape = self._parse(os.pread(self._descriptor, self._slot, at))
            if shape is not None and number > self._number:
                self._number, newest = number, shape
        return newest

    def known(self, own: Shape | None, scale: VoltScale, limiter: SafetyLimiter) -> Shape | None:
        """(N,) shape at the outputs: as another driver has left it since, else `own`; None = unknown."""
        try:
            if (codes := self.load()) is not None:
                return limiter.check_shape(scale.signals_of_codes(codes), "the last shape sent")
        except (OSError, Refusal) as error:  # a Refusal: the limits have changed, and no legal ramp begins there
            logging.getLogger(__name__).warning("the recorded last shape is not used: %s", error)
        return own

    def note(self, codes: Shape) -> None:
        """Record `codes` (N,) as what is about to be sent.

        Raises:
            OSError: the disk is full, or gone.
        """
        if self._descriptor < 0:
            return
        self._number += 1
        content = _HEAD.pack(_MAGIC, self._number, self._actuators) + codes.astype("<f8").tobytes()
        record = content + _CHECK.pack(zlib.crc32(content))
        if os.pwrite(self._descriptor, record, self._slot * (self._number % 2)) < len(record):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if self._number == 1:  # what was noted for another number of actuators is out of date
            os.pwrite(self._descriptor, bytes(self._slot), 0)
            os.ftruncate(self._descriptor, 2 * self._slot)
        self.trouble = ""

    def close(self) -> None:
        """Close the file; its content stays."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)

    def _parse(self, slot: bytes) -> tuple[int, Shape | None]:
        if len(slot) != self._slot or _CHECK.unpack(slot[-_CHECK.size :])[0] != zlib.crc32(slot[: -_CHECK.size]):
            return 0, None
        magic, number, actuators = _HEAD.unpack_from(slot)
        if magic != _MAGIC or actuators != self._actuators:
            return 0, None
        return number, np.frombuffer(slot, "<f8", actuators, _HEAD.size).copy()
