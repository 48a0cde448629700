"""The topic `temperature` without ROS: which reading counts for a map, and when it is not known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from sensor_msgs.msg import Temperature

from dm_calibration.recalibration.temperature import TemperatureLog
from dm_common.messages import time_message


class Node:
    """Has a clock, takes the subscription and keeps warnings."""

    def __init__(self) -> None:
        self.seconds = 1000.0
        self.read: Any = None
        self.warnings: list[str] = []

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=lambda text, **_throttle: self.warnings.append(text))

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=round(1e9 * self.seconds)))

    def create_subscription(self, _kind: Any, topic: str, read: Any, _qos: Any) -> None:
        assert topic == "temperature"
        self.read = read

    def say(self, value: float, seconds: float) -> None:
        message = Temperature(temperature=value)
        message.header.stamp = time_message(round(1e9 * seconds))
        self.read(message)


@pytest.fixture
def node() -> Node:
    return Node()


@pytest.fixture
def log(node: Node) -> TemperatureLog:
    return TemperatureLog(node, lambda: 60.0)


def test_the_last_reading_before_a_map_counts(node: Node, log: TemperatureLog) -> None:
    for seconds in (980.0, 990.0, 1000.0):
        node.say(seconds / 50.0, seconds)
    assert [log.at(seconds) for seconds in (985.0, 991.0, 1030.0)] == [19.6, 19.8, 20.0]
    assert log.at(979.0) != log.at(979.0)
    assert log.now() == 20.0


def test_what_stops_coming_is_not_known_any_more(node: Node, log: TemperatureLog) -> None:
    assert not log.changed  # it never came, and nothing was published with it
    node.say(20.0, 1000.0)
    assert log.changed and log.published() == 20.0 and not log.changed
    node.say(20.2, 1030.0)
    node.seconds = 1031.0
    assert log.changed
    log.published()
    node.seconds = 1100.0
    assert log.changed and log.published() != log.published() and not log.changed


def test_readings_that_are_none_are_left_out(node: Node, log: TemperatureLog) -> None:
    for value, seconds in ((float("nan"), 1000.0), (1e4, 1000.0), (21.0, 5000.0)):
        node.say(value, seconds)
    assert log.now() != log.now()
    assert node.warnings[1:] == [
        "temperature reading ignored: temperature = 10000 degC: must be -100 to 200 degC",
        "temperature reading ignored: header.stamp is 4000 s ahead of now",
    ]
    node.say(21.0, 0.0)  # without a stamp it is of now
    assert log.now() == 21.0


def test_before_simulated_time_has_begun_no_reading_is_judged(node: Node, log: TemperatureLog) -> None:
    node.seconds = 0.0
    node.say(21.0, 1e9)
    node.seconds = 1e9
    assert log.now() != log.now() and not node.warnings


def test_a_late_reading_takes_its_place(node: Node, log: TemperatureLog) -> None:
    for value, seconds in ((20.0, 980.0), (22.0, 1000.0), (21.0, 990.0)):
        node.say(value, seconds)
    assert [log.at(seconds) for seconds in (985.0, 995.0, 1001.0)] == [20.0, 21.0, 22.0]


def test_readings_of_before_the_clock_was_set_back_go(node: Node, log: TemperatureLog) -> None:
    node.say(21.0, 1000.0)
    node.seconds = 500.0
    node.say(22.0, 500.0)
    assert log.now() == 22.0
    node.seconds = 1001.0
    assert log.now() != log.now()
