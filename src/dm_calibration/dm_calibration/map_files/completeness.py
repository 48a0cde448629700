"""Whether a map file is as long as it says itself, from its first bytes."""

from __future__ import annotations

import os
import struct
from pathlib import Path

from dm_calibration.map_files import MapFileError
from dm_calibration.map_files.dat import check_length, is_dat, read_header

_START_BYTES = 4096
_HDF5 = b"\x89HDF\r\n\x1a\n"


def is_complete(path: Path) -> bool:
    """True for a `.dat` or `.datx` file of exactly the length it tells; False for others, and for what is no file.

    Formats that do not tell their length are never known to be whole.
    """
    try:
        # Opening a named pipe would otherwise wait for its writer.
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
            start, length = file.read(_START_BYTES), os.fstat(file.fileno()).st_size
    except OSError:
        return False
    if is_dat(start):
        try:
            check_length(read_header(start), length)
        except MapFileError:
            return False
        return True
    return _hdf5_end(start) == length


def _hdf5_end(start: bytes) -> int | None:
    """End of file by the superblock (HDF5 File Format Specification 3.0, II.A); None = not HDF5 as ZYGO writes it."""
    if len(start) < 48 or not start.startswith(_HDF5):
        return None
    version = start[8]
    # Versions 0 and 1 tell the size of addresses at byte 13, later ones at byte 9; it is 8 in all files of 64 bits.
    if version < 2:
        at, size = (40, start[13]) if version == 0 else (44, start[13])
    else:
        at, size = 28, start[9]
    if size != 8 or version > 3 or len(start) < at + 8:
        return None
    return int(struct.unpack_from("<Q", start, at)[0])
