"""ROS domains for runs that must not meet others on the same machine."""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """Lend a ROS domain that no other demo or test on this machine uses at the same time."""
    folder = Path(tempfile.gettempdir()) / f"dm-domains-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    for domain in range(1, 100):
        handle: IO[str] = (folder / str(domain)).open("w")
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            handle.close()
            continue
        try:
            yield domain
        finally:
            handle.close()
        return
    raise RuntimeError("no free ROS domain: 99 runs at once?")
