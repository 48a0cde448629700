"""Immediate notification by the kernel of written files; polling would have to wait until they are stable.

Linux reports only writers on this machine (inotify(7)); files that another machine writes are found by polling.
"""

import ctypes
import os
import select
import struct
import time
from pathlib import Path

_CLOSE_WRITE, _MOVED_TO, _IGNORED, _ONLYDIR = 0x8, 0x80, 0x8000, 0x01000000
_EVENT = struct.Struct("iIII")  # watch, mask, cookie, length of the name that follows
_BUFFER = 64 * 1024
#: Time after which a folder that could not be watched is tried again, s.
RETRY_S = 1.0


class ClosedFiles:
    """Names of files in one folder that their writer has closed, or that were moved there under their name.

    If the kernel offers no inotify, no error is raised and no names are reported.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._library = ctypes.CDLL(None, use_errno=True)
        self._descriptor: int = self._library.inotify_init1(os.O_CLOEXEC | os.O_NONBLOCK)
        self._watching = False
        self._tried = -RETRY_S

    def wait(self, seconds: float) -> list[str]:
        """Names as soon as at least one is reported; empty after `seconds`."""
        if self._descriptor < 0:
            time.sleep(max(seconds, 0.0))
            return []
        if not self._watching and time.monotonic() >= self._tried + RETRY_S:
            self._tried = time.monotonic()
            mask, path = _CLOSE_WRITE | _MOVED_TO | _ONLYDIR, os.fsencode(self._folder)
            self._watching = self._library.inotify_add_watch(self._descriptor, path, mask) >= 0
        if not select.select([self._descriptor], [], [], max(seconds, 0.0))[0]:
            return []
        content, names, at = os.read(self._descriptor, _BUFFER), [], 0
        while at < len(content):
            _watch, mask, _cookie, length = _EVENT.unpack_from(content, at)
            at += _EVENT.size + length
            if mask & _IGNORED:
                self._watching = False  # the folder is gone, perhaps to be mounted again
            elif length:
                names.append(os.fsdecode(content[at - length : at].rstrip(b"\0")))
        return names

    def close(self) -> None:
        """End watching."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
