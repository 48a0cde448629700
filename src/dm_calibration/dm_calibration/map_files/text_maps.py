"""ZYGO's text formats `.asc` and `.xyz`, which share fourteen header lines (docs/map-files.md).

Fields are found by line number and position: quotes around texts can be damaged in real files.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dm_calibration.map_files.surface_map import (
    METRES,
    MapFileError,
    SurfaceMap,
    check_heights,
    check_pitch,
    check_size,
    check_wavelength,
    no_valid_pixels,
    sag_from_counts,
    sag_per_count,
)

ASC_TITLE = b"Zygo ASCII Data File"
XYZ_TITLE = b"Zygo XYZ Data File"
LINES = 14
_LONGEST_NUMBER = 40  # characters; bounds the memory that one absurd token can claim


@dataclass(frozen=True)
class TextHeader:
    """What the header says; lengths in m, sizes in pixels."""

    intensities: int
    origin: tuple[int, int]
    width: int
    height: int
    part_name: str
    scale_factor: float
    wavelength: float
    obliquity: float
    lateral_resolution: float
    time_stamp: float | None
    system_type: int
    system_serial: int
    phase_resolution: int
    data_sign: int
    system_error_subtracted: bool | None

    def surface_map(self, sag: NDArray[np.float64], wavelength: float, name: str) -> SurfaceMap:
        """The map with this header, of the format `name`, with `sag` in m."""
        return SurfaceMap(
            sag=sag,
            wavelength=wavelength,
            pitch=check_pitch(self.lateral_resolution),
            format=name,
            origin=self.origin,
            instrument=f"system type {self.system_type}",
            serial=str(self.system_serial) if self.system_serial else "",
            part_name=self.part_name,
            time_stamp=self.time_stamp,
            system_error_subtracted=self.system_error_subtracted,
        )


def is_text(start: bytes) -> bool:
    """Whether the first bytes of a file are the title of one of the text formats."""
    return start.lstrip().startswith((ASC_TITLE, XYZ_TITLE))


def split_header(content: bytes) -> tuple[TextHeader, bytes]:
    """Return the header and the body, which begins with the `#` after the header.

    Raises:
        MapFileError: too few lines, a number missing or unreadable, or no `#` after the header.
    """
    lines = content.split(b"\n", LINES)
    if len(lines) <= LINES:
        raise MapFileError(f"header: {len(lines)} lines, must be {LINES} and a '#'; the file is truncated")
    body = lines.pop().lstrip()
    if not body.startswith(b"#"):
        raise MapFileError(f"line {LINES + 1}: must be '#', the end of the header")
    tokens = [line.decode("latin-1").split() for line in lines]

    def number(line: int, position: int, name: str) -> float:
        try:
            return float(tokens[line - 1][position - 1])
        except (IndexError, ValueError):
            raise MapFileError(f"{name}: no number at position {position} of header line {line}") from None

    def integer(line: int, position: int, name: str) -> int:
        value = number(line, position, name)
        if not (abs(value) < 2**53 and value == int(value)):
            raise MapFileError(f"{name} = {value:g} in header line {line}: must be an integer")
        return int(value)

    time_stamp = integer(8, 8, "time stamp")
    header = TextHeader(
        intensities=integer(3, 3, "intensity width")
        * integer(3, 4, "intensity height")
        * integer(3, 5, "intensity buckets"),
        origin=(integer(4, 1, "phase origin x"), integer(4, 2, "phase origin y")),
        width=integer(4, 3, "phase width"),
        height=integer(4, 4, "phase height"),
        part_name=lines[6].decode("latin-1").replace('"', "").strip(),
        scale_factor=number(8, 2, "interferometric scale factor"),
        wavelength=number(8, 3, "wavelength"),
        obliquity=number(8, 5, "obliquity factor"),
        lateral_resolution=number(8, 7, "lateral resolution"),
        time_stamp=float(time_stamp) if time_stamp > 0 else None,
        system_type=integer(9, 3, "system type"),
        system_serial=integer(9, 5, "system serial number"),
        phase_resolution=integer(11, 1, "phase resolution code"),
        data_sign=integer(11, 8, "data sign"),
        system_error_subtracted={0: False, 1: True}.get(integer(12, 1, "system error subtracted")),
    )
    return header, body


def numbers(text: bytes, name: str, expected: int, dtype: type) -> NDArray[Any]:
    """Return the whitespace-separated numbers of `text`, exactly `expected` of them.

    Raises:
        MapFileError: another count, or something that is no number.
    """
    if 2 * expected > len(text) + 1:  # a number takes a digit and a separator
        raise MapFileError(f"{name}: {len(text)} characters cannot hold {expected} values; the file is truncated")
    tokens = text.split()
    if len(tokens) != expected:
        raise MapFileError(f"{name}: {len(tokens)} values, must be {expected}")
    if max(map(len, tokens), default=0) > _LONGEST_NUMBER:
        raise MapFileError(f"{name}: holds a word of more than {_LONGEST_NUMBER} characters, must be numbers")
    try:
        return np.array(tokens, dtype=np.bytes_).astype(dtype)
    except (ValueError, OverflowError) as error:
        raise MapFileError(f"{name}: {error}") from None


def _phase_section(header: TextHeader, body: bytes) -> bytes:
    """The text between the `#` before the phase data and the `#` after them."""
    before, *sections, after = body.split(b"#")
    if before.strip() or after.strip():
        raise MapFileError("the phase data do not end with '#'; the file is truncated")
    if len(sections) == 2:
        numbers(sections[0], "intensity data", header.intensities, np.int64)
        return sections[1]
    if len(sections) == 1 and header.intensities == 0:  # the intensity section may be left out when it is empty
        return sections[0]
    raise MapFileError(
        f"{len(sections)} data sections between '#' marks: must be intensity and phase; the file is truncated"
    )


def parse_asc(content: bytes) -> SurfaceMap:
    """Parse a whole `.asc` file ("Zygo ASCII Data File - Format 2").

    Raises:
        MapFileError: not a whole, meaningful map; the message names the field.
    """
    header, body = split_header(content)
    pixels = check_size(header.width, header.height)
    metres_per_count = sag_per_count(
        header.scale_factor, header.wavelength, header.obliquity, header.phase_resolution, header.data_sign
    )
    counts = numbers(_phase_section(header, body), "phase data", pixels, np.int64)
    sag = sag_from_counts(counts.reshape(header.height, header.width), metres_per_count)
    return header.surface_map(sag, header.wavelength, "asc")


#: Units the value column may be in, as m; None = waves of the file's wavelength.
XYZ_UNITS: dict[str, float | None] = {**METRES, "waves": None}


def parse_xyz(content: bytes, unit: str | None) -> SurfaceMap:
    """Parse a whole `.xyz` file: after the header one line `column row value` per pixel.

    Args:
        unit: of the value column, one of XYZ_UNITS. The file does not tell it and nothing can guess it.

    Raises:
        MapFileError: no unit given, or not a whole, meaningful map; the message names the field.
    """
    if unit not in XYZ_UNITS:
        what = "not given" if not unit else f"{unit!r}"
        raise MapFileError(
            f"xyz_unit = {what}: an .xyz file does not tell the unit of its values; must be one of "
            f"{', '.join(XYZ_UNITS)}"
        )
    header, body = split_header(content)
    pixels = check_size(header.width, header.height)
    wavelength = check_wavelength(header.wavelength)
    rows, mark, rest = body[1:].partition(b"#")
    if rest.strip():
        raise MapFileError("text after the '#' that ends the data")
    if not mark and not rows.endswith(b"\n"):
        raise MapFileError("the last line is not ended; the file is truncated")
    table = numbers(rows.replace(b"No Data", b"nan"), "data lines (column, row, value)", 3 * pixels, np.float64)
    column, row, value = table.reshape(pixels, 3).T
    pixel = _grid_indices(row, header.origin[1], header.height, "row") * header.width
    pixel += _grid_indices(column, header.origin[0], header.width, "column")
    if (np.bincount(pixel, minlength=pixels) != 1).any():
        raise MapFileError("data lines: some pixel is missing and another appears twice")
    sag = np.empty((header.height, header.width))
    sag.ravel()[pixel] = value
    if not np.isfinite(sag).any():
        raise no_valid_pixels(sag.shape)
    metres = XYZ_UNITS[unit]
    sag *= wavelength if metres is None else metres
    check_heights(sag)
    return header.surface_map(sag, wavelength, "xyz")


def _grid_indices(position: NDArray[np.float64], origin: int, size: int, name: str) -> NDArray[np.intp]:
    """Map indices from column or row numbers, which count from the camera's corner or from the map's."""
    first, last = position.min(), position.max()
    for start in (origin, 0):
        if first == start and last == start + size - 1 and (position == np.rint(position)).all():
            return (position - start).astype(np.intp)
    raise MapFileError(f"{name} numbers {first:g} to {last:g}: must be integers from {origin} to {origin + size - 1}")
