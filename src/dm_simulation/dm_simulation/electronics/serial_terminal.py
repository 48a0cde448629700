"""The serial unit on a pseudo-terminal: a USB DAC-40, or a unit whose frames a data sheet describes."""

import os
import tty
from collections.abc import Callable
from pathlib import Path

from dm_simulation.electronics import frames
from dm_simulation.electronics.drive_unit import DriveUnit
from dm_simulation.electronics.event_loop import EventLoop
from dm_simulation.electronics.framed_unit import FramedConfig, FramedDecoder
from dm_simulation.electronics.frames import FrameError


class SerialTerminal:
    """Carries out the frames that a client writes to the terminal.

    Args:
        unit: the drive unit that the frames set.
        framed: frames of the unit; without channels it is a USB DAC-40.
        loop: runs everything except the constructor.
        on_update: called after every frame that was carried out.
        reject: called with source and reason if bytes are not a frame.

    Raises:
        ValueError: an inconsistent description of frames; the message names the parameter.
    """

    def __init__(
        self,
        unit: DriveUnit,
        framed: FramedConfig,
        loop: EventLoop,
        on_update: Callable[[], None],
        reject: Callable[[str, str], None],
    ) -> None:
        if framed.channels > len(unit.outputs):
            raise ValueError(
                f"framed.channels = {framed.channels}: must not exceed {len(unit.outputs)}, the outputs with "
                f"electronics.channels = {unit.config.channels}"
            )
        self._unit = unit
        decoder = FramedDecoder(framed) if framed.channels else None
        self._take = frames.take_dac40 if decoder is None else decoder.take
        self._reply = b"" if decoder is None else decoder.reply
        self._loop = loop
        self._on_update = on_update
        self._reject = reject
        self._descriptors: tuple[int, int] | None = None
        self._link = Path()
        self._name = ""
        self._received = bytearray()

    def open(self, link: Path) -> None:
        """Make the terminal and the symbolic link to it. Raises OSError if the link cannot be made."""
        leader, follower = os.openpty()
        self._descriptors = (leader, follower)  # the follower stays open, so that the outputs outlast the client
        tty.setraw(follower)
        os.set_blocking(leader, False)
        self._link, self._name = link, os.ttyname(follower)
        if link.is_symlink() and str(link.readlink()).startswith("/dev/pts/"):
            link.unlink()  # left behind by a bench that was killed
        try:
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(self._name)
        except OSError as error:
            raise OSError(f"electronics.pty_link = {str(link)!r}: {error}") from None
        self._loop.watch(leader, self._on_readable)

    def close(self) -> None:
        """Remove terminal and link, if they exist."""
        if self._descriptors is None:
            return
        self._loop.forget(self._descriptors[0])
        for descriptor in self._descriptors:
            os.close(descriptor)
        self._descriptors = None
        self._received.clear()
        if self._link.is_symlink() and str(self._link.readlink()) == self._name:
            self._link.unlink()

    def _on_readable(self) -> None:
        assert self._descriptors is not None
        try:
            self._received += os.read(self._descriptors[0], 65536)
        except OSError:
            return
        while True:
            try:
                outputs = self._take(self._received)
            except FrameError as error:
                self._reject("serial", str(error))
                continue
            if outputs is None:
                return
            self._unit.take_shares(outputs)
            self._on_update()
            if self._reply:
                os.write(self._descriptors[0], self._reply)
