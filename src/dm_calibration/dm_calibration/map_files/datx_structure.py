"""Check of the structure of an HDF5 map before memory of the size it states is allocated, and reading of its values."""

import math
import struct
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from dm_calibration.map_files.surface_map import MapFileError, check_size
from dm_common import Floats

SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"

#: Byte positions in the superblock, by its version, of the size of addresses and of the end-of-file address (HDF5
#: format specification, section II.A).
_SIZE_OF_OFFSETS = {0: 13, 1: 13, 2: 9, 3: 9}
_END_ADDRESS = {0: 40, 1: 44, 2: 28, 3: 28}

#: Types in which heights are stored; any other type indicates a damaged type description.
_HEIGHT_TYPES = ("<f8", "<f4", "<i4", "<i2", "<u4", "<u2", "<i8", "<u8")

#: Largest compression ratio of Deflate, the densest filter that Mx uses [bytes per byte].
_DENSEST = 1032

#: Smallest accepted heights in any unit, by bytes per value; 1 pm, the shortest length in use, is 1e-12 m.
_LEAST_HEIGHT = {4: 1e-30, 8: 1e-200}

_FILTER_NAMES = {h5py.h5z.FILTER_SZIP: "Szip", h5py.h5z.FILTER_DEFLATE: "gzip"}


def check_end(start: bytes, length: int) -> None:
    """Compare the length of a file with that in its superblock; the HDF5 library only detects shorter files.

    Raises:
        MapFileError: the file is longer or shorter, or its superblock is missing or of an unknown version.
    """
    version = start[len(SIGNATURE)] if len(start) > 64 else -1
    if version not in _END_ADDRESS:
        raise MapFileError(f"HDF5 superblock version = {version}: must be one of {', '.join(map(str, _END_ADDRESS))}")
    sizes = start[_SIZE_OF_OFFSETS[version]]
    if sizes != 8:
        raise MapFileError(f"HDF5 superblock: size of offsets = {sizes}: must be 8")
    (end,) = struct.unpack_from("<Q", start, _END_ADDRESS[version])
    if end != length:
        problem = "truncated" if length < end else "longer than its superblock says"
        raise MapFileError(f"file length = {length} bytes: must be {end}; the file is {problem}")


def object_at(file: h5py.File, path: str) -> Any:
    """The object at `path`, reached through hard links only: other links may lead out of the file.

    Raises:
        MapFileError: it is missing, or reached through another link.
    """
    node: Any = file
    for name in path.strip("/").split("/"):
        link = node.get(name, getlink=True) if isinstance(node, h5py.Group) else None
        if link is None:
            raise MapFileError(f"{path}: missing from the file")
        if not isinstance(link, h5py.HardLink):
            raise MapFileError(f"{path}: '{name}' is a link elsewhere; links are not followed")
        node = node[name]
    return node


def read_heights(surface: Any, content: bytes, no_data: float) -> Floats:
    """(height, width) values of a map, NaN = no data, after its storage was checked against the whole file.

    Args:
        no_data: values from this one upwards mean no data; NaN = only values that are not finite do.

    Raises:
        MapFileError: not a table of numbers, storage that is not as declared, or a filter that is not available.
    """
    if not isinstance(surface, h5py.Dataset) or surface.ndim != 2 or surface.dtype.kind not in "fiu":
        raise MapFileError(f"{surface.name}: must be a two-dimensional table of numbers")
    if surface.dtype.str not in _HEIGHT_TYPES or not surface.id.get_type().equal(h5py.h5t.py_create(surface.dtype)):
        raise MapFileError(f"{surface.name}: type {surface.dtype}: must be a plain little-endian number")
    check_size(surface.shape[1], surface.shape[0])
    _check_storage(surface, len(content))
    _check_place(surface, content, no_data)
    heights = _read_values(surface)
    invalid = ~np.isfinite(heights)
    if not math.isnan(no_data):
        with np.errstate(invalid="ignore"):
            invalid |= heights >= no_data
    heights[invalid] = math.nan
    return heights


