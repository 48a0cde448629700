"""Any drive unit that takes whole frames over a serial line, described by parameters alone."""

import math
import time

import numpy as np
import serial
from numpy.typing import NDArray

from dm_common import Bools
from dm_driver.electronics.base import SERIAL_PORT, DriveElectronics, ElectronicsSettings, LinkError

_PARITY = {"none": serial.PARITY_NONE, "even": serial.PARITY_EVEN, "odd": serial.PARITY_ODD}


class FramedSerial(DriveElectronics):
    """One frame sets all channels, connected or not.

    With a reply in its format the unit must answer every frame within `timeout_s`; a wrong or missing answer counts as
    a broken link, for the outputs are then unknown.
    """

    needs = SERIAL_PORT

    def __init__(self, settings: ElectronicsSettings) -> None:
        super().__init__(settings)
        frame = self._frame = settings.frame
        self.channels = frame.channels
        self.max_code = frame.max_code
        self._reply = bytes.fromhex(frame.reply)
        # Frames that the line cannot carry would queue in the system, and the mirror lag behind its commands.
        self.frames_per_second = frame.frame_rate or frame.line_rate
        self._sent_at = -math.inf

    @property
    def where(self) -> str:
        return f"framed serial unit at {self._settings.serial_port}"

    @property
    def sent_at(self) -> float:
        """When the frame was written, before its answer: the period of the line covers a frame and its answer."""
        return self._sent_at

    def _do_open(self) -> None:
        # Exclusive: two writers on one unit would tear each other's frames.
        self._link = serial.Serial(
            self._settings.serial_port,
            self._frame.baud_rate,
            parity=_PARITY[self._frame.parity],
            stopbits=self._frame.stop_bits,
            timeout=self._timeout_s,
            exclusive=True,
        )
        self._send(bytes.fromhex(self._frame.opening))

    def _do_write(self, codes: NDArray[np.uint16], wired: Bools) -> None:
        time.sleep(max(0.0, self._sent_at + 1.0 / self.frames_per_second - time.monotonic()))
        if self._reply:
            self._do_check()  # a late answer is not the answer to this frame
        self._send(self._frame.encode(codes))
        self._sent_at = time.monotonic()
        if self._reply:
            answer = self._link.read(len(self._reply))
            if answer != self._reply:
                got = answer.hex(" ") or "nothing"
                raise LinkError(
                    f"answered {got} within {self._timeout_s:g} s, not {self._reply.hex(' ')} (framed_serial.reply)"
                )

    def _do_check(self) -> None:
        """Empty the system's buffer; fails on a device that has been unplugged."""
        self._link.read(self._link.in_waiting)
