"""ZYGO binary `.dat` maps, as MetroPro and Mx write them ([29]; docs/map-files.md)."""

import struct
from typing import Any

import numpy as np

from dm_calibration.map_files.surface_map import MapFileError, SurfaceMap, check_size, sag_from_counts, zygo_map

#: magic: (format, header size in bytes)
HEADERS = {0x881B036F: (1, 834), 0x881B0370: (2, 834), 0x881B0371: (3, 4096)}
SMALLEST = min(size for _format, size in HEADERS.values())

_FIELDS = {
    "magic": (0, ">I"),
    "format": (4, ">H"),
    "header_size": (6, ">I"),
    "software": (10, ">h"),
    "intensity_width": (52, ">H"),
    "intensity_height": (54, ">H"),
    "intensity_buckets": (56, ">H"),
    "intensity_bytes": (60, ">I"),
    "origin_x": (64, ">h"),
    "origin_y": (66, ">h"),
    "width": (68, ">H"),
    "height": (70, ">H"),
    "phase_bytes": (72, ">I"),
    "time_stamp": (76, ">I"),
    "scale_factor": (164, ">f"),
    "wavelength": (168, ">f"),
    "obliquity": (176, ">f"),
    "lateral_resolution": (184, ">f"),
    "phase_resolution": (218, ">h"),
    "data_sign": (232, ">h"),
    "camera_width": (234, ">h"),
    "camera_height": (236, ">h"),
    "system_type": (238, ">h"),
    "system_serial": (242, ">H"),  # declared signed, but real serial numbers exceed 32767
    "system_error_subtracted": (302, ">h"),
}

_SOFTWARE = {0: "Mx", 1: "MetroPro", 2: "MetroBASIC", 3: "d2bug"}


def is_dat(start: bytes) -> bool:
    """Whether the first bytes of a file carry the format's magic number."""
    return len(start) >= 4 and struct.unpack(">I", start[:4])[0] in HEADERS


def read_header(content: bytes) -> dict[str, Any]:
    """The header fields by name, of a file that :func:`is_dat`.

    Raises:
        MapFileError: too short, or magic number, format and header size do not match.
    """
    if len(content) < SMALLEST:
        raise MapFileError(f"file length = {len(content)} bytes: a .dat header alone has at least {SMALLEST}")
    header = {name: struct.unpack_from(code, content, offset)[0] for name, (offset, code) in _FIELDS.items()}
    expected = HEADERS[header["magic"]]
    if (header["format"], header["header_size"]) != expected:
        raise MapFileError(
            f"format = {header['format']}, header size = {header['header_size']}: magic number "
            f"0x{header['magic']:08X} belongs to format {expected[0]} with a header of {expected[1]} bytes"
        )
    return header


def check_length(header: dict[str, Any], length: int) -> int:
    """Return the offset of the phase data; the file must be exactly as long as its header states.

    Raises:
        MapFileError: the length differs, or the size of the map is absurd.
    """
    pixels = check_size(header["width"], header["height"])
    intensities = header["intensity_width"] * header["intensity_height"] * header["intensity_buckets"]
    _check_sizes(header, intensities, pixels)
    offset: int = header["header_size"] + 2 * intensities
    expected = offset + 4 * pixels
    if length != expected:
        problem = "truncated" if length < expected else "longer than its header says"
        raise MapFileError(
            f"file length = {length} bytes: must be {expected} for {header['width']} x {header['height']} phase and "
            f"{intensities} intensity values; the file is {problem}"
        )
    return offset


def _check_sizes(header: dict[str, Any], intensities: int, pixels: int) -> None:
    """Check that sizes given twice in the header agree, as the format has no checksum. 0 = not known."""
    for name, needed in (("phase_bytes", 4 * pixels), ("intensity_bytes", 2 * intensities)):
        stated = header[name]
        if stated not in (0, needed):
            raise MapFileError(f"{name.replace('_', ' ')} = {stated}: must be {needed} for the sizes in the header")
    if intensities:
        for size in ("width", "height"):
            most = header[f"intensity_{size}"]
            if header[size] > most:
                raise MapFileError(f"phase {size} = {header[size]}: must be at most that of the intensity, {most}")
    for size, origin, camera in (("width", "origin_x", "camera_width"), ("height", "origin_y", "camera_height")):
        if header[camera] and not 0 <= header[origin] <= header[camera] - header[size]:
            raise MapFileError(
                f"phase {size} = {header[size]} from pixel {header[origin]} on: must lie on the camera,"
                f" {header[camera]} pixels"
            )


def parse_dat(content: bytes) -> SurfaceMap:
    """Parse a whole `.dat` file.

    Raises:
        MapFileError: not a complete, meaningful map; the message names the field.
    """
    header = read_header(content)
    offset = check_length(header, len(content))
    width, height = header["width"], header["height"]
    counts = np.frombuffer(content, ">i4", width * height, offset).reshape(height, width)
    sag = sag_from_counts(counts, header)
    software = _SOFTWARE.get(header["software"], f"software {header['software']}")
    return zygo_map(sag, header, "dat", f"{software}, system type {header['system_type']}")
