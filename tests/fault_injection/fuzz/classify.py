"""What a reader made of a damaged file.

A file that is refused with the reader's own error is well. One that is read must give

* `intact`: the map of the intact file, in every pixel, wavelength and pitch; or
* `other_samples`: another map only in pixels whose stored samples the damage changed. `.dat`, `.datx`, `.asc`, `.xyz`
  and `.h5` have no checksum, that of `.fits` is a sum in any order: a changed sample that is still a number the format
  allows is a legal other map; or
* `other_header`: another scale, sign, wavelength or pitch, where the damage changed a header value that tells just
  that, for which the format stores no second witness, to another value inside its allowed range. `wavelength.expected`
  of the interferometer catches the wavelength; the others are in the published map info.

All else is a wrong map: another shape, pixels that moved, a value that changed though its bytes did not. A calibration
file has a hash over its content: it is refused or intact, nothing between.
"""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from dm_calibration.map_files import SurfaceMap
from fault_injection.fuzz.mutations import Mutation
from fault_injection.fuzz.reference_files import TEXT_FIELDS, ReferenceFile

_HEADER_LINES = 14
_SCALES = frozenset({"scale", "wavelength", "obliquity", "resolution", "sign", "unit"})


class Verdict(StrEnum):
    """One letter per file, as the worker process reports it."""

    REFUSED = "R"
    INTACT = "I"
    OTHER_SAMPLES = "S"
    OTHER_HEADER = "H"
    WRONG_MAP = "W"
    EXCEPTION = "E"
    MEMORY = "M"


def classify(file: ReferenceFile, whole: SurfaceMap, mutation: Mutation, found: SurfaceMap) -> Verdict:
    """The verdict on a map that was read from a damaged file without an error."""
    if found.sag.shape != whole.sag.shape:
        return Verdict.WRONG_MAP
    fields, touched = changed_values(file, mutation, whole.sag.shape)
    untouched = ~touched
    here, there = found.sag[untouched], whole.sag[untouched]
    if (np.isnan(here) != np.isnan(there)).any():
        return Verdict.WRONG_MAP
    scale = _scale(here, there)
    if scale is None or (scale != 1.0 and not fields & _SCALES):
        return Verdict.WRONG_MAP
    header = scale != 1.0
    for name in ("wavelength", "pitch"):
        if getattr(found, name) != getattr(whole, name):
            header = True
            if name not in fields:
                return Verdict.WRONG_MAP
    if header:
        return Verdict.OTHER_HEADER
    same = np.array_equal(found.sag[touched], whole.sag[touched], equal_nan=True)
    return Verdict.INTACT if same else Verdict.OTHER_SAMPLES


def _scale(here: NDArray[np.float64], there: NDArray[np.float64]) -> float | None:
    """The one factor between two sets of heights; None when there is none."""
    valid = np.isfinite(there)
    here, there = here[valid], there[valid]
    if np.array_equal(here, there):
        return 1.0
    largest = int(np.abs(there).argmax())
    factor = float(here[largest] / there[largest])
    if not math.isfinite(factor) or not np.allclose(here, factor * there, rtol=1e-9, atol=0.0):
        return None
    return factor


def changed_values(
    file: ReferenceFile, mutation: Mutation, shape: tuple[int, ...]
) -> tuple[set[str], NDArray[np.bool_]]:
    """Names of the header values and a mask (shape) of the pixels whose stored bytes differ from the intact file's."""
    if file.suffix in (".asc", ".xyz"):
        return _changed_text(file, mutation.content, shape)
    untouched: NDArray[np.bool_] = np.zeros(shape, dtype=np.bool_)
    if mutation.fields is not None:
        return set(mutation.fields), untouched
    if len(mutation.content) != len(file.content):
        return set(), untouched  # nothing may stand elsewhere than it did
    old, new = np.frombuffer(file.content, np.uint8), np.frombuffer(mutation.content, np.uint8)
    changed = old != new
    fields = {name for name, places in file.places.items() if any(changed[start:end].any() for start, end in places)}
    ((start, end),) = file.places["samples"]
    touched = changed[start:end].reshape(*shape, file.sample_bytes).any(axis=-1)
    return fields, touched[::-1] if file.format == "fits" else touched  # whose first row is the bottom


def _changed_text(file: ReferenceFile, content: bytes, shape: tuple[int, ...]) -> tuple[set[str], NDArray[np.bool_]]:
    fields = set()
    old, new = file.content.split(b"\n", _HEADER_LINES), content.split(b"\n", _HEADER_LINES)
    for name, (line, position) in TEXT_FIELDS.items():
        words, found = old[line - 1].split(), new[line - 1].split() if line <= len(new) else []
        if len(words) == len(found) and words[position - 1] != found[position - 1]:
            fields.add(name)
    pixels = shape[0] * shape[1]
    records, others = (_records(file.suffix, part[-1], pixels) for part in (old, new))
    if len(others) != len(records):
        return fields, np.zeros(shape, dtype=np.bool_)
    changed = np.array([one != other for one, other in zip(records, others, strict=True)])
    if file.suffix == ".xyz":  # a line may name another pixel than it did: that one is touched too
        place = {record[:2]: index for index, record in enumerate(records)}
        for index in np.flatnonzero(changed).tolist():
            changed[place.get(others[index][:2], index)] = True
    return fields, changed.reshape(shape)


def _records(suffix: str, body: bytes, pixels: int) -> list[tuple[bytes, ...]]:
    """What stands for each pixel, in the order of the file; empty when there are not as many records as pixels."""
    words = body.replace(b"No Data", b"nan").replace(b"#", b" ").split()
    each = 3 if suffix == ".xyz" else 1
    if len(words) != each * pixels:
        return []
    return [tuple(words[start : start + each]) for start in range(0, len(words), each)]
