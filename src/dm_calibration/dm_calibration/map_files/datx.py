"""ZYGO `.datx` maps (HDF5, written by Mx; docs/map-files.md)."""

import io
import math
from typing import Any

import h5py
import numpy as np

from dm_calibration.map_files.datx_structure import (
    SIGNATURE,
    as_text,
    check_end,
    missing,
    number_in,
    object_at,
    read_heights,
    required,
)
from dm_calibration.map_files.four_d import is_four_d, parse_four_d
from dm_calibration.map_files.surface_map import (
    SQUARE_TOLERANCE,
    MapFileError,
    SurfaceMap,
    check_factor,
    check_heights,
    check_pitch,
    check_wavelength,
)

#: Units of length in which a surface may be stored, as m. "Fringes" is scaled by the optical factors instead.
_LENGTHS = {"nanometers": 1e-9, "micrometers": 1e-6, "millimeters": 1e-3, "meters": 1.0, "angstroms": 1e-10}

#: Texts in which a setting that is on or off is stored.
_TRUTH = {"0": False, "false": False, "off": False, "1": True, "true": True, "on": True}

#: Smallest plausible "No Data" value, far beyond any height; Mx stores the largest double.
_NO_DATA_LEAST = 1e30

#: Most rows of /MetaData that are accepted; real files have some dozens.
_LINKS_MAX = 10_000

#: Relative difference allowed between two copies of one value (one is sometimes stored in single precision).
_AGREEMENT = 1e-6


def is_datx(start: bytes) -> bool:
    """Whether the first bytes of a file are the HDF5 signature."""
    return start.startswith(SIGNATURE)


def parse_datx(content: bytes) -> SurfaceMap:
    """Parse a whole `.datx` file, or a file of 4Sight.

    The file is read from memory. Links and storage outside the file are refused, so nothing else is accessed.

    Raises:
        MapFileError: not a complete, meaningful map; the message names what is missing or wrong.
    """
    try:
        check_end(content, len(content))
        with h5py.File(io.BytesIO(content), "r") as file:
            return parse_four_d(file, content) if is_four_d(file) else _parse(file, content)
    except MapFileError:
        raise
    except Exception as error:  # h5py raises whatever a damaged file provokes: OSError, KeyError, RuntimeError, ...
        raise MapFileError(f"the HDF5 content is damaged or truncated: {type(error).__name__}: {error}") from error


def _parse(file: h5py.File, content: bytes) -> SurfaceMap:
    metadata = _metadata(file)
    surface = object_at(file, _path(metadata, "Surface"))
    extra = _extra_attributes(file, metadata)

    wavelength = check_wavelength(required(surface, "Wavelength", _extra_number(extra, "Wavelength")))
    scale = _metres_per_unit(surface, extra, wavelength)
    no_data = required(surface, "No Data")
    if not (math.isnan(no_data) or no_data >= _NO_DATA_LEAST):
        raise MapFileError(f"{surface.name}: No Data = {no_data:g}: must be NaN or at least {_NO_DATA_LEAST:g}")
    pitch = _pitch(surface, extra)
    _check_witnesses(surface, extra, wavelength)
    sag = read_heights(surface, content, no_data)
    sag *= scale
    check_heights(sag)

    software = " ".join(filter(None, (_extra_text(extra, "Software Info Name"), _extra_text(extra, "System Type"))))
    return SurfaceMap(
        sag=sag,
        wavelength=wavelength,
        pitch=pitch,
        format="datx",
        origin=_origin(surface),
        instrument=software or "Mx",
        serial=_extra_text(extra, "System Serial Number"),
        time_stamp=_extra_number(extra, "Time Stamp") or None,
        system_error_subtracted=_TRUTH.get(_extra_text(extra, "Subtract System Error").lower()),
    )


def _metadata(file: h5py.File) -> dict[tuple[str, str], str]:
    """The table /MetaData as {(source, link): destination}."""
    table = object_at(file, "/MetaData")
    if not isinstance(table, h5py.Dataset) or len(table.dtype.names or ()) != 3:
        raise MapFileError("/MetaData: must be a table of Source, Link and Destination")
    if not 0 < (table.size or 0) <= _LINKS_MAX or table.external or table.is_virtual:
        raise MapFileError(f"/MetaData: {table.size} rows: must be 1 to {_LINKS_MAX}, stored in the file")
    return {(as_text(source), as_text(link)): as_text(destination) for source, link, destination in table[()]}


def _path(metadata: dict[tuple[str, str], str], what: str) -> str:
    """Follow the links Root -> Measurement -> `what` -> Path."""
    node = "Root"
    for link in ("Measurement", what, "Path"):
        if (node, link) not in metadata:
            raise MapFileError(f"/MetaData: no link '{link}' from '{node}' (Root -> Measurement -> {what} -> Path)")
        node = metadata[node, link]
    return node


