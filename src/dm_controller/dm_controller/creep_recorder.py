"""Keeps what the actuators of a mirror have crept to on disk, and brings it back at the next start."""

from __future__ import annotations

from rclpy.clock import Clock
from rclpy.node import Node

from dm_common.hysteresis.creep_record import read_record, record_file, write_record
from dm_common.hysteresis.observer import HysteresisObserver

#: How often, s of wall time.
PERIOD_S = 30.0


class CreepRecorder:
    """Serves one mirror.

    Args:
        node: tells the time, hosts the timer.
        observer: follows the mirror.
        folder: that keeps the records; empty = none is kept.
        steady: clock of the timer.
    """

    def __init__(self, node: Node, observer: HysteresisObserver, folder: str, steady: Clock) -> None:
        self._node, self._observer, self._folder = node, observer, folder
        self._serial, self._file = "", record_file("", "")
        node.create_timer(PERIOD_S, self._write, clock=steady)

    def _now(self) -> float:
        return 1e-9 * float(self._node.get_clock().now().nanoseconds)

    def recall(self, serial: str) -> None:
        """Go on from the record of the mirror `serial`, if there is one."""
        if serial == self._serial:
            return
        self._serial, self._file = serial, record_file(self._folder, serial)
        try:
            self._observer.recall(read_record(self._file, self._now()) if self._file is not None else None)
        except ValueError as error:
            self._node.get_logger().warning(str(error))

    def _write(self) -> None:
        record = self._observer.record(self._now())
        if self._file is None or not self._serial or record is None:
            return
        try:
            write_record(self._file, record)
        except OSError as error:
            self._node.get_logger().warning(f"state_folder: {error}: the next start will not know of creep", once=True)
