"""Structured damage to files: seeded, so that file number n of a seed can be made again.

What a mutation may legally change in a map is told by :mod:`fault_injection.fuzz.classify`; only mutations that rewrite
an HDF5 file as a whole, so that bytes can no longer be compared, say it themselves in `Mutation.fields`.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Any

import h5py
import numpy as np

from fault_injection.fuzz.reference_files import DAT_FIELDS, DAT_HEADER, ReferenceFile

#: Numbers that readers trip over, as text.
_WORDS = (
    *("0", "-1", "1", "nan", "inf", "-inf", "1e999", "1e-320", "4294967296", "-2147483648", "2147483640"),
    *("2147483639", "9223372036854775807", "18446744073709551616", "1_000", "0x10", "1e3", "No", "#", '"', ""),
    *("\x1f", "\x85", "\xa0", "9" * 45, "9" * 5000),
)
_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-45, 5e-324, 1e38, 1e308, 1e-7, 2e-5, 0.01, 100.0, float("inf"), float("nan"))
_LONGEST_RUN = 64


@dataclass(frozen=True)
class Mutation:
    """A damaged file.

    Attributes:
        kind: name of the mutation.
        content: the bytes.
        fields: names of the values that were set on purpose in a file written anew; None = compare the bytes.
    """

    kind: str
    content: bytes
    fields: frozenset[str] | None = None


def mutate(file: ReferenceFile, seed: int, number: int) -> Mutation:
    """Damaged file `number` of `seed`."""
    random = Random(f"{file.format}/{seed}/{number}")
    kinds = [*_ANY]
    if file.format == "dat":
        kinds += [dat_field] * 6
    elif file.suffix in (".asc", ".xyz"):
        kinds += [text_word] * 6 + [text_lines] * 2
    elif file.format != "fits":
        kinds += [structure_bits] * 8 + [hdf5_structure]
        if file.format in ("datx", "h5", "4D"):
            kinds += [value_bits] * 2
    mutation = random.choice(kinds)
    outcome = mutation(file, random)
    content, fields = outcome if isinstance(outcome, tuple) else (outcome, None)
    return Mutation(mutation.__name__, bytes(content), fields)


# Of any format


def bits(file: ReferenceFile, random: Random) -> bytearray:
    """One to eight bits flipped anywhere."""
    content = bytearray(file.content)
    for _ in range(random.choice((1, 1, 1, 2, 4, 8))):
        content[random.randrange(len(content))] ^= 1 << random.randrange(8)
    return content


def bits_in_the_beginning(file: ReferenceFile, random: Random) -> bytearray:
    """Bits flipped among the first kilobyte, where headers are."""
    content = bytearray(file.content)
    for _ in range(random.choice((1, 1, 2, 4))):
        content[random.randrange(min(1024, len(content)))] ^= 1 << random.randrange(8)
    return content


def run_of_bytes(file: ReferenceFile, random: Random) -> bytearray:
    """A run overwritten with one value or with noise."""
    content = bytearray(file.content)
    start = random.randrange(len(content))
    length = min(random.randint(1, _LONGEST_RUN), len(content) - start)
    value = random.choice((0x00, 0xFF, 0x7F, 0x80, 0x20, None))
    content[start : start + length] = random.randbytes(length) if value is None else bytes([value]) * length
    return content


def truncation(file: ReferenceFile, random: Random) -> bytes:
    """The end is missing: anything from one byte to nearly all."""
    keep = random.choice((random.randrange(len(file.content)), len(file.content) - random.randint(1, 16)))
    return file.content[:keep]


def extension(file: ReferenceFile, random: Random) -> bytes:
    """Something follows the end."""
    length = random.choice((1, 2, 4, 130, 4096))
    return file.content + random.choice((bytes(length), random.randbytes(length), file.content[:length]))


def block(file: ReferenceFile, random: Random) -> bytes:
    """A block is missing, doubled, or stands elsewhere."""
    content = file.content
    size = random.choice((1, 2, 4, 8, 16, 64, 512))
    start = random.randrange(max(len(content) - size, 1))
    part = content[start : start + size]
    without = content[:start] + content[start + size :]
    what = random.randrange(3)
    if what == 0:
        return without
    at = start if what == 1 else random.randrange(len(without) + 1)
    base = content if what == 1 else without
    return base[:at] + part + base[at:]


_ANY: tuple[Callable[[ReferenceFile, Random], Any], ...] = (
    *(bits, bits, bits, bits_in_the_beginning, bits_in_the_beginning),
    run_of_bytes,
    truncation,
    extension,
    block,
)

# Of one format


def dat_field(file: ReferenceFile, random: Random) -> bytearray:
    """One to three header fields at extremes, at near misses, or exchanged."""
    content = bytearray(file.content)
    names = [name for name in DAT_FIELDS if name not in ("magic", "format")]
    for name in random.sample(names, random.choice((1, 1, 2, 3))):
        at, code = DAT_FIELDS[name]
        if code == ">f":
            struct.pack_into(code, content, at, _clipped(random.choice(_FLOATS)))
            continue
        bytes_ = struct.calcsize(code)
        high = 2 ** (8 * bytes_ - code[-1].islower())
        low = -high if code[-1].islower() else 0
        old = struct.unpack_from(code, content, at)[0]
        value = random.choice((low, high - 1, 0, 1, old - 1, old + 1, 2 * old, old // 2, random.randrange(low, high)))
        struct.pack_into(code, content, at, min(max(value, low), high - 1))
    if random.random() < 0.1:  # width for height: the same number of pixels
        content[68:70], content[70:72] = content[70:72], content[68:70]
    if random.random() < 0.1:
        content[DAT_HEADER:] = content[DAT_HEADER:] + random.randbytes(random.choice((2, 4, 1000)))
    return content


def _clipped(value: float) -> float:
    return float(np.clip(value, -3e38, 3e38)) if np.isfinite(value) else value


def text_word(file: ReferenceFile, random: Random) -> bytes:
    """Words replaced by numbers at extremes and by what is no number."""
    words = file.content.split(b" ")
    for _ in range(random.choice((1, 1, 2, 5))):
        words[random.randrange(len(words))] = random.choice(_WORDS).encode("latin-1")
    return b" ".join(words)


def text_lines(file: ReferenceFile, random: Random) -> bytes:
    """A line is missing, doubled, swapped, joined to the next, or garbage."""
    lines = file.content.split(b"\n")
    first, second = random.randrange(len(lines) - 1), random.randrange(len(lines))
    what = random.randrange(5)
    if what == 0:
        del lines[first]
    elif what == 1:
        lines.insert(second, lines[first])
    elif what == 2:
        lines[first], lines[second] = lines[second], lines[first]
    elif what == 3:
        lines[first : first + 2] = [lines[first] + lines[first + 1]]
    else:
        lines[first] = random.randbytes(random.choice((1, 20, 20000)))
    return b"\n".join(lines)


def structure_bits(file: ReferenceFile, random: Random) -> bytearray:
    """Bits or bytes changed outside the phase data: superblock, object headers, heaps, attributes."""
    content = bytearray(file.content)
    ((start, end),) = file.places.get("samples", ((0, 0),))
    for _ in range(random.choice((1, 1, 2, 3))):
        at = random.randrange(len(content) - (end - start))
        at += (end - start) * (at >= start)
        if random.random() < 0.7:
            content[at] ^= 1 << random.randrange(8)
        else:
            content[at] = random.choice((0, 1, 0x7F, 0x80, 0xFF))
    return content


def value_bits(file: ReferenceFile, random: Random) -> bytearray:
    """Bits flipped in the values that scale a `.datx` map, or the whole value at an extreme."""
    content = bytearray(file.content)
    name = random.choice([name for name in file.places if name != "samples"])
    start, end = random.choice(file.places[name])
    if end - start == 8 and random.random() < 0.5:
        struct.pack_into("<d", content, start, random.choice(_FLOATS))
    else:
        content[random.randrange(start, end)] ^= 1 << random.randrange(8)
    return content


def hdf5_structure(file: ReferenceFile, random: Random) -> tuple[bytes, frozenset[str]]:
    """The file written anew with an object of another kind, another shape, a link, or a loop."""
    buffer = io.BytesIO(file.content)
    with h5py.File(buffer, "r+") as content:
        names: list[str] = []
        content.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        name = random.choice(names)
        node = content[name]
        attributes = dict(node.attrs)
        data = node[()] if node.dtype.kind != "O" else None
        shape = node.shape
        what = random.choice((_as_link, _as_loop, _as_huge, _as_external, _as_other_type, _deep, _wide_attribute))
        what(content, name, shape, data, random)
        if name in content and isinstance(content.get(name, getlink=True), h5py.HardLink):
            for key, value in attributes.items():
                if what is not _wide_attribute:
                    content[name].attrs[key] = value
    return buffer.getvalue(), frozenset()


def _as_link(content: Any, name: str, _shape: Any, _data: Any, random: Random) -> None:
    del content[name]
    content[name] = random.choice(
        (
            h5py.SoftLink(f"/{name}"),
            h5py.SoftLink("/"),
            h5py.ExternalLink("/etc/hostname", "/"),
            h5py.ExternalLink("absent.h5", "/"),
        )
    )


def _as_loop(content: Any, name: str, _shape: Any, _data: Any, random: Random) -> None:
    """A group that holds itself, by a hard link."""
    if random.random() < 0.5:
        del content[name]
        content[name] = content["/"]
    else:
        content[f"{name}-loop"] = content["/"]


def _as_huge(content: Any, name: str, shape: Any, _data: Any, random: Random) -> None:
    """A few bytes that promise gigabytes: nothing allocated, or compressed emptiness."""
    del content[name]
    each = {1: (2**28,), 2: (2**14, 2**14)}.get(len(shape), (2**28,))
    kind = random.choice(("f8", "i8", "u1", h5py.string_dtype()))
    content.create_dataset(name, each, kind, chunks=tuple(min(size, 1024) for size in each), compression="gzip")


def _as_external(content: Any, name: str, _shape: Any, _data: Any, _random: Random) -> None:
    del content[name]
    content.create_dataset(name, (4,), "u1", external=[("/etc/hostname", 0, 4)])


def _as_other_type(content: Any, name: str, shape: Any, data: Any, random: Random) -> None:
    """A type, byte order or number of dimensions that no writer of these files uses, or nothing at all."""
    del content[name]
    kind = random.choice((">f8", "c16", "S5", "f2", "empty", "scalar", "3d"))
    if kind == "empty":
        content.create_dataset(name, data=h5py.Empty("f8"))
    elif kind == "scalar":
        content.create_dataset(name, data=1.0)
    elif kind == "3d":
        content.create_dataset(name, data=np.zeros((2, 2, 2)))
    else:
        content.create_dataset(name, data=np.zeros(shape, kind))


def _deep(content: Any, name: str, _shape: Any, _data: Any, random: Random) -> None:
    """Hundreds of groups inside each other, at a place where a reader looks."""
    at = content.create_group(f"{name}-deep")
    for _ in range(random.choice((50, 1200))):
        at = at.create_group("a")


def _wide_attribute(content: Any, name: str, _shape: Any, _data: Any, random: Random) -> None:
    """An attribute as large as the old format allows, or of another kind."""
    key = random.choice([*content[name].attrs, "Wavelength", "extra"])
    value = random.choice((np.zeros(8000), np.array([1, 2, 3]), "text", np.zeros((2, 0)), h5py.Empty("f8")))
    where = random.choice((content[name], content))
    where.attrs[key] = value
