"""The journal of one run: each event is on disk before it takes effect, so that a power cut loses nothing.

A folder ``<id>/`` holds ``manifest.json`` (plan, settings, mirror, software; written once and atomically) and
``events`` (appended and synced frame by frame). A frame torn by a power cut is cut off when the run is resumed. Only
coefficients and samples are kept, some kilobytes per map; the full maps stay in the interferometer's folder, and the
journal contains their names and hashes.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dm_calibration.procedure.event_frames import FIRST, Storing, decode, encode
from dm_calibration.procedure.outcome import Event, MapTaken, Outcome, Segment
from dm_common.atomic_write import StoreError, storing, write_whole

SCHEMA = "dm_calibration/unfinished"
SCHEMA_VERSION = 1
MANIFEST, EVENTS = "manifest.json", "events"


class JournalError(ValueError):
    """A journal cannot be read; the message names it and the reason."""


@dataclass(frozen=True)
class Kept:
    """Content of a journal: a run that can be resumed.

    Attributes:
        folder: of the journal; its name is that of the run.
        maps: number of maps measured, including those in doubt.
        last_ns: wall time of the last write, ns since the epoch.
        storing: the calibration about to be stored; None = the run had not come that far.
        torn: number of bytes after the last whole frame.
    """

    folder: Path
    outcome: Outcome
    maps: int
    last_ns: int
    storing: Storing | None
    torn: int


class RunJournal:
    """The journal of a run in progress. Use :meth:`create` or :meth:`reopen`."""

    def __init__(self, folder: Path, handle: int, end: int, seal: bytes) -> None:
        self.folder = folder
        self._handle, self._end, self._seal = handle, end, seal

    @classmethod
    def create(cls, folder: Path, manifest: Mapping[str, Any]) -> RunJournal:
        """A new, empty journal.

        Raises:
            StoreError: disk full, read-only, ...
        """
        content = json.dumps({"schema": SCHEMA, "schema_version": SCHEMA_VERSION, **manifest}, indent=1)
        try:
            with storing(f"no run can be kept in {folder.parent}"):
                write_whole(folder / EVENTS, b"")
                write_whole(folder / MANIFEST, content.encode())
                return cls(folder, os.open(folder / EVENTS, os.O_WRONLY | os.O_NOFOLLOW), 0, FIRST)
        except StoreError:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    @classmethod
    def reopen(cls, folder: Path) -> RunJournal:
        """The journal in `folder`, to be continued after its last whole frame.

        Raises:
            StoreError: it cannot be opened or written.
            JournalError: it cannot be read.
        """
        frames = _frames(folder)
        end, seal = frames[-1][1:] if frames else (0, FIRST)
        with storing(f"the run in {folder} cannot be resumed"):
            handle = os.open(folder / EVENTS, os.O_WRONLY | os.O_NOFOLLOW)
            os.ftruncate(handle, end)
        return cls(folder, handle, end, seal)

    def check_room(self, size: int) -> None:
        """Check, before anything moves, that `size` more bytes can be written; the journal is unchanged.

        Raises:
            StoreError: disk full, read-only, ...
        """
        with storing(f"no room for the maps of a run, {size / 1e6:.1f} MB, in {self.folder.parent}"):
            try:
                position = self._end
                while position < self._end + size:
                    position += os.pwrite(self._handle, b"\0" * min(size, 1 << 20), position)
                os.fdatasync(self._handle)
            finally:
                os.ftruncate(self._handle, self._end)

    def keep(self, event: Event | Storing) -> None:
        """Append `event`; it is on disk when this returns.

        Raises:
            StoreError: disk full, read-only, ...; the journal is unchanged.
        """
        frame, seal = encode(event, self._seal)
        what = f"map {event.record.label}" if isinstance(event, MapTaken) else type(event).__name__.lower()
        with storing(f"the run is stored up to {what}, which could not be stored in {self.folder}"):
            try:
                view, position = memoryview(frame), self._end
                while view:
                    written = os.pwrite(self._handle, view, position)
                    view, position = view[written:], position + written
                os.fdatasync(self._handle)
            except OSError:
                with suppress(OSError):
                    os.ftruncate(self._handle, self._end)
                raise
        self._end, self._seal = self._end + len(frame), seal

    def close(self) -> None:
        """Close the file; the run stays unfinished."""
        handle, self._handle = self._handle, -1
        if handle >= 0:
            os.close(handle)

    def remove(self) -> None:
        """Close and delete the journal of a finished run. Files that cannot be deleted stay."""
        self.close()
        # The manifest first: without it the folder no longer counts as a run.
        with suppress(OSError):
            (self.folder / MANIFEST).unlink()
        shutil.rmtree(self.folder, ignore_errors=True)


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of the journal in `folder`.

    Raises:
        JournalError: damaged, foreign, or of another schema.
    """
    try:
        content = json.loads((folder / MANIFEST).read_text())
    except (OSError, ValueError) as error:
        raise JournalError(f"{folder.name}: {MANIFEST} cannot be read: {error}") from error
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise JournalError(f"{folder.name}: not a run of this suite")
    if content.get("schema_version") != SCHEMA_VERSION:
        raise JournalError(
            f"{folder.name}: schema version {content.get('schema_version')}: this software reads {SCHEMA_VERSION}"
        )
    identity = content.get("identity")
    if not isinstance(identity, dict):
        raise JournalError(f"{folder.name}: {MANIFEST} does not name the plan and settings of the run")
    if "plan_options" in identity:  # before 0.2: all options, even those not used
        identity["until"] = identity.pop("plan_options").get("until", 0.0)
        if identity.get("plan") == "MEMORY":
            identity["plan"] = "HYSTERESIS"
    return content


def read_run(folder: Path, remarks: tuple[str, ...] = ()) -> Kept:
    """Read the journal in `folder`.

    Args:
        remarks: of the plan; the outcome begins with them.

    Raises:
        JournalError: it cannot be read.
    """
    outcome = Outcome(remarks=list(remarks))
    storing: Storing | None = None
    maps = 0
    frames = _frames(folder)
    end = frames[-1][1] if frames else 0
    for event, _end, _seal in frames:
        if isinstance(event, Storing):
            storing = event
            continue
        if isinstance(event, Segment):
            storing = None
        maps += isinstance(event, MapTaken)
        outcome.take(event)
    status = (folder / EVENTS).stat()
    return Kept(folder, outcome, maps, status.st_mtime_ns, storing, status.st_size - end)


def _frames(folder: Path) -> list[tuple[Event | Storing, int, bytes]]:
    try:
        return list(decode((folder / EVENTS).read_bytes()))
    except (OSError, ValueError) as error:
        raise JournalError(f"{folder.name}: {EVENTS} cannot be read: {error}") from error