def _extra_attributes(file: h5py.File, metadata: dict[tuple[str, str], str]) -> dict[str, Any]:
    """Scalar attributes of /Attributes/<id>, by the last part of each name without the ending ':Value'."""
    try:
        node = object_at(file, _path(metadata, "Attributes"))
    except MapFileError:  # older files do not list it in /MetaData
        try:
            node = next(iter(object_at(file, "/Attributes").values()), None)
        except MapFileError:
            node = None
    if node is None:
        return {}
    attributes = ((name, np.asarray(value).ravel()) for name, value in node.attrs.items())
    return {
        name.removesuffix(":Value").rpartition(".")[2]: value[0]
        for name, value in attributes
        if value.size == 1 and not name.endswith((":Unit", ":Converter"))
    }


def _extra_number(extra: dict[str, Any], name: str) -> float | None:
    value = extra.get(name)
    return float(value) if isinstance(value, np.integer | np.floating) else None


def _extra_text(extra: dict[str, Any], name: str) -> str:
    return as_text(extra.get(name, "")).strip()


def _metres_per_unit(surface: h5py.Dataset, extra: dict[str, Any], wavelength: float) -> float:
    """m per stored unit: S O W for fringes, a plain length otherwise (already scaled by Mx)."""
    if "Unit" not in surface.attrs:
        raise missing(surface, "Unit")
    unit = as_text(np.asarray(surface.attrs["Unit"]).ravel()[0])
    if unit.lower() in _LENGTHS:
        return _LENGTHS[unit.lower()]
    if unit.lower() != "fringes":
        remark = "; the data are no height map" if unit.lower() == "nounits" else ""
        raise MapFileError(f"{surface.name}: Unit = '{unit}': must be Fringes or a length such as NanoMeters{remark}")
    scale_factor = required(surface, "Interferometric Scale Factor")
    obliquity = required(surface, "Obliquity Factor", _extra_number(extra, "Obliquity"), 1.0)
    scale_factor = check_factor("Interferometric Scale Factor", scale_factor)
    return scale_factor * check_factor("Obliquity Factor", obliquity) * wavelength


def _pitch(surface: h5py.Dataset, extra: dict[str, Any]) -> float | None:
    converters = [_converter(surface, name) for name in ("X Converter", "Y Converter")]
    x, y = (None if parameters is None else check_pitch(parameters[1]) for parameters in converters)
    if x is not None and y is not None and abs(x - y) > SQUARE_TOLERANCE * x:
        raise MapFileError(f"{surface.name}: pixels of {x:g} m x {y:g} m: must be square")
    stated = check_pitch(_extra_number(extra, "Lateral Resolution") or 0.0)
    pitch = x if x is not None else y
    if pitch is None:
        return stated
    if stated is not None and abs(pitch - stated) > SQUARE_TOLERANCE * pitch:
        raise MapFileError(
            f"{surface.name}: X Converter: {pitch:g} m per pixel, Lateral Resolution {stated:g} m: must agree"
        )
    return pitch


def _origin(surface: h5py.Dataset) -> tuple[int, int]:
    """First two entries of `Coordinates`, the position of the map's corner on the camera; (0, 0) if absent."""
    try:
        corner = np.asarray(surface.attrs["Coordinates"]).ravel()[0]
        return (int(corner[0]), int(corner[1]))
    except (IndexError, KeyError, TypeError, ValueError):
        return (0, 0)


def _check_witnesses(surface: h5py.Dataset, extra: dict[str, Any], wavelength: float) -> None:
    """Check that values given twice in the file agree, as the format has no checksum."""
    stated = _converter(surface, "Z Converter")
    scale, obliquity = number_in(surface, "Interferometric Scale Factor"), number_in(surface, "Obliquity Factor")
    witnesses: list[tuple[str, float | None, float | None]]
    witnesses = [("Wavelength", wavelength, _extra_number(extra, "Wavelength"))]
    if stated is not None and len(stated) >= 4:  # (0, wavelength, scale factor, obliquity)
        witnesses += [("Wavelength", wavelength, stated[1])]
        witnesses += [("Interferometric Scale Factor", scale, stated[2]), ("Obliquity Factor", obliquity, stated[3])]
    for name, value, witness in witnesses:
        if value is None or not witness:  # 0 means not known, as everywhere in this format
            continue
        if not abs(value - witness) <= _AGREEMENT * abs(value):
            raise MapFileError(f"{surface.name}: {name} = {value:g}, but elsewhere {witness:g}: must agree")


def _converter(surface: h5py.Dataset, name: str) -> list[float] | None:
    """The parameters of a converter compound (category, unit, parameters); None when it is absent."""
    if name not in surface.attrs:
        return None
    try:
        first, second, *others = (float(value) for value in np.asarray(surface.attrs[name]).ravel()[0][2])
    except (IndexError, TypeError, ValueError):
        raise MapFileError(f"{surface.name}: attribute '{name}': must hold category, unit and parameters") from None
    return [first, second, *others]
