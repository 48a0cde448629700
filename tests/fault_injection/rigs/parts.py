"""What several faults do with a rig: judge what reached its electronics, and get in the driver's way."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

from fault_injection.fault import FaultRecord
from fault_injection.rigs.driver_rig import PATIENCE_S, DriverRig


@contextmanager
def checked(rig: DriverRig, record: FaultRecord) -> Iterator[None]:
    """Add to `record` what the monitor saw, however the block ends."""
    try:
        yield
    finally:
        record.limit_violations += rig.violations
        if rig.violations:
            seen = rig.bench.monitor.record
            record.remarks.append(
                f"{seen.jumps} jumps, largest {seen.largest_jump:.3f}; {seen.neighbour_violations} neighbours; "
                f"{seen.range_violations} out of range"
            )


@contextmanager
def other_client(rig: DriverRig) -> Iterator[None]:
    """Another program that holds the unit's only TCP connection."""

    def connected() -> socket.socket | None:
        try:
            return socket.create_connection(("127.0.0.1", rig.port), PATIENCE_S)
        except OSError:
            return None

    connection = rig.wait(connected, "the unit's connection")
    try:
        yield
    finally:
        connection.close()
