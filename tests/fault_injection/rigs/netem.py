"""A bad cable between two hosts of :mod:`studies.network_namespaces`: it loses frames, delays them, is cut.

Each end is a TAP device, and a thread here carries Ethernet frames from one to the other. (The kernel's own means, the
queueing discipline `netem`, is missing in many kernels of containers and virtual machines.)
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import struct
import threading
import time
from collections import deque
from collections.abc import Iterator
from random import Random

from studies.network_namespaces import INTERFACE, NotPermittedError, bring_up, ip, unconnected_hosts

_TUNSETIFF, _IFF_TAP, _IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
_LARGEST_FRAME = 65_536
#: Frames on their way at most, in both directions; more are lost, as in a switch.
_QUEUE = 20_000


class Netem:
    """Carries frames between two hosts until it is closed.

    Args:
        left, right: hosts without interfaces.
        random: decides which frames are lost.

    Attributes:
        loss: share of frames that are lost, in each direction.
        delay_s: of every frame, in each direction.
        plugged: False = nothing passes.
        carried, lost: frames so far.

    Raises:
        NotPermittedError: no TAP devices here.
    """

    def __init__(self, left: str, right: str, random: Random) -> None:
        self.loss, self.delay_s, self.plugged = 0.0, 0.0, True
        self.carried = self.lost = 0
        self._random = random
        self._ends: list[int] = []
        self._under_way: deque[tuple[float, int, bytes]] = deque()
        self._reader, self._waker = os.pipe()
        try:
            for side, host in enumerate((left, right)):
                self._ends.append(_tap(f"dm{os.getpid()}{'lr'[side]}"[-15:], host))
            bring_up(left, right)
        except BaseException:
            self._free()
            raise
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Take it away."""
        os.write(self._waker, b"x")
        self._thread.join()
        self._free()

    def _free(self) -> None:
        for descriptor in (*self._ends, self._reader, self._waker):
            os.close(descriptor)

    def _carry(self) -> None:
        left, right = self._ends
        other = {left: right, right: left}
        while True:
            wait = self._deliver()
            readable, _, _ = select.select([left, right, self._reader], [], [], wait)
            if self._reader in readable:
                return
            for end in readable:
                self._take(end, other[end])

    def _take(self, end: int, to: int) -> None:
        """All frames that wait at an end."""
        while True:
            try:
                frame = os.read(end, _LARGEST_FRAME)
            except BlockingIOError:
                return
            if not self.plugged or self._random.random() < self.loss or len(self._under_way) >= _QUEUE:
                self.lost += 1
            else:
                self._under_way.append((time.monotonic() + self.delay_s, to, frame))

    def _deliver(self) -> float | None:
        """Deliver what is due; returns how long until the next is, s, None = there is none."""
        while self._under_way:
            due, to, frame = self._under_way[0]
            remaining = due - time.monotonic()
            if remaining > 0.0:
                return remaining
            self._under_way.popleft()
            if self.plugged:
                with contextlib.suppress(OSError):  # an end that takes no more loses the frame
                    os.write(to, frame)
                    self.carried += 1
        return None


def _tap(name: str, host: str) -> int:
    """A TAP device on a host; returns the descriptor on which its frames are read and written."""
    try:
        descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(descriptor, _TUNSETIFF, struct.pack("16sH14x", name.encode(), _IFF_TAP | _IFF_NO_PI))
    except OSError as error:
        raise NotPermittedError(f"/dev/net/tun: {error.strerror}") from error
    ip("link", "set", name, "netns", host)
    ip("-n", host, "link", "set", name, "name", INTERFACE)
    return descriptor


@contextlib.contextmanager
def bad_network(random: Random) -> Iterator[tuple[str, str, Netem]]:
    """Two hosts and the cable between them, which is good at first.

    Raises:
        NotPermittedError: not on this machine.
    """
    with unconnected_hosts() as (left, right):
        netem = Netem(left, right, random)
        try:
            yield left, right, netem
        finally:
            netem.close()
