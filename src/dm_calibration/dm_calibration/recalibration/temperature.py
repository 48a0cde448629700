"""The topic `temperature`: its reading at the time of a map, and whether readings still arrive."""

import math
from bisect import bisect_right, insort
from collections.abc import Callable

from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Temperature

from dm_common.messages import seconds

#: Number of readings kept: one hour at one per second.
KEPT = 3600
#: Change of temperature after which everything that depends on it is published again, K.
WARMED_K = 0.05
#: Range of possible readings, degC; anything else is a fault of the thermometer.
POSSIBLE = (-100.0, 200.0)


class TemperatureLog:
    """Readings in the order of their stamps.

    Args:
        node: listens on the topic `temperature`.
        silent_after: returns the time without a reading, s, after which the temperature is not known.
    """

    def __init__(self, node: Node, silent_after: Callable[[], float]) -> None:
        self._node, self._silent_after = node, silent_after
        self._readings: list[tuple[float, float]] = []
        self._published = math.nan
        node.create_subscription(Temperature, "temperature", self._on_reading, qos_profile_sensor_data)

    def _on_reading(self, message: Temperature) -> None:
        now = 1e-9 * self._node.get_clock().now().nanoseconds
        if not now:  # simulated time has not begun here: the stamp cannot be judged
            return
        stamp, latest = seconds(message.header.stamp) or now, now + self._silent_after()
        while self._readings and self._readings[-1][0] > latest:
            self._readings.pop()  # from before the clock was set back
        # A reading spoilt by a faulty driver or a clock set back is dropped; a late one is sorted in by its stamp.
        if (possible := POSSIBLE[0] <= message.temperature <= POSSIBLE[1]) and stamp <= latest:
            insort(self._readings, (stamp, message.temperature))
            del self._readings[:-KEPT]
        else:
            wrong = f"temperature = {message.temperature:g} degC: must be {POSSIBLE[0]:g} to {POSSIBLE[1]:g} degC"
            text = f"header.stamp is {stamp - now:.0f} s ahead of now" if possible else wrong
            self._node.get_logger().warning(f"temperature reading ignored: {text}", throttle_duration_sec=60.0)

    def at(self, time: float) -> float:
        """degC at `time` (s): the last reading before it; NaN when there is none that is recent enough."""
        readings = list(self._readings)
        place = bisect_right(readings, (time, math.inf)) - 1
        if place < 0 or time - readings[place][0] > self._silent_after():
            return math.nan
        return readings[place][1]

    def now(self) -> float:
        """degC now; NaN = not known."""
        return self.at(1e-9 * self._node.get_clock().now().nanoseconds)

    def published(self) -> float:
        """The temperature now, remembered as the one that was published last."""
        self._published = self.now()
        return self._published

    @property
    def changed(self) -> bool:
        """Whether the temperature differs from the one published last, or has become known or unknown since."""
        now, before = self.now(), self._published
        return not abs(now - before) < WARMED_K and not (math.isnan(now) and math.isnan(before))
