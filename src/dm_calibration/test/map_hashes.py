"""Maps by the hash of what was measured in them."""

from __future__ import annotations

import hashlib
import json

from dm_calibration.influence.maps import MapSet
from dm_calibration.procedure.event_frames import _plain
from dm_common.measurement import Measurement


def map_hashes(maps: MapSet) -> list[str]:
    """SHA-256 over what was measured in each map: equal only when every bit is."""
    return [record_hash(record) for record in maps.measurements()]


def record_hash(record: Measurement) -> str:
    """The same of one map."""
    arrays: list[bytes] = []
    head = json.dumps(_plain(record, arrays))
    return hashlib.sha256(head.encode() + b"".join(arrays)).hexdigest()
