"""ZYGO `.xyz` maps: the text header, then one line `column row value` per pixel (docs/map-files.md)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dm_calibration.map_files.surface_map import (
    MapFileError,
    SurfaceMap,
    check_heights,
    check_size,
    check_wavelength,
    no_valid_pixels,
)
from dm_calibration.map_files.text_header import numbers, split_header

#: Units the value column may be in, as m; None = waves of the file's wavelength.
UNITS: dict[str, float | None] = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "angstrom": 1e-10, "waves": None}


def parse_xyz(content: bytes, unit: str | None) -> SurfaceMap:
    """Parse a whole `.xyz` file.

    Args:
        unit: of the value column, one of UNITS. The file does not tell it and nothing can guess it.

    Raises:
        MapFileError: no unit given, or not a whole, meaningful map; the message names the field.
    """
    if unit not in UNITS:
        what = "not given" if not unit else f"{unit!r}"
        raise MapFileError(
            f"xyz_unit = {what}: an .xyz file does not tell the unit of its values; must be one of {', '.join(UNITS)}"
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
    metres = UNITS[unit]
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
