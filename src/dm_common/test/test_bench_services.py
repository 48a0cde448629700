"""A map and an interferometer that dies meanwhile; and the way back when the process ends."""

from __future__ import annotations

import time
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from dm_msgs.action import Degauss
from dm_msgs.srv import Measure, SetSignals
from rclpy.node import Node
from rclpy.time import Time

from dm_common.errors import Cancelled, ErrorCode, MeasurementError, Refusal
from dm_common.ros import bench_services
from dm_common.ros.bench_services import BenchServices
from dm_common.ros.clients import ServiceCallError
from dm_common.ros.worker import WorkerActionServer
from ros_fixtures import Observer

#: Longest pause before a node that died is started again, s.
BACK_OFF_S = 30.0


class Bench(BenchServices):
    """An interferometer that dies in so many maps and returns after its back-off; stands in for the time too."""

    def __init__(self, deaths: int) -> None:
        self.deaths, self.tries, self.now, self.returns_at = deaths, 0, 0.0, 0.0
        self._values = {"measure_timeout": 60.0}

    def monotonic(self) -> float:
        return self.now

    def sleep(self, duration: float) -> None:
        self.now += duration

    def _measured(self, *_arguments: Any) -> Any:
        self.tries += 1
        assert self.tries < 20
        if self.tries <= self.deaths:
            self.returns_at = self.now + BACK_OFF_S
            raise MeasurementError(ErrorCode.INTERFEROMETER_UNAVAILABLE, "measure: it has died")
        return "a map"

    def _no_interferometer(self) -> bool:
        return self.now < self.returns_at

    def _stopping(self) -> bool:
        return False


def test_a_map_is_taken_again_when_the_interferometer_is_back_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(deaths=4)
    monkeypatch.setattr(bench_services, "time", bench)
    assert bench.measure("rest") == "a map"
    bench = Bench(deaths=100)
    monkeypatch.setattr(bench_services, "time", bench)
    with pytest.raises(Refusal, match=r"^measure: it has died \(5 tries\)$") as refused:
        bench.measure("rest")
    assert refused.value.error_code == ErrorCode.INTERFEROMETER_UNAVAILABLE and bench.tries == 5
    assert not isinstance(refused.value, MeasurementError)  # which would be tried again


def test_a_map_that_the_end_of_the_process_cuts_off_has_not_failed() -> None:
    bench = Bench(deaths=0)
    bench.cancelled = lambda: False
    bench._node = cast(Any, SimpleNamespace(context=SimpleNamespace(ok=lambda: False)))
    server: Any = SimpleNamespace(wait_for_return=lambda _stop: None, since_now=lambda _ready: lambda: "")
    with pytest.raises(Cancelled), bench._answered("measure", server, lambda: True):
        raise ServiceCallError("measure: cancelled")


@pytest.mark.parametrize(("simulated", "step_s"), [(False, 3600.0), (False, -3600.0), (True, -3600.0)])
def test_a_map_takes_as_long_when_the_clock_is_set_meanwhile(
    observer: Observer, monkeypatch: pytest.MonkeyPatch, simulated: bool, step_s: float
) -> None:
    """The next run holds the mirror for as many times that: a negative duration would be refused."""
    shifts, node = [0.0], observer.node

    def answer(_request: Any, response: Any) -> Any:
        shifts.append(step_s)
        samples = response.samples
        samples.sag = samples.x = samples.y = samples.weight = [1.0]
        return response

    def now() -> Time:
        return Time(seconds=1e9 + time.monotonic() + shifts[-1])

    node.create_service(Measure, "measure", answer)
    bench = BenchServices(node, {"settle_time": 0.0, "measure_timeout": 60.0})
    monkeypatch.setattr(node, "get_clock", lambda: SimpleNamespace(now=now, ros_time_is_active=simulated))
    bench.measure_present_shape("rest")
    assert shifts[-1] == step_s and 0.0 <= bench.map_time < 60.0


def test_a_process_that_ends_brings_back_its_own_mirror_and_no_other(observer: Observer) -> None:
    called: list[str] = []

    def serve(name: str) -> None:
        def answer(_request: Any, response: Any) -> Any:
            called.append(name)
            return response

        observer.node.create_service(SetSignals, name, answer)

    for name in ("/set_signals", "/left/set_signals", "/left/remapped"):
        serve(name)
    WorkerActionServer(observer.node, Degauss, "/left/degauss", lambda _: ("succeed", Degauss.Result()))
    for remap in ([], ["--ros-args", "-r", "set_signals:=remapped"]):
        node = Node("calibration", namespace="/left", cli_args=remap, context=observer.node.context)
        bench = BenchServices(node, {"settle_time": 0.0, "driver_timeout": 5.0, "degauss_timeout": 5.0})
        assert bench.rest_at_exit(np.zeros(37)) == "the mirror is back at mid range"
        # A run that is still under way in its thread undoes nothing of that.
        for command in (partial(bench.apply, np.ones(37)), bench.degauss):
            with pytest.raises(Cancelled, match="the process ends"):
                command()
        node.destroy_node()
    assert called == ["/left/set_signals", "/left/remapped"]


def test_a_driver_that_ends_with_the_process_is_no_failure_to_bring_the_mirror_back(observer: Observer) -> None:
    """As when Ctrl-C ends all nodes in a calibration: the driver, found still, takes the mirror to its safe shape."""
    driver = Node("pdm_driver", namespace="/right", context=observer.node.context)
    driver.create_service(SetSignals, "set_signals", lambda _request, response: response)  # nobody serves it
    node = Node("calibration", namespace="/right", context=observer.node.context)
    bench = BenchServices(node, {"settle_time": 0.0, "driver_timeout": 2.0, "degauss_timeout": 5.0})
    assert "was not brought back to mid range: pdm_driver ends too" in bench.rest_at_exit(np.zeros(37))
    for each in (node, driver):
        each.destroy_node()
