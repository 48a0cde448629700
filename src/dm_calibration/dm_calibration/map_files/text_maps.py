"""ZYGO's text formats `.asc` and `.xyz`, which share fourteen header lines (docs/map-files.md).

Fields are found by line number and position, as quotes around texts can be damaged in real files.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dm_calibration.map_files.surface_map import (
    METRES,
    MapFileError,
    SurfaceMap,
    check_heights,
    check_size,
    check_wavelength,
    sag_from_counts,
    zygo_map,
)
from dm_common import Floats

ASC_TITLE = b"Zygo ASCII Data File"
XYZ_TITLE = b"Zygo XYZ Data File"
LINES = 14
_LONGEST_NUMBER = 40  # characters; bounds the memory that one absurd token can claim

#: For each field: header line and position in it (both counted from 1), type, and the name used in messages.
_FIELDS: dict[str, tuple[int, int, type, str]] = {
    "time_stamp": (8, 8, int, "time stamp"),
    "intensity_width": (3, 3, int, "intensity width"),
    "intensity_height": (3, 4, int, "intensity height"),
    "intensity_buckets": (3, 5, int, "intensity buckets"),
    "origin_x": (4, 1, int, "phase origin x"),
    "origin_y": (4, 2, int, "phase origin y"),
    "width": (4, 3, int, "phase width"),
    "height": (4, 4, int, "phase height"),
    "scale_factor": (8, 2, float, "interferometric scale factor"),
    "wavelength": (8, 3, float, "wavelength"),
    "obliquity": (8, 5, float, "obliquity factor"),
    "lateral_resolution": (8, 7, float, "lateral resolution"),
    "system_type": (9, 3, int, "system type"),
    "system_serial": (9, 5, int, "system serial number"),
    "phase_resolution": (11, 1, int, "phase resolution code"),
    "data_sign": (11, 8, int, "data sign"),
    "system_error_subtracted": (12, 1, int, "system error subtracted"),
}


def is_text(start: bytes) -> bool:
    """Whether the first bytes of a file are the title of one of the text formats."""
    return start.lstrip().startswith((ASC_TITLE, XYZ_TITLE))


def read_header(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the header fields by name, and the body, which begins with the `#` after the header.

    Raises:
        MapFileError: too few lines, a number missing or unreadable, or no `#` after the header.
    """
    lines = content.split(b"\n", LINES)
    if len(lines) <= LINES:
        raise MapFileError(f"header: {len(lines)} lines, must be {LINES} and a '#'; the file is truncated")
    body = lines.pop().lstrip()
    if not body.startswith(b"#"):
        raise MapFileError(f"line {LINES + 1}: must be '#', the end of the header")
    header: dict[str, Any] = {}
    for field, (line, position, kind, name) in _FIELDS.items():
        try:
            value = float(lines[line - 1].decode("latin-1").split()[position - 1])
        except (IndexError, ValueError):
            raise MapFileError(f"{name}: no number at position {position} of header line {line}") from None
        if kind is int and not (abs(value) < 2**53 and value == int(value)):
            raise MapFileError(f"{name} = {value:g} in header line {line}: must be an integer")
        header[field] = kind(value)
    return header, body


def numbers(text: bytes, name: str, expected: int, dtype: type) -> NDArray[Any]:
    """Return the whitespace-separated numbers of `text`, exactly `expected` of them.

    Raises:
        MapFileError: another count, or a text that is not a number.
    """
    if 2 * expected > len(text) + 1:  # a number takes a digit and a separator
        raise MapFileError(f"{name}: {len(text)} characters cannot hold {expected} values; the file is truncated")
    tokens = text.split(None, expected)  # splitting further would take twenty times the memory of the file
    if len(tokens) != expected:
        many = f"more than {expected}" if len(tokens) > expected else len(tokens)
        raise MapFileError(f"{name}: {many} values, must be {expected}")
    if max(map(len, tokens), default=0) > _LONGEST_NUMBER:
        raise MapFileError(f"{name}: holds a word of more than {_LONGEST_NUMBER} characters, must be numbers")
    try:
        return np.array(tokens, dtype=np.bytes_).astype(dtype)
    except (ValueError, OverflowError) as error:
        raise MapFileError(f"{name}: {error}") from None