def _check_storage(surface: h5py.Dataset, length: int) -> None:
    """Compare the declared size of the map with what is stored in the file of `length` bytes."""
    if surface.external or surface.is_virtual:
        raise MapFileError(f"{surface.name}: its values lie in another file, which is not followed")
    stored, needed = surface.id.get_storage_size(), surface.size * surface.dtype.itemsize
    if surface.chunks is None:
        agrees = stored == needed and (surface.id.get_offset() or length) + stored <= length
    else:
        whole = math.prod(-(-size // chunk) for size, chunk in zip(surface.shape, surface.chunks, strict=True))
        largest = math.prod(surface.chunks) * surface.dtype.itemsize
        agrees = (
            0 < stored <= length
            and needed <= _DENSEST * stored
            and largest <= max(_DENSEST * stored, needed)
            and surface.id.get_num_chunks() == whole
        )
    if not agrees:
        raise MapFileError(
            f"{surface.name}: {surface.shape[1]} x {surface.shape[0]} values of {surface.dtype} do not agree with"
            f" {stored} bytes stored in a file of {length}"
        )


def _check_place(surface: h5py.Dataset, content: bytes, no_data: float) -> None:
    """Check the address of the values, which the file states only once.

    If a damaged address is too low or too high, and the map has corners without data, runs of "No Data" values are
    found within one row before or after the range that it gives.
    """
    start = surface.id.get_offset()
    if start is None or surface.dtype.kind != "f":  # stored in chunks, or integers, which have no such value
        return
    end, row = start + surface.id.get_storage_size(), surface.shape[1] * surface.dtype.itemsize
    one = np.asarray(no_data, surface.dtype).tobytes()
    for first, last in ((max(0, start - row), start), (end, end + row)):
        # A single such value may be that of an attribute, except directly after the range, where no attribute begins.
        outside = 2 * one in content[first:last] or (first == end and content[first:last].startswith(one))
        if outside and not _other_values(surface, first, last):
            raise MapFileError(
                f"{surface.name}: its values do not stand at byte {start}: they go on outside that place"
            )


def _other_values(surface: h5py.Dataset, first: int, last: int) -> bool:
    """Whether values of another dataset may lie between the bytes `first` and `last`."""
    found = []

    def visit(_name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and item != surface:
            start = item.id.get_offset()
            found.append(start is None or (start < last and start + item.id.get_storage_size() > first))

    surface.file.visititems(visit)
    return any(found)


def _read_values(surface: h5py.Dataset) -> Floats:
    """The stored values as (height, width) float64."""
    properties = surface.id.get_create_plist()
    for index in range(properties.get_nfilters()):
        identifier, _flags, _values, name = properties.get_filter(index)
        if not h5py.h5z.filter_avail(identifier):
            label = _FILTER_NAMES.get(identifier) or as_text(name) or f"number {identifier}"
            raise MapFileError(
                f"{surface.name}: compressed with the HDF5 filter {label}, which this h5py lacks; "
                "save the map uncompressed or as .dat, or install an HDF5 library with that filter"
            )
    stored = surface[()]
    _check_foreign(surface, stored)
    return stored.astype(np.float64, copy=False)


def _check_foreign(surface: h5py.Dataset, stored: NDArray[Any]) -> None:
    """Refuse heights that are the file's own metadata: the address of the data is stored only once.

    A damaged address shifts the start of the data into counts and addresses of the file structure. Read as
    floating-point numbers, these are smaller than any height.
    """
    if stored.dtype.kind != "f":
        return
    least = _LEAST_HEIGHT[stored.dtype.itemsize]
    size = np.abs(stored)
    if ((size < least) & (size > 0)).any():
        raise MapFileError(f"{surface.name}: holds values smaller than {least:g} other than 0, which are no heights")


def missing(where: Any, name: str) -> MapFileError:
    return MapFileError(f"{where.name}: the attribute '{name}' is missing")


def number_in(node: Any, name: str) -> float | None:
    """The number in the attribute `name`; None if it is absent.

    Raises:
        MapFileError: it holds something else.
    """
    if name not in node.attrs:
        return None
    value = np.asarray(node.attrs[name]).ravel()
    if value.size != 1 or value.dtype.kind not in "fiu":
        raise MapFileError(f"{node.name}: attribute '{name}' = {value.tolist()}: must be one number")
    return float(value[0])


def required(node: Any, name: str, *otherwise: float | None) -> float:
    """The number in the attribute `name`, else the first of `otherwise` that is not None. Raises MapFileError."""
    for value in (number_in(node, name), *otherwise):
        if value is not None:
            return value
    raise missing(node, name)


def as_text(value: Any) -> str:
    if isinstance(value, bytes):
        return value.decode("latin-1")
    return str(value).encode("utf-8", "backslashreplace").decode()  # h5py decodes invalid bytes as surrogates
