"""Watching a folder for files that another machine writes. Knows no ROS.

A file is taken when its size and time have stood still for a while, or at once when this machine's kernel tells that
its writer has closed it and it is as long as it says itself. Nothing depends on clocks of two machines agreeing:
stillness is judged by this machine's monotonic clock.
"""

import fnmatch
import stat
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from dm_calibration.map_files import is_complete


class Signature(NamedTuple):
    """What changes when a file is written."""

    inode: int
    size: int
    modified_ns: int


@dataclass
class _Candidate:
    signature: Signature
    since: float  # monotonic time at which it was first seen with this signature
    done: bool = False  # taken or refused in this state


class FileEvent(NamedTuple):
    """A file that is ready, or refused with the reason, and what it looked like then."""

    path: Path
    signature: Signature
    refused: str = ""


class FolderWatch:
    """Finds files that are new in a folder (not below it), each state of a file once.

    Files that exist at the first listing that succeeds are not new, until they are written again.
    """

    def __init__(self, folder: Path, patterns: Sequence[str], stable_time: float) -> None:
        """Nothing is touched before the first :meth:`poll`: the folder may be on a disk that is mounted later.

        Args:
            patterns: shell patterns of file names, case-insensitive; names that begin with a dot never match.
            stable_time: s for which size and time must not change.
        """
        self.folder = folder
        self._patterns = [pattern.lower() for pattern in patterns]
        self._stable_time = stable_time
        self._known: dict[str, _Candidate] | None = None
        self._ignored: set[str] = set()

    def ignore(self, path: Path) -> None:
        """Never report this file, whatever becomes of it."""
        self._ignored.add(path.name)

    def poll(self, now: float) -> list[FileEvent]:
        """List the folder; `now` is a monotonic time in s.

        Returns what became ready since the last listing, oldest first.

        Raises:
            OSError: the folder cannot be read now; what is known is kept.
        """
        listed = self.signatures()
        if self._known is None:
            self._known = {name: _Candidate(signature, now, done=True) for name, signature in listed.items()}
        known = {name: candidate for name, candidate in self._known.items() if name in listed}
        ready: list[tuple[int, FileEvent]] = []
        for name, signature in listed.items():
            candidate = known.get(name)
            if candidate is None or candidate.signature != signature:
                known[name] = _Candidate(signature, now)
            elif not candidate.done and now - candidate.since >= self._stable_time:
                candidate.done = True
                ready.append((signature.modified_ns, self._judge(name, signature)))
        self._known = known
        return [event for _time, event in sorted(ready)]

    def closed(self, names: Iterable[str], now: float) -> list[FileEvent]:
        """Check files whose writer has just closed them, as far as they are known to be whole, which need not wait.

        Others are left to :meth:`poll`, so are those that it would refuse.
        """
        ready = []
        for name in names:
            if self._known is None or (signature := self._signature(name)) is None:
                continue
            candidate = self._known.get(name)
            if candidate is None or candidate.signature != signature:
                candidate = self._known[name] = _Candidate(signature, now)
            event = self._judge(name, signature)
            if not candidate.done and not event.refused and is_complete(event.path):
                candidate.done = True
                ready.append(event)
        return ready

    def signatures(self) -> dict[str, Signature]:
        """Of the matching names that are there now; for links, of what they point to.

        Raises:
            OSError: the folder cannot be read now.
        """
        seen = {path.name: self._signature(path.name) for path in self.folder.iterdir()}
        return {name: signature for name, signature in seen.items() if signature is not None}

    def _signature(self, name: str) -> Signature | None:
        """Of a file that is watched for; None = of none such, or it is gone again, or a link to nowhere."""
        if name in self._ignored or not self._matches(name):
            return None
        try:
            status = (self.folder / name).stat()
        except OSError:
            return None
        return Signature(status.st_ino, status.st_size, status.st_mtime_ns)

    def _matches(self, name: str) -> bool:
        return not name.startswith(".") and any(fnmatch.fnmatchcase(name.lower(), p) for p in self._patterns)

    def _judge(self, name: str, signature: Signature) -> FileEvent:
        path = self.folder / name
        try:
            target = path.resolve(strict=True)
            if not target.is_relative_to(self.folder.resolve()):
                return FileEvent(path, signature, "a symbolic link that leads out of the watched folder")
            if not stat.S_ISREG(target.stat().st_mode):
                return FileEvent(path, signature, "not a regular file")
            if path.is_symlink() and target.parent == self.folder.resolve() and self._matches(target.name):
                return FileEvent(path, signature, f"a link to {target.name}, which is taken under its own name")
        except OSError as error:
            return FileEvent(path, signature, f"{error.strerror}")
        return FileEvent(target if path.is_symlink() else path, signature)
