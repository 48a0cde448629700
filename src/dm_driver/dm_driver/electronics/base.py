"""What every drive unit offers: a number of output channels that take integer codes, and a link that can break."""

import math
import os
import re
import select
import termios
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from dm_common import Bools
from dm_common.values import parameter, text, whole
from dm_driver.electronics.frame_format import FrameFormat

#: `DriveElectronics.needs` of units at a serial port.
SERIAL_PORT: Final = ("serial_port", "a device file such as /dev/ttyUSB0")
#: What pySerial raises beside OSError if a port does not support the speed or parity asked for.
_UNOPENED: Final = (ValueError, termios.error)


class ElectronicsError(Exception):
    """Something about the drive electronics failed; the message says what, for a person."""


class LinkError(ElectronicsError):
    """The unit cannot be reached, closed the link, or does not take data in time. The link is closed afterwards."""


class NotOpenError(ElectronicsError):
    """The link was never opened, or was closed (by the user or after a `LinkError`)."""


class CodeError(ElectronicsError, ValueError):
    """The codes handed to `write` are not what the unit takes; nothing was sent."""


@dataclass(frozen=True)
class ElectronicsSettings:
    """How a unit is reached. Each back end uses the settings that it needs.

    Attributes:
        timeout_s: longest wait for the unit to take a frame or to answer.
        frame: of a framed serial unit.
        doubt: largest difference, in codes, of frames under way from what has certainly arrived, for back ends that
            know what has; 0 = any.
        channels: output channels of a unit that has as many as it has actuators.
    """

    address: str = parameter(
        text(""),
        "EDAC40: host name or IPv4 address. microscope: URI of the mirror on the device server of python-microscope, "
        "such as PYRO:Mirao52e@127.0.0.1:8000.",
    )
    port: int = parameter(whole(1234, 1, 65535), "EDAC40: TCP or UDP port.")
    discovery_port: int = parameter(
        whole(0, 0, 65535),
        "EDAC40 over UDP: discovery port (30303 on real units) by which the link is checked; 0 = not checked.",
    )
    serial_port: str = parameter(
        text("", path=True), "USB DAC-40, framed_serial: device file, for example /dev/ttyUSB0."
    )
    timeout_s: float = 1.0
    frame: FrameFormat = field(default_factory=FrameFormat)
    doubt: int = 0
    channels: int = 40


