"""The report beside each calibration file: ``<id>.html`` and ``<id>.pdf``, written by a process of its own.

A report takes some seconds of drawing, which must hold up neither the node nor the result of its action; and whatever
goes wrong with it, the calibration is stored already. `./dm report` writes the same files at any time.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from dm_calibration.calibration import Calibration
from dm_calibration.store.calibration_store import CalibrationStore

#: Longest time for one report, s of wall time; a loaded machine may need a multiple of the usual few.
TIMEOUT_S = 300.0
#: A report must not take time from a bench that measures.
NICENESS = 15


class ReportWriter:
    """Writes one report after the other; of one calibration that changes meanwhile, only the last state.

    Args:
        publish: called with a sentence and whether it is a warning, from a thread of its own.
    """

    def __init__(self, publish: Callable[[str, bool], None]) -> None:
        self._publish = publish
        self._lock = threading.Lock()
        self._waiting: list[Path] = []
        self._process: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None
        self._ended = False

    def write(self, file: Path) -> None:
        """Have the report of the calibration in `file` written beside it; returns at once."""
        with self._lock:
            if self._ended or file in self._waiting:
                return
            self._waiting.append(file)
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="reports", daemon=True)
                self._thread.start()

    def end(self) -> None:
        """Stop: a report under way is given up, with no trace of it."""
        with self._lock:
            self._ended = True
            self._waiting.clear()
            process, thread = self._process, self._thread
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                process.terminate()
        if thread is not None:
            thread.join(5.0)

    def wait(self, timeout_s: float) -> bool:
        """Whether all reports were done within `timeout_s`."""
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join(timeout_s)
        return thread is None or not thread.is_alive()

    def _work(self) -> None:
        while True:
            with self._lock:
                if self._ended or not self._waiting:
                    self._thread = None
                    return
                file = self._waiting.pop(0)
                try:
                    command = [sys.executable, "-m", "dm_calibration.report.report_writer", str(file)]
                    self._process = subprocess.Popen(
                        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                        start_new_session=True,
                    )  # fmt: skip
                except OSError as error:
                    self._publish(f"no report of {file.name}: {error}", True)
                    continue
            self._finish(file, self._process)

    def _finish(self, file: Path, process: subprocess.Popen[bytes]) -> None:
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


class ReportingStore(CalibrationStore):
    """A store whose calibrations get a report beside them.

    Args:
        folder: of the calibration files.
        writer: writes them.
        wanted: whether to; asked at every calibration.
    """

    def __init__(self, folder: str | Path, writer: ReportWriter, wanted: Callable[[], bool]) -> None:
        super().__init__(folder)
        self._reports, self._wanted = writer, wanted

    def save(self, calibration: Calibration) -> Path:
        """As :meth:`CalibrationStore.save`, then the report."""
        return self._reported(super().save(calibration))

    def replace(self, calibration: Calibration) -> Path:
        """As :meth:`CalibrationStore.replace`, then the report anew."""
        return self._reported(super().replace(calibration))

    def _reported(self, file: Path) -> Path:
        if self._wanted():
            self._reports.write(file)
        return file


def main(arguments: list[str]) -> int:
    """Write the report of the calibration file named in `arguments` beside it; returns the exit status."""
    from dm_calibration.report.page import write_report

    os.nice(NICENESS)
    file = Path(arguments[0])
    try:
        write_report(CalibrationStore(file.parent).load(file.name), file.parent, file)
    except (OSError, ValueError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
