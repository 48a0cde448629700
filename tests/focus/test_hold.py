"""When a held shape is corrected, by how much, and when holding ends."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from dm_msgs.msg import FocusRequest

from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_common.hysteresis.observer import ActuatorEstimate
from dm_common.limits import Limits
from dm_controller.creep_hold import PERIOD_S, CreepHold
from dm_controller.driver_monitor import DriverMonitor
from dm_controller.focus_types import Moment, Order
from dm_controller.planning.mirror_model import CalibratedMirror
from dm_controller.planning.planner import HysteresisFigures, Planner
from dm_controller.planning.target import FocusTarget
from linear_mirror import LinearMirror, hexagon, make_mirror
from perfect_calibration import perfect_model

DEFAULTS = {
    "hold.enable": True,
    "hold.period": 1.0,
    "hold.tolerance": 2e-10,
    "hold.slew": 0.02,
    "hold.resolution": 3e-5,
}


class Shape:
    """A shape that was set at 0 s and is held since; `estimate` follows the corrections."""

    def __init__(self, values: Mapping[str, Any] = {}, creep_rate: float = 0.01, known: bool = True) -> None:
        law = HysteresisModel(np.array([0.0, 0.3]), np.array([[0.9], [0.1]]), np.zeros(0), 0.0, creep_rate, CREEP_TIMES)
        mirror = CalibratedMirror(
            perfect_model(LinearMirror(*hexagon())), Limits(-1.0, 1.0, make_mirror().limits.pairs, 2.0)
        )
        self.planner = Planner(mirror, HysteresisFigures(law, 1e-9, 0.05))
        monitor = DriverMonitor(DEFAULTS)
        self.hold = CreepHold(DEFAULTS | dict(values), monitor)
        state = law.demagnetised(37, 0.0)
        move = self.planner.plan(FocusTarget(0.03), state, 0.0, known, ahead=0.05)
        self.estimate = ActuatorEstimate(law.move(state, move.plan.signals, 0.0), "" if known else "a test says so")
        self.signals, self.effective = move.plan.signals, move.effective
        active: Any = SimpleNamespace(planner=self.planner)
        self.order = Order(FocusRequest(), Moment(0, 0.0, 0.0), active, move, creep_held=True)
        monitor.order = self.order
        self.order.send(self.signals, Moment(0, 0.0, 0.0)).confirmed = True

    def send(self, signals: np.ndarray, now: float, confirmed: bool) -> None:
        """A correction goes out."""
        self.order.send(signals, Moment(0, now, now), expected_turns=1).confirmed = confirmed

    def correct(self, now: float) -> np.ndarray | None:
        """The correction due at `now`, carried out at once."""
        signals = self.hold.correction(self.estimate, now)
        if signals is not None:
            assert self.estimate.state is not None
            self.estimate = ActuatorEstimate(
                self.planner.law.move(self.estimate.state, signals, now), self.estimate.unknown
            )
            self.send(signals, now, confirmed=True)
        return signals


def test_corrections_come_ever_more_rarely_and_keep_the_shape() -> None:
    shape = Shape()
    times = [float(now) for now in range(1, 3601) if shape.correct(now) is not None]
    assert times[0] == 1.0
    assert len(times) < 400
    assert times[-1] - times[-2] > 20 * (times[1] - times[0])
    assert shape.estimate.state is not None
    assert shape.planner.drift(shape.estimate.state, 3600.0, shape.effective) < 4e-10


def test_a_shape_is_right_within_its_first_second() -> None:
    shape = Shape({"hold.period": PERIOD_S})
    left_alone = Shape({"hold.enable": False}).estimate.state
    assert left_alone is not None and shape.estimate.state is not None
    for now in np.arange(PERIOD_S, 1.0, PERIOD_S):
        shape.correct(float(now))
    assert shape.planner.drift(shape.estimate.state, 1.0, shape.effective) < 4e-10
    assert shape.planner.drift(left_alone, 1.0, shape.effective) > 3e-9


def test_a_correction_is_no_larger_than_allowed() -> None:
    shape = Shape({"hold.slew": 1e-3}, creep_rate=0.1)
    correction = shape.correct(100.0)
    assert correction is not None
    np.testing.assert_allclose(np.abs(correction - shape.signals).max(), 1e-3)


def test_less_than_half_a_step_of_the_electronics_is_not_sent() -> None:
    assert Shape({"hold.resolution": 0.05}).correct(1000.0) is None
    assert Shape({"hold.resolution": 1e-5}).correct(1000.0) is not None


def test_no_correction_before_the_driver_has_taken_the_last() -> None:
    shape = Shape()
    signals = shape.hold.correction(shape.estimate, 100.0)
    assert signals is not None
    shape.send(signals, 100.0, confirmed=False)
    assert shape.hold.correction(shape.estimate, 200.0) is None


def test_the_command_of_another_ends_it() -> None:
    shape = Shape()
    shape.hold.driver_requested(np.zeros(37), 0.1)
    assert not shape.hold.active
    assert "another command" in shape.hold.ended


def test_a_command_that_the_driver_never_reports_ends_it() -> None:
    shape = Shape()
    signals = shape.hold.correction(shape.estimate, 100.0)
    assert signals is not None
    shape.send(signals, 100.0, confirmed=False)
    another = 0.5 * shape.signals
    shape.hold.driver_requested(another, 100.5)  # on its way
    assert shape.hold.active
    shape.hold.driver_requested(another, 101.5)
    assert not shape.hold.active


def test_a_correction_that_is_lost_does_not_end_it() -> None:
    shape = Shape()
    signals = shape.hold.correction(shape.estimate, 100.0)
    assert signals is not None
    shape.send(signals, 100.0, confirmed=False)
    shape.hold.driver_requested(shape.signals, 101.5)
    assert shape.hold.active


def test_a_history_that_gets_lost_ends_it() -> None:
    shape = Shape()
    assert shape.hold.correction(ActuatorEstimate(shape.estimate.state, "the link was lost"), 100.0) is None
    assert not shape.hold.active


def test_a_shape_set_from_an_unknown_history_is_held_too() -> None:
    assert Shape(known=False).correct(100.0) is not None


def test_it_is_checked_ever_more_rarely() -> None:
    shape = Shape({"hold.period": PERIOD_S, "hold.tolerance": 1e-6})  # no correction is ever due
    assert shape.hold.next_check == PERIOD_S
    for now in (1.0, 10.0, 100.0):
        assert shape.correct(now) is None
        np.testing.assert_allclose(shape.hold.next_check, 1.1 * now)
    assert shape.correct(50.0) is None  # the clock was set back
    assert shape.hold.next_check < 56.0
    shape.hold.end("a test says so")
    assert shape.hold.next_check == np.inf


def test_a_clock_that_is_set_back_stops_nothing_for_long() -> None:
    shape = Shape()
    assert shape.correct(1e6) is not None
    assert shape.correct(10.0) is None
    assert shape.hold.active
