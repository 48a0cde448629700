"""ZYGO `.asc` maps ("Zygo ASCII Data File - Format 2"; docs/map-files.md)."""

from __future__ import annotations

import numpy as np

from dm_calibration.map_files.surface_map import (
    MapFileError,
    SurfaceMap,
    check_size,
    sag_from_counts,
    sag_per_count,
)
from dm_calibration.map_files.text_header import TextHeader, numbers, split_header


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
    """Parse a whole `.asc` file.

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
