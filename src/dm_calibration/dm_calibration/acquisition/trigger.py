"""Running the command that makes the interferometer take a map. Independent of ROS."""

import os
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

from dm_common.errors import CodedError, ErrorCode

#: Stands, in an argument of the command, for the file that the instrument is to write.
PLACEHOLDER = "{path}"

_OUTPUT_SHOWN = 500  # characters of the command's output in an error message
_POLL_S = 0.01


class TriggerError(CodedError):
    """The command could not be started, failed, or took too long; the message shows the end of its output."""

    error_code = ErrorCode.TRIGGER_FAILED


def run_trigger(command: Sequence[str], output: Path | None, timeout_s: float, cancelled: threading.Event) -> None:
    """Run the command (an argument list; no shell is involved) and wait until it ends or `cancelled` is set.

    The command runs in its own process group, which is killed as a whole on time-out or cancellation.

    Args:
        output: replaces PLACEHOLDER in the arguments.

    Raises:
        TriggerError: it cannot be started, ends with a status other than 0, or does not end in time.
    """
    arguments = [argument.replace(PLACEHOLDER, str(output)) for argument in command]
    # Output goes to a file, not a pipe: processes that the command leaves running cannot block this call.
    with tempfile.TemporaryFile() as log:
        try:
            process = subprocess.Popen(
                arguments, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        except (OSError, ValueError) as error:
            raise TriggerError(f"trigger command {arguments[0]!r} cannot be started: {error}") from error
        deadline = time.monotonic() + timeout_s
        try:
            while (status := process.poll()) is None:
                if cancelled.wait(_POLL_S):
                    return
                if time.monotonic() >= deadline:
                    raise TriggerError(
                        f"trigger command {arguments[0]!r} did not end within {timeout_s:g} s{_tail(log)}"
                    )
        finally:
            if process.poll() is None:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)  # with all its child processes
                process.wait()
        if status != 0:
            raise TriggerError(f"trigger command {arguments[0]!r} ended with status {status}{_tail(log)}")


def _tail(log: IO[bytes]) -> str:
    size = log.seek(0, os.SEEK_END)
    log.seek(max(size - 4 * _OUTPUT_SHOWN, 0))
    text = log.read().decode(errors="replace").strip()
    return f"; its output ends: {text[-_OUTPUT_SHOWN:]}" if text else ""