def _phase_section(intensities: int, body: bytes) -> bytes:
    """The text between the `#` before the phase data and the `#` after them."""
    before, *sections, after = body.split(b"#")
    if before.strip() or after.strip():
        raise MapFileError("the phase data do not end with '#'; the file is truncated")
    if len(sections) == 2:
        numbers(sections[0], "intensity data", intensities, np.int64)
        return sections[1]
    if len(sections) == 1 and intensities == 0:  # the intensity section may be left out when it is empty
        return sections[0]
    raise MapFileError(
        f"{len(sections)} data sections between '#' marks: must be intensity and phase; the file is truncated"
    )


def parse_asc(content: bytes) -> SurfaceMap:
    """Parse a whole `.asc` file ("Zygo ASCII Data File - Format 2"). Raises MapFileError as :func:`parse_xyz`."""
    header, body = read_header(content)
    pixels = check_size(header["width"], header["height"])
    intensities = header["intensity_width"] * header["intensity_height"] * header["intensity_buckets"]
    counts = numbers(_phase_section(intensities, body), "phase data", pixels, np.int64)
    sag = sag_from_counts(counts.reshape(header["height"], header["width"]), header)
    return zygo_map(sag, header, "asc", f"system type {header['system_type']}")


#: Units the value column may be in, as m; None = waves of the file's wavelength.
XYZ_UNITS: dict[str, float | None] = {**METRES, "waves": None}


def parse_xyz(content: bytes, unit: str | None) -> SurfaceMap:
    """Parse a whole `.xyz` file: after the header one line `column row value` per pixel.

    Args:
        unit: of the value column, one of XYZ_UNITS; the file does not contain it, and it cannot be inferred.

    Raises:
        MapFileError: no unit given, or not a complete, meaningful map; the message names the field.
    """
    if unit not in XYZ_UNITS:
        what = "not given" if not unit else f"{unit!r}"
        raise MapFileError(
            f"xyz_unit = {what}: an .xyz file does not state the unit of its values; must be one of "
            f"{', '.join(XYZ_UNITS)}"
        )
    header, body = read_header(content)
    width, height = header["width"], header["height"]
    pixels = check_size(width, height)
    wavelength = check_wavelength(header["wavelength"])
    rows, mark, rest = body[1:].partition(b"#")
    if rest.strip():
        raise MapFileError("text after the '#' that ends the data")
    if not mark and not rows.endswith(b"\n"):
        raise MapFileError("the last line is not ended; the file is truncated")
    table = numbers(rows.replace(b"No Data", b"nan"), "data lines (column, row, value)", 3 * pixels, np.float64)
    column, row, value = table.reshape(pixels, 3).T
    pixel = _grid_indices(row, header["origin_y"], height, "row") * width
    pixel += _grid_indices(column, header["origin_x"], width, "column")
    if (np.bincount(pixel, minlength=pixels) != 1).any():
        raise MapFileError("data lines: some pixel is missing and another appears twice")
    sag = np.empty((height, width))
    sag.ravel()[pixel] = value
    metres = XYZ_UNITS[unit]
    sag *= wavelength if metres is None else metres
    check_heights(sag)
    return zygo_map(sag, header, "xyz", f"system type {header['system_type']}")


def _grid_indices(position: Floats, origin: int, size: int, name: str) -> NDArray[np.intp]:
    """Map indices from column or row numbers, which are counted from the corner of the camera or of the map."""
    first, last = position.min(), position.max()
    for start in (origin, 0):
        if first == start and last == start + size - 1 and (position == np.rint(position)).all():
            return (position - start).astype(np.intp)
    raise MapFileError(f"{name} numbers {first:g} to {last:g}: must be integers from {origin} to {origin + size - 1}")
