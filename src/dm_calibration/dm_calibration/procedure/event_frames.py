"""Events of a run as bytes, each sealed with a hash, so that torn or damaged ones are detected.

A frame is a mark, two lengths, a head in JSON, the raw bytes of the arrays and a SHA-256. The hash includes the hash of
the frame before it: no frame can get lost between two others, or be inserted from another run.
"""

import hashlib
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from dm_calibration.procedure.outcome import Doubted, Dropped, Event, MapTaken, Segment, Solved, Unseen
from dm_common.measurement import Measurement, Setup
from dm_common.optics.sampling import SamplePoints

_MARK = b"DMJ1"
_LENGTHS = struct.Struct("<II")
_SEAL = hashlib.sha256().digest_size
#: Largest head or payload that is accepted [bytes].
_SIZE_MAX = 1 << 26


@dataclass(frozen=True)
class Storing:
    """The calibration made from the run is about to be stored under `id`, as created at `created_ns`."""

    id: str
    created_ns: int


_EVENTS: dict[str, Any] = {
    kind.__name__: kind for kind in (Setup, Segment, MapTaken, Unseen, Dropped, Solved, Doubted, Storing)
}
#: Fields that all maps share are stored in Setup; the frame of a map holds the others.
_SHARED = [shared.name for shared in fields(Setup)]
_RECORD = [own.name for own in fields(Measurement) if own.name not in _SHARED]

#: Seal that precedes the first frame of a run.
FIRST = b"\0" * _SEAL


def encode(event: Event | Storing, before: bytes) -> tuple[bytes, bytes]:
    """`event` as a frame that follows the seal `before`, and the seal of this frame."""
    arrays: list[bytes] = []
    head = {"event": type(event).__name__, "fields": _plain(event, arrays)}
    text, payload = json.dumps(head).encode(), b"".join(arrays)
    body = b"".join((_MARK, _LENGTHS.pack(len(text), len(payload)), text, payload))
    seal = hashlib.sha256(before + body).digest()
    return body + seal, seal


def decode(content: bytes) -> Iterator[tuple[Event | Storing, int, bytes]]:
    """Decode frames from the beginning: event, end of its frame, seal. Ends at the first incomplete or damaged frame.

    Raises:
        ValueError: a frame is intact, but of another version.
    """
    seal, position, setup = FIRST, 0, None
    start = len(_MARK) + _LENGTHS.size
    while len(content) - position >= start + _SEAL and content[position : position + len(_MARK)] == _MARK:
        head, payload = _LENGTHS.unpack_from(content, position + len(_MARK))
        end = position + start + head + payload
        if max(head, payload) > _SIZE_MAX or end + _SEAL > len(content):
            return
        found = content[end : end + _SEAL]
        if hashlib.sha256(seal + content[position:end]).digest() != found:
            return
        text = content[position + start : position + start + head]
        event = _event(json.loads(text), memoryview(content)[position + start + head : end], setup)
        if isinstance(event, Setup):
            setup = event
        position, seal = end + _SEAL, found
        yield event, position, seal


def _event(head: dict[str, Any], payload: memoryview, setup: Setup | None) -> Event | Storing:
    """The event in a frame; a map in it was taken with `setup`."""
    try:
        values = _rebuilt(head["fields"], payload)
        if "record" in values:
            if setup is None:
                raise KeyError("points")
            shared = {name: getattr(setup, name) for name in _SHARED}
            values = {"record": Measurement(**shared | values["record"])}  # older frames hold more of it
        if "points" in values:
            values["points"] = SamplePoints(**values["points"])
        event: Event | Storing = _EVENTS[head["event"]](**values)
    except (KeyError, TypeError) as error:
        raise ValueError(f"event {head.get('event')!r} of another version: {error}") from error
    return event


def _plain(value: Any, arrays: list[bytes]) -> dict[str, Any]:
    """Fields of a dataclass for JSON; arrays are appended to `arrays` and replaced by their shape and position."""
    result: dict[str, Any] = {}
    for name in _RECORD if isinstance(value, Measurement) else [field.name for field in fields(value)]:
        item = getattr(value, name)
        if isinstance(item, np.ndarray):
            place = sum(map(len, arrays))
            arrays.append(np.ascontiguousarray(item, dtype="<f8").tobytes())
            result[name] = {"shape": item.shape, "at": place}
        else:
            result[name] = _plain(item, arrays) if is_dataclass(item) else item
    return result


def _rebuilt(values: dict[str, Any], payload: memoryview) -> dict[str, Any]:
    """The inverse of :func:`_plain`; dataclasses become dictionaries of their fields."""
    made: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict) and "shape" in value:
            shape = tuple(value["shape"])
            count = int(np.prod(shape))
            array = np.frombuffer(payload, dtype="<f8", count=count, offset=value["at"])
            made[name] = array.astype(np.float64).reshape(shape)
        elif isinstance(value, dict):
            made[name] = _rebuilt(value, payload)
        else:
            made[name] = tuple(value) if isinstance(value, list) else value
    return made
