"""The report beside each calibration file: ``<id>.html`` and ``<id>.pdf``, written by a separate process.

Drawing a report takes some seconds, which must delay neither the node nor the result of its action. If it fails, the
calibration is stored nevertheless. `./dm report` writes the same files at any time.
"""

import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from dm_calibration.calibration_parameters import CRITERIA
from dm_calibration.store.calibration_store import CalibrationStore

#: Time limit for one report, s of wall time; on a loaded machine it may take many times the usual few seconds.
TIMEOUT_S = 300.0
#: Niceness of the process: a report must not take computing time from a bench that measures.
NICENESS = 15


class ReportWriter:
    """Writes one report after another; if a calibration changes while it waits, only its last state is reported.

    Args:
        publish: called with a sentence and whether it is a warning, from the thread of the writer.
        values: of the node's parameters; those of CRITERIA are read when a report is begun.
    """

    def __init__(self, publish: Callable[[str, bool], None], values: Mapping[str, Any] = CRITERIA) -> None:
        self._publish, self._values = publish, values
        self._lock = threading.Lock()
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="reports")
        self._waiting: set[Path] = set()
        self._process: subprocess.Popen[bytes] | None = None
        self._ended = False

    def write(self, file: Path) -> None:
        """Start writing the report of the calibration in `file` beside it; returns at once."""
        with self._lock:
            if not self._ended and file not in self._waiting:
                self._waiting.add(file)
                self._worker.submit(self._work, file)

    def end(self) -> None:
        """Stop: a report in progress is aborted and leaves no files."""
        with self._lock:
            self._ended = True
            if self._process is not None:
                with contextlib.suppress(ProcessLookupError):
                    self._process.terminate()
        self.finish()

    def finish(self) -> None:
        """Wait until all reports are finished; no more are accepted."""
        self._worker.shutdown()

    def _work(self, file: Path) -> None:
        with self._lock:
            self._waiting.discard(file)
            if self._ended:
                return
            values = json.dumps({name: self._values[name] for name in CRITERIA})
            try:
                self._process = process = subprocess.Popen(
                    [sys.executable, "-m", "dm_calibration.report.report_writer", str(file), values],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.PIPE,
                    start_new_session=True,
                )
            except OSError as error:
                self._publish(f"no report of {file.name}: {error}", True)
                return
        try:
            errors = process.communicate(timeout=TIMEOUT_S)[1].decode(errors="replace").strip()
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            errors = f"it took longer than {TIMEOUT_S:g} s"
        for leftover in file.parent.glob(f".{file.stem}.*.{process.pid}.tmp"):
            leftover.unlink(missing_ok=True)
        with self._lock:
            self._process = None
            if self._ended:
                return
        if process.returncode == 0:
            self._publish(f"report written: {file.with_suffix('.html').name} and .pdf beside the calibration", False)
        else:
            reason = errors.splitlines()[-1] if errors else f"its process ended with status {process.returncode}"
            self._publish(f"no report of {file.name}: {reason}; `./dm report` tries again", True)


def main(arguments: list[str]) -> int:
    """Write the report beside the calibration file `arguments`[0], judged by the parameters in `arguments`[1] (JSON);
    returns the exit status.
    """
    from dm_calibration.report.page import write_report

    os.nice(NICENESS)
    file = Path(arguments[0])
    try:
        write_report(CalibrationStore(file.parent).load(file.name), file.parent, file, json.loads(arguments[1]))
    except (OSError, ValueError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
