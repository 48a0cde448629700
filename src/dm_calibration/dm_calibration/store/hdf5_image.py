"""Conversion of plain arrays, texts and attributes to and from an HDF5 file image, with a hash over the content.

The file is made in memory, so that a full disk is reported by ordinary file writing instead of failing inside the HDF5
library.
"""

import hashlib
import io
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dm_calibration.store.hdf5_sandbox import SandboxError, read_in_sandbox

#: A dataset: a numeric array, or texts.
Column = NDArray[np.generic] | tuple[str, ...]
#: An attribute of the root: a number, a text, or texts.
Attribute = bool | int | float | str | tuple[str, ...]

#: Attribute that holds the hash over everything else.
HASH = "content_sha256"
#: Largest accepted file, far above the size of a calibration [bytes].
SIZE_MAX = 1 << 28
#: Size of the smallest superblock at the start of such a file [bytes].
SUPERBLOCK = 96
#: Largest accepted number of groups and datasets; more indicate a loop in a damaged file.
_OBJECTS_MAX = 1000

_TEXT = h5py.string_dtype("utf-8")


class ImageError(ValueError):
    """The file is not a complete, plain HDF5 file whose content matches its hash."""


def write_image(columns: Mapping[str, Column], attributes: Mapping[str, Attribute]) -> bytes:
    """The bytes of an HDF5 file with `columns` by path and `attributes` at the root, including their hash."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, value in columns.items():
            if isinstance(value, tuple):
                file.create_dataset(name, data=np.array(value, dtype=object), dtype=_TEXT, shape=(len(value),))
            else:
                file.create_dataset(name, data=value)
        for name, attribute in attributes.items():
            if isinstance(attribute, tuple):
                file.attrs.create(name, np.array(attribute, dtype=object), shape=(len(attribute),), dtype=_TEXT)
            else:
                file.attrs[name] = attribute
        file.attrs[HASH] = content_hash(columns, attributes)
    return buffer.getvalue()


def read_image(path: Path) -> tuple[dict[str, Column], dict[str, Attribute]]:
    """Columns and attributes of a file written by :func:`write_image`.

    The HDF5 library runs in a separate process (see :mod:`dm_calibration.store.hdf5_sandbox`), and only plain datasets
    are read: links out of the file, virtual datasets and external storage are refused.

    Raises:
        ImageError: unreadable, not HDF5, truncated, damaged, not plain, or the hash does not match.
    """
    try:
        with path.open("rb") as raw:
            size = os.fstat(raw.fileno()).st_size
            if size > SIZE_MAX:
                raise ImageError(f"{size} bytes: a calibration has at most {SIZE_MAX}")
            content = raw.read(size)
    except OSError as error:
        raise ImageError(f"cannot be read: {error.strerror or error}") from error
    if size < SUPERBLOCK:  # the library would read beyond the end of the buffer
        raise ImageError(f"not a whole HDF5 file: {size} bytes, must be {SUPERBLOCK} at least")
    try:
        answer = read_in_sandbox("image", content)
    except SandboxError as error:
        raise ImageError(f"not a whole HDF5 file: {error}") from error
    if answer.error:
        raise ImageError(answer.error)
    columns: dict[str, Column] = {**answer.arrays, **_as_tuples(answer.facts["texts"])}
    attributes: dict[str, Attribute] = _as_tuples(answer.facts["attributes"])
    stored = attributes.pop(HASH, "")
    if stored == "":
        raise ImageError(f"attribute {HASH} is missing: not written by this suite")
    if stored != content_hash(columns, attributes):
        raise ImageError("the content does not agree with its hash: the file was damaged or changed")
    return columns, attributes


def _as_tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    """Lists of texts, into which JSON turns tuples, as tuples again."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def parse_image(content: bytes) -> tuple[dict[str, Column], dict[str, Attribute]]:
    """Columns and attributes of an HDF5 image, without checking the hash. Damaged files may crash the process.

    Raises:
        ImageError: not HDF5, truncated, damaged, or not plain.
    """
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            columns = {name: _column(name, dataset) for name, dataset in _datasets(file, len(content))}
            attributes = {name: _attribute(value) for name, value in file.attrs.items()}
    except ImageError:
        raise
    except Exception as error:  # h5py raises OSError, RuntimeError, KeyError, ... for damaged files
        raise ImageError(f"not a whole HDF5 file: {error}") from error
    return columns, attributes


