"""Files that are written whole or not at all, even if the power fails meanwhile."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dm_common.errors import CodedError, ErrorCode


class StoreError(CodedError):
    """Something could not be written; the message says why, and nothing that was stored has changed."""

    error_code = ErrorCode.STORAGE_FAILED


@contextmanager
def storing(failure: str) -> Iterator[None]:
    """Turn an OSError raised in the body into a StoreError whose message begins with `failure`."""
    try:
        yield
    except OSError as error:
        raise StoreError(f"{failure}: {error.strerror or error}") from error


def is_stream(path: Path) -> bool:
    """Whether `path` is a device, a pipe or an open file (/dev/stdout): it is written to, never read or replaced."""
    return path.parent in (Path("/dev"), Path("/dev/fd")) or (
        path.exists() and not path.is_file() and not path.is_dir()
    )


def write_whole(path: Path, content: bytes) -> None:
    """Write `content` to a temporary file and rename that to `path` in one step; the folder is created if needed.

    A link at `path` stays: what it leads to is replaced. The permissions of a file stay. A device or a pipe is written
    to, and not replaced by a file.

    Raises:
        OSError: disk full, read-only, ...; the previous file at `path` is then unchanged.
    """
    if is_stream(path):
        with path.open("ab") as stream:
            stream.write(content)
        return
    path = Path(os.path.realpath(path))
    # A name of its own: other threads, or a process of the same id in another container, may write the same file.
    temporary = path.with_name(f".{path.name}.{os.urandom(4).hex()}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("xb") as file:
            with suppress(OSError):  # a new file; some file systems know no permissions
                shutil.copymode(path, temporary)
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    # Some network file systems cannot sync a folder; the file is complete and has its name nevertheless.
    with suppress(OSError):
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
