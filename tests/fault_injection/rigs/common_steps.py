"""Steps that several faults have in common: judge what reached the electronics, and get in the driver's way."""

from __future__ import annotations

import socket
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from dm_msgs.action import Degauss
from dm_msgs.msg import ActuatorState, FocusState
from numpy.typing import ArrayLike

from dm_common.messages import stamp_ns
from dm_common.ros.clients import ThreadedActionClient
from fault_injection.fault import FaultRecord
from fault_injection.rigs.driver_rig import PATIENCE_S, DriverRig

#: A held shape is corrected for creep: signals that differ less are the same shape.
SAME_SHAPE = 0.04


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


def same_shape(signals: ArrayLike, others: ArrayLike) -> bool:
    """Whether both are signals of all actuators and differ by no more than corrections of creep."""
    one, other = np.asarray(signals, dtype=np.float64), np.asarray(others, dtype=np.float64)
    return bool(one.shape == other.shape == (37,) and np.abs(one - other).max() <= SAME_SHAPE)


def overtaken(reports: Iterable[ActuatorState], state: FocusState) -> bool:
    """Whether somebody who holds the mirror has commanded another shape since that of `state` was."""
    since = stamp_ns(state.header.stamp)
    return any(
        report.holder and stamp_ns(report.header.stamp) > since and not same_shape(report.requested, state.signals)
        for report in reports
    )


def begin_degauss(rig: DriverRig, steps: int) -> Any:
    """Begin a degauss; returns the future of its result."""
    client = ThreadedActionClient(rig.node, Degauss, "degauss")
    rig.wait(client.server_is_ready, "action degauss")
    accepted = client.send_goal_async(Degauss.Goal(steps=steps))
    rig.wait(accepted.done, "acceptance of the degauss")
    return accepted.result().get_result_async()


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