def content_hash(columns: Mapping[str, Column], attributes: Mapping[str, Attribute]) -> str:
    """SHA-256 over names, types, shapes and values, independent of how HDF5 lays them out."""
    digest = hashlib.sha256()

    def add(kind: str, name: str, shape: tuple[int, ...], content: bytes) -> None:
        digest.update(_bytes(f"{name}\0{kind}\0{shape}\0{len(content)}\0"))
        digest.update(content)

    for name in sorted(columns):
        value = columns[name]
        if isinstance(value, tuple):
            add("text", name, (len(value),), _bytes("\0".join(value)))
        else:
            plain = np.ascontiguousarray(value)
            little = plain.astype(plain.dtype.newbyteorder("<"))
            add(little.dtype.str, name, plain.shape, little.tobytes())
    for name in sorted(attributes):
        attribute = attributes[name]
        if isinstance(attribute, tuple):
            add("texts", f"@{name}", (len(attribute),), _bytes("\0".join(attribute)))
        else:
            add("value", f"@{name}", (), repr(attribute).encode())
    return digest.hexdigest()


def _bytes(text: str) -> bytes:
    """UTF-8 bytes; invalid bytes in names and attributes of a damaged file arrive from h5py as lone surrogates."""
    return text.encode("utf-8", "surrogatepass")


def _datasets(file: h5py.File, length: int) -> Iterator[tuple[str, h5py.Dataset]]:
    """All datasets by path; their data must fit into the `length` bytes of the file, which bounds memory use."""
    size = objects = 0
    groups: list[tuple[str, h5py.Group]] = [("", file)]
    while groups:
        prefix, group = groups.pop()
        for name in group:
            path = f"{prefix}{name}"
            objects += 1
            if objects > _OBJECTS_MAX:
                raise ImageError(f"more than {_OBJECTS_MAX} objects: not a calibration")
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise ImageError(f"{path} is a link, which is not followed")
            item = group[name]
            if isinstance(item, h5py.Group):
                groups.append((f"{path}/", item))
                continue
            if not isinstance(item, h5py.Dataset):
                raise ImageError(f"{path} is neither a group nor a dataset")
            if item.is_virtual or item.external:
                raise ImageError(f"{path} keeps its data outside the file, which is not followed")
            if item.chunks is not None:
                raise ImageError(f"{path} is stored in chunks, which this suite does not write")
            size += (item.size or 0) * item.dtype.itemsize
            if size > length:
                raise ImageError(f"{path}: {size} bytes of data so far, the file has {length}")
            yield path, item


def _column(name: str, dataset: h5py.Dataset) -> Column:
    if h5py.check_string_dtype(dataset.dtype) is not None:
        if dataset.ndim != 1:
            raise ImageError(f"{name}: texts must be a list")
        return tuple(str(text) for text in dataset.asstr()[()])
    if dataset.dtype.kind not in "fiub":
        raise ImageError(f"{name} has the type {dataset.dtype}: must be numbers or texts")
    return np.asarray(dataset[()])


def _attribute(value: object) -> Attribute:
    if isinstance(value, np.ndarray):
        return tuple(text.decode() if isinstance(text, bytes) else str(text) for text in value)
    if isinstance(value, np.bool_ | np.integer | np.floating):
        return value.item()
    if isinstance(value, str):
        return value
    if isinstance(value, h5py.Empty):  # an empty list of texts
        return ()
    raise ImageError(f"an attribute has the type {type(value).__name__}: must be a number or text")
