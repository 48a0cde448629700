"""The folder of interrupted runs: which of them a new goal resumes, and what happens to the others.

A run is resumed if plan, settings and mirror are the same and it is not too old. A run that will not be resumed is set
aside, and never deleted at once: its maps may still be wanted. Only one node at a time works in the folder.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from dm_calibration.procedure.run_journal import MANIFEST, JournalError, Kept, RunJournal, read_manifest, read_run
from dm_common.atomic_write import storing
from dm_common.errors import ErrorCode, Refusal

#: Name of the folder inside the folder of calibrations.
FOLDER = "unfinished"
#: Suffix of runs that were set aside.
ASIDE = ".set-aside"
#: Number of runs set aside that are kept (the newest).
ASIDE_MAX = 5
#: Number of runs with other settings that are kept (the newest), for goals with those settings.
WAITING_MAX = 20

_LOCK = ".lock"


class UnfinishedRuns:
    """Runs in ``<calibrations>/unfinished``. Use as a context manager during a run: only one may be in progress."""

    def __init__(self, calibrations: Path) -> None:
        self.folder = calibrations / FOLDER
        self._lock = -1

    def __enter__(self) -> UnfinishedRuns:
        """Lock the folder.

        Raises:
            Refusal: another node is calibrating into it.
            StoreError: it cannot be created.
        """
        with storing(f"no run can be kept in {self.folder}"):
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self.folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        try:
            # The lock ends with the process, even with kill -9.
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            text = f"another node is calibrating into {self.folder.parent}: wait for it or stop it"
            raise Refusal(ErrorCode.BUSY, text) from None
        return self

    def __exit__(self, *_exception: object) -> None:
        os.close(self._lock)

    def begin(self, identity: Mapping[str, Any], about: Mapping[str, Any]) -> RunJournal:
        """The journal of a new run.

        Args:
            about: further facts, for the reader of the manifest only.

        Raises:
            StoreError: disk full, read-only, ...
        """
        stem = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        names = (f"{stem}-{number}" if number else stem for number in range(10_000))
        # Avoid the names of runs set aside as well: this run may have to be set aside too.
        taken = {path.name.removesuffix(ASIDE) for path in self.folder.iterdir()}
        name = next(name for name in names if name not in taken)
        return RunJournal.create(self.folder / name, {"identity": identity, **about})

    def find(self, identity: Mapping[str, Any], remarks: tuple[str, ...] = ()) -> tuple[list[Kept], list[str]]:
        """Runs of the same plan, settings and mirror with at least one map, the newest first.

        Also a sentence for each other run, with the reason why a goal with `identity` cannot resume it.
        """
        found, others = list[Kept](), list[str]()
        for folder in self._runs():
            if os.access(folder, os.R_OK | os.X_OK) and not (folder / MANIFEST).exists():
                continue  # what is left of a finished run
            try:
                theirs = read_manifest(folder)["identity"]
                kept = read_run(folder, remarks) if theirs == identity else None
            except JournalError as error:
                others.append(str(error))
                continue
            if kept is None:
                differing = sorted(name for name in {*theirs, *identity} if theirs.get(name) != identity.get(name))
                others.append(f"{folder.name}: other {', '.join(differing)}: only the goal that began it resumes it")
            elif kept.maps:
                found.append(kept)
            else:
                shutil.rmtree(folder, ignore_errors=True)
        return sorted(found, key=lambda run: (run.last_ns, run.folder.name), reverse=True), others

    def set_aside(self, folder: Path) -> Path:
        """Keep the run in `folder`, but never resume it.

        Raises:
            StoreError: read-only, ...
        """
        target = folder.with_name(folder.name + ASIDE)
        with storing(f"run {folder.name} cannot be set aside"):
            return folder.rename(target)

    def prune(self, going_on: Path | None = None) -> list[str]:
        """Delete the oldest surplus runs, except `going_on`; returns their names."""
        aside = sorted(self.folder.glob(f"*{ASIDE}"), reverse=True)
        waiting = sorted(self._runs(), reverse=True)[WAITING_MAX:]
        removed = aside[ASIDE_MAX:] + [folder for folder in waiting if folder != going_on]
        for folder in removed:
            with suppress(OSError):
                shutil.rmtree(folder)
        return [folder.name for folder in removed]

    def _runs(self) -> list[Path]:
        return [
            path
            for path in self.folder.iterdir()
            if path.is_dir() and not path.is_symlink() and not path.name.startswith(".") and path.suffix != ASIDE
        ]
