"""Maps of 4D Technology's 4Sight (HDF5, `.h5`; docs/map-files.md)."""

from __future__ import annotations

import re
from typing import Any

import h5py
import numpy as np

from dm_calibration.map_files.datx_structure import as_text, object_at, read_heights
from dm_calibration.map_files.surface_map import (
    METRES,
    MapFileError,
    SurfaceMap,
    check_heights,
    check_pitch,
    check_wavelength,
)

#: The group that only these files have.
GROUP = "measurement0"
#: What stands where there is no data: the largest single-precision number.
_NO_DATA = float(np.finfo(np.float32).max)


def parse_four_d(file: h5py.File, content: bytes) -> SurfaceMap:
    """Parse an open file; heights are waves, with the wedge factor that the instrument was set to.

    Raises:
        MapFileError: not a whole, meaningful map; the message names what is missing or wrong.
    """
    group, surface = (object_at(file, path) for path in (f"{GROUP}/genraw", f"{GROUP}/genraw/data"))
    wavelength = check_wavelength(_length(group, "wavelength"))
    pitch = check_pitch(_length(group, "xpix")) if "xpix" in group.attrs else None
    sag = read_heights(surface, content, _NO_DATA) * wavelength
    check_heights(sag)
    return SurfaceMap(sag, wavelength, pitch, "h5", instrument="4Sight")


def _length(group: Any, name: str) -> float:
    """m, of an attribute such as "632.8 nm"."""
    if name not in group.attrs:
        raise MapFileError(f"{group.name}: the attribute '{name}' is missing")
    text = as_text(np.asarray(group.attrs[name]).ravel()[0])
    number = re.fullmatch(r"(\d+\.?\d*(?:[eE][-+]?\d+)?) (nm|um|mm|m)", text.strip("\0 "))
    if number is None:
        raise MapFileError(f"{group.name}: {name} = {text!r}: must be a length, such as '632.8 nm'")
    return float(number[1]) * METRES[number[2]]