class DriveElectronics(ABC):
    """A drive unit. Public methods validate and keep track of the link, `_do_*` hooks touch the hardware.

    Outputs hold their last values when the link closes, and no supported unit can be read back: what was written is
    all that is known. One thread uses an object at a time.

    Hooks raise `OSError` (pySerial's exceptions are) or `LinkError` for a broken link; `_do_open` also those in
    `_UNOPENED`.

    Args:
        settings: where it is.

    Raises:
        ValueError: a setting that it needs is missing.
    """

    #: Number of output channels at the connector.
    channels: int
    #: Code of full scale.
    max_code: int
    #: The field of the settings without which the unit cannot be reached, and what it must be.
    needs: tuple[str, str]
    #: Frames into which a ramp divides a change of `limits.step`: more than one where a frame may be lost unnoticed, so
    #: that the change to the next frame still is no larger.
    frames_per_step: int = 1
    #: Highest frame rate of the link, Hz, from which times are predicted. Infinite = not known.
    frames_per_second: float = math.inf
    #: Whether `volts.*` are volts at the actuators; False where the unit takes other numbers.
    knows_volts: bool = True

    def __init__(self, settings: ElectronicsSettings) -> None:
        name, meaning = self.needs
        if not getattr(settings, name):
            raise ValueError(f"electronics.{name} is empty: must be {meaning}")
        self._settings = settings
        self._timeout_s = settings.timeout_s
        self.is_open = False
        self._link: Any = None

    @property
    @abstractmethod
    def where(self) -> str:
        """Name and address of the unit, for messages."""

    @property
    def sent_at(self) -> float:
        """Steady time, s, from which the pause until the next frame counts; read after `write` has returned."""
        return time.monotonic()

    def open(self) -> None:
        """Open the link. Opening an open link does nothing; no output changes.

        Raises:
            LinkError: the unit cannot be reached.
        """
        if self.is_open:
            return
        try:
            self._do_open()
        except (OSError, LinkError, *_UNOPENED) as error:
            self.close()
            reason = re.sub(r".*\[Errno \d+\] ", "", str(error))  # pySerial repeats it, with the port
            raise LinkError(f"cannot open {self.where}: {reason}") from error
        self.is_open = True

    def write(self, codes: NDArray[np.uint16], wired: Bools) -> None:
        """Set the outputs, all of them at once.

        Args:
            codes: (channels,) unsigned integers 0..max_code, by connector channel.
            wired: (channels,) True where an actuator is connected. A unit leaves the other outputs alone if it can;
                otherwise it sets them to their `codes` too.

        Raises:
            CodeError: wrong shape, type or range; nothing was sent.
            NotOpenError: the link is closed.
            LinkError: the unit did not take the frame; it may or may not have changed its outputs.
        """
        self._check_codes(codes, wired)
        self._require_open()
        self._guard(lambda: self._do_write(codes, wired), "writing to")

    def check(self) -> None:
        """Find out cheaply (microseconds, without waiting for an answer) whether the link is still up.

        Raises:
            NotOpenError: the link is closed.
            LinkError: the unit went away.
        """
        self._require_open()
        self._guard(self._do_check, "checking")

    def close(self) -> None:
        """Close the link; outputs keep their values. Closing a closed link does nothing."""
        self.is_open = False
        with suppress(OSError):  # the link is gone anyway
            self._do_close()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _check_codes(self, codes: NDArray[np.uint16], wired: Bools) -> None:
        if codes.shape != (self.channels,) or codes.dtype.kind != "u":
            raise CodeError(
                f"codes: shape {codes.shape}, type {codes.dtype}; must be ({self.channels},) unsigned integers"
            )
        if wired.shape != (self.channels,) or wired.dtype != np.bool_:
            raise CodeError(f"wired: shape {wired.shape}, type {wired.dtype}; must be ({self.channels},) bool")
        if not wired.any():
            raise CodeError("wired: no channel is set")
        # An over-range code would wrap to a small one or spill into its neighbour's bits on the wire.
        if int(codes.max()) > self.max_code:
            channel = int(codes.argmax())
            raise CodeError(f"codes[{channel}] = {int(codes[channel])}: must be 0 to {self.max_code}")

    def _require_open(self) -> None:
        if not self.is_open:
            raise NotOpenError(f"{self.where} is not open")

    def _guard(self, action: Callable[[], None], what: str) -> None:
        """Run `action`; close a link that breaks, because a stream cut inside a frame has lost its framing."""
        try:
            action()
        except (OSError, LinkError) as error:
            self.close()
            raise LinkError(f"{what} {self.where}: {error}") from error

    def _send(self, data: bytes) -> None:
        """Write to `_link`, which has a descriptor. Only waits for the unit count, not the time for which this process
        was stopped, as with pySerial.

        Raises:
            LinkError: the unit took nothing within the timeout.
        """
        while data:
            if not select.select([], [self._link], [], self._timeout_s)[1]:
                raise LinkError(f"took no data within {self._timeout_s:g} s")
            data = data[os.write(self._link.fileno(), data) :]

    @abstractmethod
    def _do_open(self) -> None:
        """Open the link and keep it as `_link`, an object with a method `close`."""

    @abstractmethod
    def _do_write(self, codes: NDArray[np.uint16], wired: Bools) -> None:
        """Encode and send one frame."""

    @abstractmethod
    def _do_check(self) -> None:
        """Raise when the link is broken."""

    def _do_close(self) -> None:
        """Close `_link`; called also after a failed `_do_open`: the link may be half made or absent."""
        link, self._link = self._link, None
        if link is not None:
            link.close()
