"""Watching a folder for files that another machine writes. Independent of ROS.

A file is taken once its size and modification time have not changed for a while, or at once if this machine's kernel
reports that its writer closed it and its length is the one stated in its header. The clocks of two machines need not
agree: times are measured by this machine's monotonic clock.
"""

import fnmatch
import stat
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from dm_calibration.map_files import is_complete


class Signature(NamedTuple):
    """Properties of a file that change when it is written."""

    inode: int
    size: int
    modified_ns: int


@dataclass
class _Candidate:
    signature: Signature
    since: float  # monotonic time at which it was first seen with this signature
    done: bool = False  # taken or refused in this state


class FileEvent(NamedTuple):
    """A file that is ready, or refused with the reason, with its signature at that time."""

    path: Path
    signature: Signature
    refused: str = ""


class FolderWatch:
    """Finds new files in a folder (not in subfolders) and reports each version of a file once.

    Files that exist at the first successful listing do not count as new until they are written again.
    """

    def __init__(self, folder: Path, patterns: Sequence[str], stable_time: float) -> None:
        """Nothing is accessed before the first :meth:`poll`: the folder may be on a disk that is mounted later.

        Args:
            patterns: shell patterns of file names, case-insensitive; names that begin with a dot never match.
            stable_time: s for which size and modification time must not change.
        """
        self.folder = folder
        self._patterns = [pattern.lower() for pattern in patterns]
        self._stable_time = stable_time
        self._known: dict[str, _Candidate] | None = None
        self._ignored: set[str] = set()
        # The disk that was listed last, and the known files of other disks: a disk mounted later brings old files.
        self._disk = 0
        self._known_on: dict[int, dict[str, _Candidate]] = {}

    def ignore(self, path: Path) -> None:
        """Never report this file."""
        self._ignored.add(path.name)

    def poll(self, now: float) -> list[FileEvent]:
        """List the folder; `now` is a monotonic time in s.

        Returns the files that became ready since the last listing, oldest first.

        Raises:
            OSError: the folder cannot be read now; the known files are kept.
        """
        disk, listed = self.folder.stat().st_dev, self.signatures()
        if self.folder.stat().st_dev != disk:  # it is being mounted
            return []
        if disk != self._disk:
            if self._known is not None:
                self._known_on[self._disk] = self._known
            self._disk, self._known = disk, self._known_on.pop(disk, None)
            if self._known is None:
                self._known = self._known_on_other_device(listed)
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
                ready.append((signature.modified_ns, self._event_of(name, signature)))
        self._known = known
        return [event for _time, event in sorted(ready)]

    def _known_on_other_device(self, listed: Mapping[str, Signature]) -> dict[str, _Candidate] | None:
        """Known files of a disk that has come back as another device, known by a `listed` file; None = none has."""
        for device, known in self._known_on.items():
            if any(listed.get(name) == candidate.signature for name, candidate in known.items()):
                return self._known_on.pop(device)
        return None

    def closed(self, names: Iterable[str], now: float) -> list[FileEvent]:
        """Check files that their writer has just closed; those known to be complete are ready without waiting.

        All others, including those that would be refused, are left to :meth:`poll`.
        """
        ready = []
        for name in names:
            if self._known is None or (signature := self._signature(name)) is None:
                continue
            candidate = self._known.get(name)
            if candidate is None or candidate.signature != signature:
                candidate = self._known[name] = _Candidate(signature, now)
            event = self._event_of(name, signature)
            if not candidate.done and not event.refused and is_complete(event.path):
                candidate.done = True
                ready.append(event)
        return ready

    def signatures(self) -> dict[str, Signature]:
        """Signatures of the matching names that exist now; of links, those of their targets.

        Raises:
            OSError: the folder cannot be read now.
        """
        seen = {path.name: self._signature(path.name) for path in self.folder.iterdir()}
        return {name: signature for name, signature in seen.items() if signature is not None}

    def _signature(self, name: str) -> Signature | None:
        """Signature of a watched file; None if it is not watched, no longer exists, or is a dangling link."""
        if name in self._ignored or not self._matches(name):
            return None
        try:
            status = (self.folder / name).stat()
        except OSError:
            return None
        return Signature(status.st_ino, status.st_size, status.st_mtime_ns)

    def _matches(self, name: str) -> bool:
        return not name.startswith(".") and any(fnmatch.fnmatchcase(name.lower(), p) for p in self._patterns)

    def _event_of(self, name: str, signature: Signature) -> FileEvent:
        path = self.folder / name
        try:
            target = path.resolve(strict=True)
            if not target.is_relative_to(self.folder.resolve()):
                return FileEvent(path, signature, "a symbolic link that leads out of the watched folder")
            if not stat.S_ISREG(target.stat().st_mode):
                return FileEvent(path, signature, "not a regular file")
            if path.is_symlink() and target.parent == self.folder.resolve() and self._matches(target.name):
                return FileEvent(path, signature, f"a link to {target.name}, which is read under its own name")
        except OSError as error:
            return FileEvent(path, signature, f"{error.strerror}")
        return FileEvent(target if path.is_symlink() else path, signature)
