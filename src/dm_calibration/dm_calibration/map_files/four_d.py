"""Maps of 4D Technology's 4Sight (HDF5, `.h5` and `.4D`; docs/map-files.md)."""

import re
from typing import Any

import h5py
import numpy as np

from dm_calibration.map_files.datx_structure import as_text, missing, number_in, object_at, read_heights, required
from dm_calibration.map_files.surface_map import (
    METRES,
    MapFileError,
    SurfaceMap,
    check_heights,
    check_pitch,
    check_wavelength,
)

#: The groups by which files are recognised: of version 2 (.h5), and of newer ones (.4D).
_OLD, _NEW = "measurement0", "Measurement"
#: Value of pixels without data: the largest single-precision number; newer versions use values that are not finite.
_NO_DATA = float(np.finfo(np.float32).max)
_WAVELENGTH, _COUNT = "WavelengthInNanometers", "NumOfMeasurements"


def is_four_d(file: h5py.File) -> bool:
    """Whether an open HDF5 file is one of 4Sight."""
    return _OLD in file or (_NEW in file and "MetaData" not in file)


def parse_four_d(file: h5py.File, content: bytes) -> SurfaceMap:
    """Parse an open file; its heights are in waves and include the wedge factor that was set in the instrument.

    Raises:
        MapFileError: not a complete, meaningful map; the message names what is missing or wrong.
    """
    if _OLD in file:
        group, surface = (object_at(file, path) for path in (f"{_OLD}/genraw", f"{_OLD}/genraw/data"))
        wavelength, no_data, suffix = _length(group, "wavelength"), _NO_DATA, "h5"
        pitch = check_pitch(_length(group, "xpix")) if "xpix" in group.attrs else None
    else:
        group = object_at(file, _NEW)
        if (count := number_in(group, _COUNT)) is not None:
            raise MapFileError(
                f"{group.name}: {_COUNT} = {count:g}: must be a file of one map, which lacks this attribute"
            )
        surface = object_at(file, f"{_NEW}/SurfaceInWaves/Data")
        wavelength, no_data, suffix, pitch = 1e-9 * required(group, _WAVELENGTH), np.nan, "4D", None
    sag = check_wavelength(wavelength) * read_heights(surface, content, no_data)
    check_heights(sag)
    return SurfaceMap(sag, wavelength, pitch, suffix, instrument="4Sight")


def _length(group: Any, name: str) -> float:
    """m, from an attribute such as "632.8 nm"."""
    if name not in group.attrs:
        raise missing(group, name)
    text = as_text(np.asarray(group.attrs[name]).ravel()[0])
    number = re.fullmatch(r"(\d+\.?\d*(?:[eE][-+]?\d+)?) (nm|um|mm|m)", text.strip("\0 "))
    if number is None:
        raise MapFileError(f"{group.name}: {name} = {text!r}: must be a length, such as '632.8 nm'")
    return float(number[1]) * METRES[number[2]]
