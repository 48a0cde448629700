"""The log of checks beside a calibration, ``<id>.checks.csv``: the comparison of each later map with it."""

import csv
import math
from contextlib import suppress
from dataclasses import astuple, dataclass, fields
from io import TextIOWrapper
from pathlib import Path
from typing import Any

SUFFIX = ".checks.csv"


@dataclass(frozen=True)
class Check:
    """A map that was compared with the calibration in use.

    Attributes:
        time: of the map, s since the epoch.
        accepted: 1 = it agreed and updated the calibration.
        max_zernike: largest difference of a coefficient beyond tilt, m.
        rms: of the difference in sag, m.
        surprise: difference relative to its expected size.
        gain_drift: largest relative change of a gain since the calibration was made, after this map.
        actuator: the actuator of that gain, from 1.
        offset_drift: change of the figure since then, m rms.
    """

    time: float
    accepted: int
    max_zernike: float
    rms: float
    surprise: float
    gain_drift: float
    actuator: int
    offset_drift: float


def append_check(file: Path, check: Check) -> None:
    """Add a line to the log. Raises OSError."""
    with file.open("ab+") as log, TextIOWrapper(log, newline="") as stream:
        log.seek(max(log.tell() - 1, 0))
        end, writer = log.read(), csv.writer(stream)
        if not end:
            writer.writerow(item.name for item in fields(Check))
        elif end != b"\n":  # a power cut has torn the last line
            writer.writerow(())
        writer.writerow(astuple(check))


def read_checks(file: Path) -> list[Check]:
    """The checks in a log, oldest first, without lines torn by a power cut; none if there is no file."""
    found = []
    try:
        lines = file.read_text(errors="replace").splitlines()
    except OSError:
        return []
    kinds: list[Any] = [item.type for item in fields(Check)]
    for line in lines[1:]:
        with suppress(ValueError):
            values = [kind(value) for kind, value in zip(kinds, line.split(","), strict=True)]
            found += [Check(*values)] if all(map(math.isfinite, values)) else []
    return sorted(found, key=lambda check: check.time)
