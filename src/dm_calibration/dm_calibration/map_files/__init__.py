"""Readers of interferometer map files: `read_map(path).sag` is the surface sag in metres."""

import contextlib
import dataclasses
import os
import stat
from pathlib import Path

from dm_calibration.map_files import dat
from dm_calibration.map_files.dat import is_dat, parse_dat
from dm_calibration.map_files.datx import is_datx
from dm_calibration.map_files.datx_structure import as_text, check_end
from dm_calibration.map_files.fits import is_fits, parse_fits
from dm_calibration.map_files.surface_map import MapFileError, NoValidPixelsError, SurfaceMap
from dm_calibration.map_files.text_maps import XYZ_TITLE, XYZ_UNITS, is_text, parse_asc, parse_xyz
from dm_calibration.store.hdf5_sandbox import SandboxError, read_in_sandbox

__all__ = ["XYZ_UNITS", "MapFileError", "NoValidPixelsError", "SurfaceMap", "is_complete", "read_map"]

#: Larger files are refused unread; the largest map in the most verbose format is smaller.
MAX_FILE_BYTES = 2**30

_START_BYTES = 4096


def read_map(path: str | os.PathLike[str], *, xyz_unit: str | None = None) -> SurfaceMap:
    """Read a surface map from a ZYGO `.dat`, `.asc`, `.xyz` or `.datx` file, a FITS file, or one of 4Sight.

    The format is recognised by the content; the suffix matters only for the two text formats, whose titles are
    sometimes exchanged.

    Args:
        xyz_unit: unit of the values of an `.xyz` file, one of XYZ_UNITS, and of a FITS file without BUNIT; other
            formats contain their unit.

    Raises:
        MapFileError: not a complete, readable map; the message names file, field, value and what is allowed.
        NoValidPixelsError: whole, but without a valid pixel.
    """
    path = Path(path)
    name = as_text(path)  # for messages, which must be valid UTF-8
    if "\0" in str(path):
        raise MapFileError(f"path = {str(path)!r}: must not contain a NUL character")
    try:
        content = _read(path)
        surface_map = _parse(content, path.suffix.lower(), xyz_unit)
    except OSError as error:
        raise MapFileError(f"{name}: {error.strerror or error}") from error
    except MapFileError as error:
        raise type(error)(f"{name}: {error}") from error
    written_ns = 0
    with contextlib.suppress(OSError):  # the file may have been removed since; what was read is valid
        written_ns = path.stat().st_mtime_ns
    return dataclasses.replace(surface_map, file=name, written_ns=written_ns, content=content)


def is_complete(path: Path) -> bool:
    """True for a `.dat` or `.datx` file whose length is the one stated in its header; else False, also if not a file.

    Formats that do not state their length are never known to be complete.
    """
    try:
        with open(path, "rb", opener=_open_without_waiting) as file:
            return _agrees(file.read(_START_BYTES), os.fstat(file.fileno()).st_size)
    except (OSError, MapFileError):
        return False


def _agrees(start: bytes, length: int) -> bool:
    """Whether the first bytes of a file state a length of `length` bytes; False if its format states none.

    Raises:
        MapFileError: they state another length.
    """
    if is_dat(start):
        dat.check_length(dat.read_header(start), length)
    elif is_datx(start):
        check_end(start, length)
    else:
        return False
    return True


def _read(path: Path) -> bytes:
    """Read the whole file, after its length was compared with the length that its first bytes state."""
    with open(path, "rb", opener=_open_without_waiting) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise MapFileError("not a regular file")
        if status.st_size > MAX_FILE_BYTES:
            raise MapFileError(f"file length = {status.st_size} bytes: must be at most {MAX_FILE_BYTES}")
        start = file.read(_START_BYTES)
        if not (_agrees(start, status.st_size) or is_text(start) or is_fits(start)):
            raise MapFileError(
                f"begins with bytes {start[:8].hex(' ') or '(none)'}: not a ZYGO .dat, .datx, .asc or .xyz file, no "
                "FITS file and no .h5 or .4D of 4Sight"
            )
        file.seek(0)
        return file.read(status.st_size)


def _open_without_waiting(path: str, flags: int) -> int:
    """Open without blocking: opening a named pipe would otherwise wait for its writer."""
    return os.open(path, flags | os.O_NONBLOCK)


def _parse(content: bytes, suffix: str, xyz_unit: str | None) -> SurfaceMap:
    if is_dat(content):
        return parse_dat(content)
    if is_datx(content):
        return _parse_datx(content)
    if is_fits(content):
        return parse_fits(content, xyz_unit)
    if content.lstrip().startswith(XYZ_TITLE) or suffix == ".xyz":
        return parse_xyz(content, xyz_unit)
    return parse_asc(content)


def _parse_datx(content: bytes) -> SurfaceMap:
    """`datx.parse_datx` in a separate process: damaged files can crash the HDF5 library."""
    try:
        answer = read_in_sandbox("datx", content)
    except SandboxError as error:
        raise MapFileError(f"the HDF5 content is damaged: {error}") from error
    if answer.error:
        kind = NoValidPixelsError if answer.error_kind == NoValidPixelsError.__name__ else MapFileError
        raise kind(answer.error)
    facts = answer.facts | {"origin": tuple(answer.facts["origin"])}
    return SurfaceMap(sag=answer.arrays["sag"], **facts)
