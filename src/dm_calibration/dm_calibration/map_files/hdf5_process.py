"""The helper process that opens HDF5 files; see :mod:`dm_calibration.store.hdf5_sandbox`. Reads requests from stdin."""

import math
import os
import resource
import sys
from collections.abc import Callable
from dataclasses import fields
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np

from dm_calibration.map_files.datx import parse_datx
from dm_calibration.map_files.surface_map import MAX_PIXELS, MapFileError
from dm_calibration.store.hdf5_image import ImageError, parse_image
from dm_calibration.store.hdf5_sandbox import CPU_BASE_S, CPU_PER_BYTE_S, receive, send

#: Address space allowed beyond that at the start and that for the file, bytes: for the largest map, and a working copy.
MEMORY = 3 * 8 * MAX_PIXELS

Found = tuple[dict[str, Any], dict[str, np.ndarray]]


def datx(content: bytes) -> Found:
    """A map: its fields as facts, and the array "sag"."""
    found = parse_datx(content)
    facts = {
        item.name: getattr(found, item.name) for item in fields(found) if item.name not in ("sag", "content", "file")
    }
    return facts, {"sag": found.sag}


def image(content: bytes) -> Found:
    """Columns and attributes of a calibration file; columns of texts and attributes are returned as facts."""
    columns, attributes = parse_image(content)
    texts = {name: value for name, value in columns.items() if isinstance(value, tuple)}
    arrays = {name: value for name, value in columns.items() if not isinstance(value, tuple)}
    return {"texts": texts, "attributes": attributes}, arrays


TASKS: dict[str, Callable[[bytes], Found]] = {"datx": datx, "image": image}


def limit(length: int) -> None:
    """Limit computing time and memory for the next file of `length` bytes. Exceeding a limit ends only this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = math.ceil(used.ru_utime + used.ru_stime + CPU_BASE_S + length * CPU_PER_BYTE_S)
    _lower(resource.RLIMIT_CPU, seconds)
    _lower(resource.RLIMIT_AS, _AT_START + MEMORY + 2 * length)


def _lower(kind: int, value: int) -> None:
    _soft, hard = resource.getrlimit(kind)
    resource.setrlimit(kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


_AT_START = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")


def main() -> int:
    """Serve until standard input ends."""
    requests, answers, shared = sys.stdin.buffer, sys.stdout.buffer, FileIO(int(sys.argv[1]), "r+")
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    while (head := receive(requests)) is not None:
        limit(head["length"])
        shared.seek(0)
        content = shared.read(head["length"])
        facts: dict[str, Any] = {}
        arrays: dict[str, np.ndarray] = {}
        error = kind = ""
        try:
            facts, arrays = TASKS[head["task"]](content)
        except (MapFileError, ImageError) as refusal:
            error, kind = str(refusal), type(refusal).__name__
        shared.seek(0)
        for value in arrays.values():
            np.save(shared, value, allow_pickle=False)
        send(answers, {"facts": facts, "arrays": list(arrays), "error": error, "error_kind": kind})
    return 0


if __name__ == "__main__":
    sys.exit(main())
