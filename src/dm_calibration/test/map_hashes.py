"""Maps by the hash of what was measured in them."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import numpy as np

from dm_calibration.influence.maps import MapSet
from dm_common.measurement import Measurement


def measurements(maps: MapSet) -> list[Measurement]:
    """The maps one by one."""
    rows = []
    for k in range(len(maps)):
        row: dict[str, Any] = {name: getattr(maps, name)[k] for name in maps.columns()}
        row = {name: value.item() if isinstance(value, np.generic) else value for name, value in row.items()}
        if np.isnan(row["nominal"]).all():
            row["nominal"] = None
        rows.append(Measurement(points=maps.points, **row))
    return rows


def map_hashes(maps: MapSet) -> list[str]:
    """SHA-256 over what was measured in each map: equal only when every bit is."""
    return [record_hash(record) for record in measurements(maps)]


def record_hash(record: Measurement) -> str:
    """The same of one map; of maps stored long ago, too (`stored/`)."""
    head: dict[str, Any] = {}
    arrays = b""
    for name in MapSet.columns():
        value = getattr(record, name)
        if isinstance(value, np.ndarray):
            head[name] = {"shape": value.shape, "at": len(arrays)}
            arrays += value.astype("<f8").tobytes()
        elif name != "temperature" or not np.isnan(value):
            head[name] = value
    return hashlib.sha256(json.dumps(head).encode() + arrays).hexdigest()
