"""The focus controller in simulated time, before a driver that is played here: no process, no ROS."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from array import array
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from copy import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from dm_msgs.action import MoveFocus
from dm_msgs.msg import (
    ActuatorHysteresis,
    ActuatorState,
    Calibration,
    Capabilities,
    FocusRequest,
    MirrorInfo,
    Recipe,
    RecipeBook,
)
from std_msgs.msg import Header

from dm_common.errors import ClockError, ErrorCode, Refusal
from dm_common.hysteresis.creep_record import UNSEEN, CreepRecord, rested
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_common.hysteresis.observer import ActuatorEstimate
from dm_common.messages import doubles, time_message
from dm_common.optics.zernike import basis
from dm_controller import focus_actions
from dm_controller.focus_actions import START_S, FocusHost
from dm_controller.focus_controller import FocusController
from dm_controller.focus_messages import capabilities_message, health, state_message
from dm_controller.focus_types import (
    Effect,
    Log,
    Moment,
    Order,
    PublishCapabilities,
    PublishState,
    SendCommand,
    StartDegauss,
)
from dm_controller.loop_actions import LoopBench
from dm_controller.planning.target import FocusTarget

ACTUATORS, POINTS, RADIUS = 37, 300, 11e-3
#: Of the actuators, in aperture radii.
PLACES = [(0.0, 0.0)] + [
    (0.4 * r * np.cos(k * np.pi / (3 * r)), 0.4 * r * np.sin(k * np.pi / (3 * r)))
    for r in (1, 2, 3)
    for k in range(6 * r)
]
CONDITIONED = FocusRequest.MODE_CONDITIONED
#: Creep is quick, so that a shape needs corrections soon.
LAW = HysteresisModel(np.array([0.0, 0.3]), np.array([[0.85], [0.15]]), np.zeros(0), 0.0, 0.05, CREEP_TIMES)
VALUES: dict[str, Any] = {
    "reachable_tolerance": 5e-8,
    "request_age": 1.0,
    "settle_time": 0.05,
    "move_timeout": 10.0,
    "driver_timeout": 3.0,
    "time_budget": 0.0,
    "condition.degauss_steps": 0,
    "condition.timeout": 20.0,
    "hold.enable": True,
    "hold.period": 0.02,
    "hold.tolerance": 2e-10,
    "hold.slew": 0.02,
    "hold.resolution": 3e-5,
    "calibration_age_max": 0.0,
    "hold_tilt": True,
    "optical_axis": [0.0, 0.0],
}


def calibration(name: str = "known", law: HysteresisModel = LAW, **fields: Any) -> Calibration:
    """Of a mirror whose actuators lift a bell of the surface each."""
    random = np.random.default_rng(1)
    angle, distance = random.uniform(0.0, 2.0 * np.pi, POINTS), np.sqrt(random.uniform(0.0, 1.0, POINTS))
    x, y = distance * np.cos(angle), distance * np.sin(angle)
    influence = np.array([2e-6 * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 0.3) for a, b in PLACES]).T
    terms = basis(x, y)
    return Calibration(
        id=name,
        mirror_serial="M1",
        actuators=ACTUATORS,
        aperture_radius=RADIUS,
        influence_zernike=doubles(np.linalg.lstsq(terms, influence, rcond=None)[0]),
        zernike_offset=doubles(np.zeros(21)),
        sample_x=doubles(x),
        sample_y=doubles(y),
        sample_weight=doubles(np.full(POINTS, 1.0 / POINTS)),
        influence_sag=doubles(influence),
        sag_offset=doubles(np.zeros(POINTS)),
        held_out_rms=1e-9,
        held_out_max_zernike=1e-9,
        hysteresis=ActuatorHysteresis(
            law="play",
            play_radius=doubles(law.play_radius),
            play_weight=doubles(law.play_weight),
            powers=1,
            creep_rate=law.creep_rate,
            creep_time=doubles(law.creep_time),
            held_out_max_zernike=1e-9,
            unknown_sigma=0.05,
        ),
        **fields,
    )


MIRROR = MirrorInfo(
    serial="M1",
    actuators=ACTUATORS,
    actuator_x=doubles(RADIUS * np.array(PLACES)[:, 0]),
    actuator_y=doubles(RADIUS * np.array(PLACES)[:, 1]),
    working_aperture_diameter=2.0 * RADIUS,
    signal_min=-1.0,
    signal_max=1.0,
    neighbour_difference_max=2.0,
    slew_rate_max=100.0,
)


class Bench:
    """A controller, and a driver that takes commands at once while `obeys`."""

    def __init__(self, **values: Any) -> None:
        self.controller = FocusController(VALUES | values)
        self.controller.degauss_offered = lambda: True
        self.time, self.ahead = 1000.0, 0.0  # s, steady, and how far the clock is ahead of it
        self.written: int | None = None  # stamp of all reports, ns; None = the time of each
        self.signals, self.requested = np.zeros(ACTUATORS), np.zeros(0)
        self.turns = self.degausses = self.sequence = 0
        self.turned_at = np.zeros(0)
        self.history_known, self.obeys = False, True
        self.state, self.error_code = ActuatorState.STATE_ACTIVE, ErrorCode.OK
        self.holder = ""
        self.unused = np.zeros(ACTUATORS, dtype=bool)  # without a channel: they rest at -1
        self.commands: list[SendCommand] = []
        self.outcomes: list[Order] = []  # as they were when they were published
        self.degauss_runs: list[StartDegauss] = []
        self.capabilities = 0
        self.log: list[str] = []
        self.mirror = LAW.demagnetised(ACTUATORS, self.time)
        self.do(self.controller.use(calibration(), MIRROR))
        self.report()

    @property
    def now(self) -> Moment:
        clock = self.time + self.ahead
        return Moment(round(1e9 * clock), clock, self.time)

    def do(self, effects: Iterable[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, SendCommand):
                self.commands.append(effect)
                if self.obeys and effect.expected_turns in (0, self.turns):
                    self.move(effect.signals)
            elif isinstance(effect, PublishState):
                self.outcomes.append(copy(effect.order))
            elif isinstance(effect, StartDegauss):
                self.degauss_runs.append(effect)
            elif isinstance(effect, PublishCapabilities):
                self.capabilities += 1
            elif isinstance(effect, Log):
                self.log.append(effect.text)

    def move(self, signals: np.ndarray) -> None:
        self.turns, self.turned_at = self.turns + 1, self.signals
        self.signals = self.requested = signals
        self.mirror = LAW.move(self.mirror, signals, self.time)
        self.report()

    def report(self, moving: bool = False, message: str = "") -> None:
        self.sequence += 1
        report = ActuatorState(
            driver_state=self.state,
            sequence=self.sequence,
            applied=doubles(np.where(self.unused, -1.0, self.signals)),
            flags=array("B", np.where(self.unused, ActuatorState.FLAG_UNUSED, 0).astype(np.uint8).tobytes()),
            requested=doubles(self.requested),
            turns=self.turns,
            turned_at=doubles(self.turned_at),
            degausses=self.degausses,
            history_known=self.history_known,
            moving=moving,
            error_code=self.error_code,
            message=message,
            holder=self.holder,
            holding=f"{self.holder} holds it",
        )
        report.header.stamp = time_message(self.now.ns if self.written is None else self.written)
        self.do(self.controller.driver_report(report, self.now))

    def degauss(self) -> None:
        """The driver has degaussed, and says so."""
        self.signals = self.requested = np.zeros(ACTUATORS)
        self.turns, self.degausses, self.history_known = self.turns + 1, self.degausses + 1, True
        self.turned_at = np.zeros(0)
        self.mirror = LAW.degaussed(self.mirror, self.time)
        self.report()

    def ask(self, curvature: float = 0.01, dry_run: bool = False, **fields: Any) -> Order:
        order, effects = self.controller.request(FocusRequest(curvature=curvature, **fields), self.now, dry_run)
        self.do(effects)
        return order

    def wait(self, seconds: float, step: float = 0.02) -> None:
        """Let time pass, with ticks as often as the node makes them, and a report every half a second."""
        end, next_report = self.time + seconds, self.time + 0.5
        while self.time < end:
            self.time += step
            if self.obeys and self.time >= next_report:
                next_report += 0.5
                self.report()
            self.do(self.controller.tick(self.now))

    def send_correction(self) -> SendCommand:
        """Hold a shape just set until a correction is sent, which the driver does not take, nor anything after it."""
        self.wait(0.3)
        self.obeys, sent = False, len(self.commands)
        self.wait(0.2)
        return self.commands[sent]

    def refusal(self) -> Refusal:
        refusal = self.outcomes[-1].refusal
        assert refusal is not None
        return refusal

    def error(self, effective: np.ndarray) -> float:
        """Largest distance of the effective signals from `effective`."""
        return float(np.abs(LAW.effective(LAW.advance(self.mirror, self.time)) - effective).max())


@pytest.fixture
def bench() -> Bench:
    made = Bench()
    made.degauss()
    return made


def move_of(order: Order) -> Any:
    assert order.move is not None
    return order.move


@pytest.mark.slow
def test_it_needs_no_ros() -> None:
    code = "import sys, dm_controller.focus_controller; sys.exit('rclpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_request_becomes_a_command_and_then_a_state(bench: Bench) -> None:
    order, effects = bench.controller.request(FocusRequest(curvature=0.01), bench.now)
    assert [type(effect) for effect in effects] == [SendCommand]  # the state follows the driver's confirmation
    bench.do(effects)
    assert [outcome.request for outcome in bench.outcomes] == [order.request]
    assert bench.outcomes[0].applied and bench.outcomes[0].creep_held and bench.outcomes[0].unknown == ""
    assert bench.controller.monitor.progress(order, bench.time).reached
    assert bench.controller.monitor.latency == 0.0
    bench.time += 0.05
    assert bench.error(move_of(order).effective) < 1e-6


def test_a_mirror_without_creep_is_not_held(bench: Bench) -> None:
    bench.do(bench.controller.use(calibration("other", replace(LAW, creep_rate=0.0)), MIRROR))
    bench.ask()
    assert bench.outcomes[-1].applied and not bench.outcomes[-1].creep_held
    assert not bench.controller.hold.active


def test_a_dry_run_changes_nothing(bench: Bench) -> None:
    order = bench.ask(dry_run=True)
    assert order.move is not None
    assert not (bench.commands or bench.outcomes)
    assert not bench.controller.hold.active


@pytest.mark.parametrize(("removed", "hold_tilt"), [(True, True), (True, False), (False, True)])
def test_a_calibration_without_tilt_is_named_where_tilt_is_to_be_held(removed: bool, hold_tilt: bool) -> None:
    bench, message = Bench(hold_tilt=hold_tilt), calibration("other")
    if removed:
        zernike = np.reshape(message.influence_zernike, (21, ACTUATORS))
        zernike[1:3] *= 1e-3
        message.influence_zernike = doubles(zernike)
    bench.log.clear()
    bench.do(bench.controller.use(message, MIRROR))
    assert any("other: its maps do not show" in text for text in bench.log) == (removed and hold_tilt)
    assert bench.controller.active is not None
    assert (bench.controller.active.mirror.tilt is None) == (removed or not hold_tilt)


@pytest.mark.parametrize("pattern", [r"(\S+) to (\S+) 1/m", r"\((\S+) to (\S+) dioptre"])
@pytest.mark.parametrize("stroke", [0.81, 0.84, 0.87])
def test_both_ends_of_the_range_that_is_told_may_be_asked_for(bench: Bench, stroke: float, pattern: str) -> None:
    message = calibration("straight", HysteresisModel.linear())
    for name in ("influence_zernike", "influence_sag"):
        setattr(message, name, doubles(stroke * np.array(getattr(message, name))))
    bench.do(bench.controller.use(message, MIRROR))
    message = capabilities_message(bench.controller, MIRROR, VALUES, bench.now).message
    beyond = bench.ask(1.0)
    for text in (message, str(beyond.refusal)):
        found = re.search(pattern, text)
        assert found is not None
        for end in found.groups():
            order = bench.ask(float(end) / (2.0 if "dioptre" in pattern else 1.0))
            assert order.refusal is None, end


def test_it_goes_on_without_an_actuator_that_does_not_move_and_says_so(bench: Bench) -> None:
    whole = capabilities_message(bench.controller, MIRROR, VALUES, bench.now)
    without = calibration("without", actuator_grade=["good"] * 5 + ["dead"] + ["good"] * 31)
    moves = np.arange(ACTUATORS) != 5
    for name in ("influence_zernike", "influence_sag"):
        matrix = np.array(getattr(without, name)).reshape(-1, ACTUATORS)
        setattr(without, name, doubles(matrix * moves))
    bench.do(bench.controller.use(without, MIRROR))
    message = capabilities_message(bench.controller, MIRROR, VALUES, bench.now)
    assert message.message.endswith("; without actuator 6")
    assert 0.0 < message.curvature_max < whole.curvature_max
    move = move_of(bench.ask(0.9 * message.curvature_max))
    assert bench.outcomes[-1].refusal is None and move.plan.max_zernike < VALUES["reachable_tolerance"]
    assert abs(move.effective[5]) < 1e-9


def test_where_nothing_is_reachable_capabilities_say_so(bench: Bench) -> None:
    bent = calibration("bent")
    figure = np.zeros(21)
    figure[10] = 1e-3
    bent.zernike_offset = doubles(figure)
    bent.sag_offset = doubles(basis(np.asarray(bent.sample_x), np.asarray(bent.sample_y)) @ figure)
    bench.do(bench.controller.use(bent, MIRROR))
    message = capabilities_message(bench.controller, MIRROR, VALUES, bench.now)
    assert message.error_code == ErrorCode.UNREACHABLE and "nan" not in message.message
    assert "no curvature is reachable: the initial figure takes more than the limits permit" in message.message
    assert "reachable_tolerance" in message.message
    assert health(bench.controller, VALUES, bench.now).message.startswith(message.message)
    bench.ask(0.01)
    assert "no curvature is reachable: the initial figure" in str(bench.refusal())
    bench.ask(0.01, zernike=[0.0] * 12 + [1e-3] + [0.0] * 8)
    assert str(bench.refusal()).endswith("no curvature is reachable with these added Zernike terms")


def test_a_curvature_that_is_hardly_beyond_the_range_is_told_from_its_end() -> None:
    denied = FocusTarget(0.05604).denied(20.04e-9, 20e-9, (-0.0561, 0.0560349))
    assert denied.startswith("curvature = +0.05604 1/m: ") and "error of 20.04 nm (allowed 20.0 nm)" in denied


def test_a_closed_loop_begins_only_where_the_mirror_can_go(bench: Bench) -> None:
    host = SimpleNamespace(order=lambda message, dry_run: bench.ask(message.curvature, dry_run))
    loop = cast(Any, SimpleNamespace(_host=host))
    assert LoopBench.move(loop, FocusRequest(curvature=0.01)).target.curvature == 0.01
    with pytest.raises(Refusal, match="reachable:") as refused:
        LoopBench.move(loop, FocusRequest(curvature=9.0))
    assert refused.value.error_code == ErrorCode.UNREACHABLE
    assert not (bench.commands or bench.outcomes)


@pytest.mark.parametrize(
    ("fields", "code", "text"),
    [
        ({"curvature": float("nan")}, ErrorCode.NOT_FINITE, "curvature = nan"),
        ({"curvature": 9.0}, ErrorCode.UNREACHABLE, "reachable:"),
        ({"curvature": 1e160}, ErrorCode.OUT_OF_RANGE, "curvature = 1e+160: must be float, -1e+06 to 1e+06 1/m"),
        ({"curvature": -1e6}, ErrorCode.OUT_OF_RANGE, "must be below 1"),
        ({"curvature": -1e6, "conic_constant": -1.0}, ErrorCode.UNREACHABLE, "reachable:"),
        ({"conic_constant": 1e300}, ErrorCode.OUT_OF_RANGE, "conic_constant = 1e+300: must be float, -1e+09 to 1e+09"),
        ({"zernike": [0.0, 1e308] + [0.0] * 19}, ErrorCode.OUT_OF_RANGE, "zernike[1] = 1e+308: must be float[], -1 to"),
        ({"zernike": [1.0] * 21}, ErrorCode.UNREACHABLE, "no curvature is reachable"),
        ({"mode": "7"}, ErrorCode.UNKNOWN_NAME, "mode = '7': must be one of empty, auto, direct, conditioned"),
        ({"time_budget": -1.0}, ErrorCode.OUT_OF_RANGE, "time_budget = -1.0: must be"),
        ({"header": Header(stamp=time_message(1))}, ErrorCode.STALE, "s old; allowed: 1 s (request_age)"),
        ({"header": Header(stamp=time_message(2**62))}, ErrorCode.STALE, "s ahead; allowed: 1 s (request_age)"),
        ({"mode": CONDITIONED}, ErrorCode.NOT_SUPPORTED, "no recipes"),
    ],
)
def test_a_request_that_makes_no_sense_is_refused(bench: Bench, fields: dict[str, Any], code: int, text: str) -> None:
    bench.ask(**fields)
    assert bench.commands == []
    assert bench.refusal().error_code == code
    assert text in str(bench.refusal())
    assert bench.log[-1].startswith("refused: ")


def test_a_conic_that_ends_early_narrows_the_range_and_no_more(bench: Bench) -> None:
    """This one reaches the edge of the aperture; at other curvatures that the mirror can take it does not."""
    order = bench.ask(0.001, conic_constant=1e6)
    state = state_message(order, VALUES, None)
    assert order.refusal is None and order.applied and state.error_code == ErrorCode.OK
    assert -0.1 < state.curvature_min < -0.001 and 0.001 < state.curvature_max < 0.1
    assert state_message(bench.ask(0.001), VALUES, None).curvature_max > state.curvature_max


def test_a_request_that_makes_no_sense_is_told_so_without_a_calibration_too(bench: Bench) -> None:
    bench.do(bench.controller.rest(Refusal(ErrorCode.NOT_CALIBRATED, "no calibration"), bench.now))
    bench.ask(float("nan"))
    assert bench.refusal().error_code == ErrorCode.NOT_FINITE
    bench.ask(0.01)
    assert bench.refusal().error_code == ErrorCode.NOT_CALIBRATED


def test_without_a_calibration_a_request_beside_the_first_run_is_told_who_holds_the_mirror(bench: Bench) -> None:
    bench.do(bench.controller.rest(Refusal(ErrorCode.NOT_CALIBRATED, "no calibration"), bench.now))
    bench.holder = "calibration"
    bench.report()
    bench.ask(0.01)
    assert bench.refusal().error_code == ErrorCode.BUSY and "calibration holds it" in str(bench.refusal())
    for fields in ({"take_over": True}, {"holder": "calibration"}):
        bench.ask(0.01, **fields)
        assert bench.refusal().error_code == ErrorCode.NOT_CALIBRATED
    bench.ask(float("nan"))
    assert bench.refusal().error_code == ErrorCode.NOT_FINITE
    assert bench.commands == []


def test_a_request_just_after_the_start_waits_for_the_calibration_that_is_on_its_way(bench: Bench) -> None:
    fresh = FocusController(VALUES)
    fresh.use(None, None)
    refusal = fresh.unavailable(bench.now)
    assert refusal is not None and "arrives within seconds of this node's start" in str(refusal)
    assert "no mirror_info from pdm_driver yet: is it running?" in str(refusal)
    early = Moment(0, 0.0, bench.time, simulated=True)
    asked = iter([(fresh, bench.now), (fresh, bench.now), (bench.controller, early), (bench.controller, bench.now)])
    host = cast(Any, SimpleNamespace(_started=time.monotonic(), controller=lambda: nullcontext(next(asked))))
    FocusHost.await_start(host)
    assert not list(asked)
    host._started -= START_S
    FocusHost.await_start(host)  # it asks no more


@pytest.mark.slow
def test_actuators_without_a_channel_are_neither_corrected_nor_kept_where_they_rest(bench: Bench) -> None:
    bench.unused[-1] = True
    bench.degauss()
    order = bench.ask(0.03)
    assert bench.controller.monitor.progress(order, bench.time).reached
    bench.wait(60.0)
    assert len(bench.commands) > 2 and bench.controller.hold.active
    first, *corrections = [command.signals for command in bench.commands]
    assert max(np.abs(signals - first).max() for signals in corrections) < 0.2
    bench.do(bench.controller.stop(order, bench.now) or [])
    np.testing.assert_allclose(bench.commands[-1].signals, corrections[-1], atol=1e-9)


def test_a_cancelled_move_is_left_inside_the_limits(bench: Bench) -> None:
    """Written as codes, neighbours may differ by a step more than they may be told to."""
    order = bench.ask(0.03)
    reached = np.where(np.arange(ACTUATORS) == 0, 1.0 + 1.5e-5, bench.signals)
    bench.signals = reached
    bench.report(moving=True)
    bench.do(bench.controller.stop(order, bench.now) or [])
    assert bench.commands[-1].signals.max() <= 1.0
    np.testing.assert_allclose(bench.commands[-1].signals, reached, atol=1e-4)


def test_the_newest_request_wins(bench: Bench) -> None:
    first, second = bench.ask(0.01), bench.ask(0.02)
    assert len(bench.commands) == 2
    failed = bench.controller.monitor.progress(first, bench.time).failed
    assert failed is not None and failed.error_code == ErrorCode.PREEMPTED
    assert bench.controller.monitor.progress(second, bench.time).reached
    assert bench.controller.stop(first, bench.now) is None
    bench.do(bench.controller.stop(second, bench.now) or [])
    assert not bench.controller.hold.active
    assert not bench.controller.monitor.keeps(second)


def test_who_holds_the_mirror_has_it_alone(bench: Bench) -> None:
    bench.degauss()
    assert state_message(bench.ask(0.01), VALUES, None).creep_held
    bench.holder = "calibration"
    bench.report()
    refused = state_message(bench.ask(0.02), VALUES, None)
    assert bench.refusal().error_code == ErrorCode.BUSY and "calibration holds it" in str(bench.refusal())
    assert not refused.creep_held and len(refused.signals)  # what it would be, and that nothing holds it
    assert bench.ask(0.02, dry_run=True).refusal is None
    bench.wait(30.0)
    assert len(bench.commands) == 1 and bench.controller.hold.active
    bench.ask(0.02, holder="calibration")
    assert bench.outcomes[-1].applied and bench.commands[-1].holder == "calibration"
    bench.ask(0.03, take_over=True)
    assert bench.outcomes[-1].applied and bench.commands[-1].take_over
    bench.holder = ""
    bench.wait(30.0)
    assert len(bench.commands) > 3 and bench.commands[-1].expected_turns


def test_applied_is_what_the_driver_confirmed(bench: Bench) -> None:
    bench.obeys = False
    first = bench.ask(0.01)
    assert not bench.outcomes and not first.applied
    bench.ask(0.02)
    assert bench.outcomes[-1].request.curvature == 0.01 and not bench.outcomes[-1].applied
    assert bench.refusal().error_code == ErrorCode.PREEMPTED
    bench.move(bench.commands[-1].signals)
    assert bench.outcomes[-1].request.curvature == 0.02 and bench.outcomes[-1].applied


def test_a_dead_driver_is_known_at_once(bench: Bench) -> None:
    bench.ask(0.01)
    bench.obeys, before = False, bench.capabilities
    bench.ask(0.01)
    bench.do(bench.controller.tick(bench.now, "pdm_driver has died"))
    assert bench.refusal().error_code == ErrorCode.DRIVER_UNAVAILABLE and "has died" in str(bench.refusal())
    assert bench.capabilities == before + 1
    message = capabilities_message(bench.controller, MIRROR, VALUES, bench.now)
    assert message.quality == Capabilities.UNCALIBRATED and message.curvature_max == 0.0
    assert message.error_code == ErrorCode.DRIVER_UNAVAILABLE and message.calibration_id == "known"
    bench.ask(0.02)
    assert bench.refusal().error_code == ErrorCode.DRIVER_UNAVAILABLE
    bench.obeys = True
    bench.report()
    bench.ask(0.02)
    assert bench.outcomes[-1].applied and bench.capabilities == before + 2


def test_a_degauss_does_not_cure_old_creep() -> None:
    bench = Bench()
    bench.degauss()
    soon = bench.ask(dry_run=True)
    bench.time += 86_400.0
    bench.report()
    later = bench.ask(dry_run=True)
    assert move_of(later).plan.max_zernike_upper < 0.3 * move_of(soon).plan.max_zernike_upper
    assert (
        "most of that for creep of shapes held before this node followed" in state_message(soon, VALUES, None).message
    )
    bench.time += 1e8
    bench.report()
    assert "most of that" not in state_message(bench.ask(0.0, dry_run=True), VALUES, None).message


def test_a_day_that_the_clock_jumps_is_no_day_of_creep_that_is_known() -> None:
    """Nor is one that it is set back, which does no harm; what a later law says of the reports keeps the doubt."""
    bench = Bench()
    bench.degauss()
    bench.time += 86_400.0
    bench.report()
    bounds = []
    for ahead in (0.0, -86_400.0, 0.0):
        bench.ahead = ahead
        bench.log.clear()
        bench.report()
        bench.report()
        bounds.append(move_of(bench.ask(dry_run=True)).plan.max_zernike_upper)
    assert bounds[1] < 1.1 * bounds[0]
    assert bounds[2] > 3.0 * bounds[0]
    assert ["the clock jumped 86400 s" in text for text in bench.log] == [True]
    bench.do(bench.controller.use(calibration("other", replace(LAW, creep_rate=0.051)), MIRROR))
    assert move_of(bench.ask(dry_run=True)).plan.max_zernike_upper > 3.0 * bounds[0]
    bench.ask()
    assert bench.outcomes[-1].applied


def test_a_check_map_that_shows_old_creep_narrows_the_bounds() -> None:
    bench = Bench()
    bench.degauss()
    bench.time += 1800.0
    bench.report()

    def bound(**fields: Any) -> float:
        if fields:
            bench.do(bench.controller.use(calibration(**fields), MIRROR))
        return move_of(bench.ask(dry_run=True)).plan.max_zernike_upper

    before = bound()
    checked = {"revision": 1, "checked": time_message(bench.now.ns), "creep_shown": 1.0}
    shown = bound(**checked)
    assert shown < 0.3 * before
    bench.time += 10.0
    assert bound(**checked, offset_drift=1e-9) == pytest.approx(shown, rel=0.1)  # published again
    assert bound(revision=0) == pytest.approx(before, rel=0.1)  # updates were dropped


def test_a_check_map_widens_the_bounds_of_later_hours_by_what_it_shows_only() -> None:
    """Old creep that it finds is in the figure and fades: little of it if the map agrees with the figure before it."""

    def later(changed: float) -> float:
        bench = Bench()
        bench.degauss()
        bench.time += 1800.0
        bench.report()
        message = calibration(revision=1, checked=time_message(bench.now.ns), creep_shown=1.0)
        message.zernike_offset[5] = changed
        bench.do(bench.controller.use(message, MIRROR))
        bench.time += 8 * 3600.0
        bench.report()
        return move_of(bench.ask(dry_run=True)).plan.max_zernike_upper

    assert later(0.0) < 0.1 * later(1e-7) < 0.1 * later(2e-7)


def test_unknown_history_is_told_and_cured_by_a_degauss() -> None:
    bench = Bench()
    still, none = np.zeros((ACTUATORS, 15)), np.zeros((ACTUATORS, 0))
    rested = CreepRecord(bench.time - 1.0, LAW.creep_time, still, np.zeros(15), none)
    bench.controller.observer.recall(rested)
    bench.report()
    before = bench.ask(dry_run=True)
    assert "moved before" in before.unknown
    published = bench.capabilities
    bench.degauss()
    bench.time += 60.0  # what the moment between record and report may have left has faded
    bench.report()
    assert bench.capabilities > published
    after = bench.ask(dry_run=True)
    assert after.unknown == ""
    assert move_of(after).plan.max_zernike_upper < 0.1 * move_of(before).plan.max_zernike_upper


def test_what_is_offered_is_what_requests_are_promised() -> None:
    bench = Bench()
    bench.do(bench.controller.use(calibration("still", replace(LAW, creep_rate=0.0)), MIRROR))
    bench.degauss()
    plan = move_of(bench.ask(dry_run=True)).plan
    offered = capabilities_message(bench.controller, MIRROR, VALUES, bench.now).error_bound
    assert plan.max_zernike_upper == pytest.approx(plan.max_zernike + offered)


def test_what_was_never_reported_is_known_no_better_than_after_the_first_report(bench: Bench) -> None:
    fresh = FocusController(VALUES)
    fresh.use(calibration(), MIRROR)
    never, _ = fresh.request(FocusRequest(curvature=0.02), bench.now, dry_run=True)
    first = Bench().ask(0.02, dry_run=True)
    assert move_of(never).plan.max_zernike_upper > 0.99 * move_of(first).plan.max_zernike_upper
    degaussed = ActuatorEstimate(None, "not reported").after_degauss(LAW, ACTUATORS, 0.0, 0.0, 0.0).state
    assert degaussed is not None and (degaussed.crept_sigma == UNSEEN).all()


def test_a_move_after_a_degauss_is_planned_as_it_will_be_made(bench: Bench) -> None:
    """Creep follows the middle while the mirror is degaussed, not the shape before."""
    bench.ask(0.02)
    bench.wait(60.0, 0.1)
    bench.history_known = False
    bench.report()
    planned = move_of(bench.ask(-0.01, time_budget=60.0))
    took = planned.duration - 0.05
    bench.time += took
    bench.do(bench.controller.degauss_answered(bench.degauss_runs[0].number, bench.now, took))
    bench.degauss()
    np.testing.assert_allclose(bench.commands[-1].signals, planned.signals, atol=2e-4)


def test_an_unknown_history_is_bounded_where_all_actuators_come_from_the_same_side() -> None:
    """As after the largest sphere, where the mirror is taken to be demagnetised."""
    weight = np.concatenate(([0.88], np.full(20, 0.019)))[:, None]
    law = HysteresisModel(np.linspace(0.0, 0.975, 21), weight, np.zeros(0), 0.0, 0.0, np.zeros(0))
    message = calibration("still", law)
    message.hysteresis.unknown_sigma = 0.04  # of such loops, over any history
    bench = Bench()
    bench.do(bench.controller.use(message, MIRROR))
    assert bench.controller.active is not None
    planner, state = bench.controller.active.planner, law.demagnetised(ACTUATORS, 0.0)
    furthest = bench.controller.active.reachable_range(FocusTarget(0.0), 2e-8)[1]
    for curvature in (furthest, 0.0):
        state = law.move(state, planner.plan(FocusTarget(curvature), state, 0.0).signals, 0.0)
    for share in (0.0, 0.2):
        target = FocusTarget(share * furthest)
        move = planner.plan(target, rested(law, state.signals, 0.0), 0.0, known=False)
        error = planner.drift(law.move(state, move.signals, 0.0), 0.0, move.effective)
        assert 0.6 * move.plan.max_zernike_upper < error < move.plan.max_zernike_upper


def test_lost_turns_make_the_history_unknown(bench: Bench) -> None:
    bench.turns += 5
    bench.move(np.full(ACTUATORS, 0.1))
    assert "turns were not seen" in bench.ask(dry_run=True).unknown


# --- a degauss on the way ---


def test_a_degauss_on_the_way(bench: Bench) -> None:
    bench.history_known = False
    bench.report()
    order = bench.ask(0.01, time_budget=60.0)
    (run,) = bench.degauss_runs
    assert order.pending and bench.commands == [] and bench.outcomes[-1].pending
    assert bench.controller.monitor.progress(order, bench.time).planning
    bench.time += 2.0
    bench.do(bench.controller.degauss_answered(run.number, bench.now, 2.0))
    assert bench.commands == []  # the report is still to come
    bench.degauss()
    assert len(bench.commands) == 1 and bench.outcomes[-1].applied and bench.outcomes[-1].unknown == ""
    assert not order.pending and bench.controller.monitor.progress(order, bench.time).reached
    active = bench.controller.active
    assert active is not None and bench.controller.conditioning.duration(0, active) == 2.0
    slower = copy(MIRROR)
    slower.slew_rate_max = 0.01 * MIRROR.slew_rate_max
    bench.do(bench.controller.use(calibration(), slower))  # what was learnt of the faster one says nothing
    active = bench.controller.active
    assert active is not None and bench.controller.conditioning.duration(0, active) > 50.0


def test_a_degauss_on_the_way_takes_the_mirror_over_where_its_request_does(bench: Bench) -> None:
    bench.history_known, bench.holder = False, "calibration"
    bench.report()
    bench.ask(0.01, time_budget=60.0)
    assert bench.refusal().error_code == ErrorCode.BUSY and not bench.degauss_runs
    bench.ask(0.01, time_budget=60.0, holder="operator", take_over=True)
    assert bench.degauss_runs[-1][2:] == ("operator", True)


def test_the_newest_request_follows_the_degauss(bench: Bench) -> None:
    bench.history_known = False
    bench.report()
    first, second = bench.ask(0.01, time_budget=60.0), bench.ask(0.02)
    assert len(bench.degauss_runs) == 1
    assert first.refusal is not None
    assert first.refusal.error_code == ErrorCode.PREEMPTED
    bench.ask(9.0)  # refused; the one before goes on waiting
    assert second.pending
    bench.degauss()
    bench.do(bench.controller.degauss_answered(bench.degauss_runs[0].number, bench.now, 0.2))
    assert [outcome.request.curvature for outcome in bench.outcomes if outcome.applied] == [0.02]


def test_a_withdrawn_order_leaves_the_mirror_degaussed(bench: Bench) -> None:
    bench.history_known = False
    bench.report()
    order = bench.ask(0.01, time_budget=60.0)
    assert bench.controller.conditioning.withdraw(order)
    assert not bench.controller.conditioning.withdraw(order)
    bench.degauss()
    bench.do(bench.controller.degauss_answered(bench.degauss_runs[0].number, bench.now, 0.2))
    assert bench.commands == [] and bench.controller.conditioning.run is None


@pytest.mark.parametrize(("cancelled", "code"), [(True, ErrorCode.CANCELED), (False, ErrorCode.PREEMPTED)])
def test_a_goal_that_ends_during_its_degauss_is_told_of(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, cancelled: bool, code: int
) -> None:
    server = SimpleNamespace(preempted=lambda _handle: bool(bench.degauss_runs) and not cancelled)
    monkeypatch.setattr(focus_actions, "WorkerActionServer", lambda *_arguments, **_fields: server)
    bench.history_known = False
    bench.report()
    handle: Any = SimpleNamespace(
        request=MoveFocus.Goal(request=FocusRequest(curvature=0.02, time_budget=60.0)), is_cancel_requested=False
    )

    def feedback(_feedback: MoveFocus.Feedback) -> None:
        handle.is_cancel_requested = cancelled and bool(bench.degauss_runs)

    handle.publish_feedback = feedback
    node: Any = SimpleNamespace(
        await_start=lambda: None,
        order=lambda request: bench.ask(request.curvature, time_budget=request.time_budget),
        answer=lambda order: state_message(order, VALUES, None),
        carry_out=lambda effects, _now: bench.do(effects),
        controller=lambda: nullcontext((bench.controller, bench.now)),
    )
    result = focus_actions.MoveFocusAction(node, VALUES)._run(handle)[1]
    assert result.error_code == result.state.error_code == code
    assert [(outcome.pending, outcome.refusal is None) for outcome in bench.outcomes] == [(True, True), (False, False)]
    assert bench.refusal().error_code == code


def test_at_rest_the_mirror_stays_and_requests_are_refused_until_the_calibration_is_used_again(bench: Bench) -> None:
    bench.ask(0.01)
    bench.history_known = False
    bench.report()
    order, commands = bench.ask(0.02, time_budget=60.0), len(bench.commands)
    assert order.pending
    bench.do(bench.controller.rest(Refusal(ErrorCode.NODE_INACTIVE, "it rests"), bench.now))
    assert bench.refusal().error_code == ErrorCode.NODE_INACTIVE and not order.pending
    bench.degauss()
    bench.do(bench.controller.degauss_answered(bench.degauss_runs[0].number, bench.now, 0.2))
    bench.wait(5.0)
    assert bench.controller.unavailable(bench.now) is not None
    bench.ask(0.02)
    assert bench.refusal().error_code == ErrorCode.NODE_INACTIVE and len(bench.commands) == commands
    bench.do(bench.controller.use(calibration(), MIRROR))
    bench.ask(0.02)
    assert bench.outcomes[-1].applied and bench.outcomes[-1].unknown == ""  # it was followed all the while


def stopped(bench: Bench) -> None:
    bench.state = ActuatorState.STATE_INACTIVE
    bench.report(message="deactivated")


def restarted(bench: Bench) -> None:
    bench.sequence = 0
    bench.report()


def silent(bench: Bench) -> None:
    bench.obeys = False
    bench.wait(4.0)


def refused(bench: Bench) -> None:
    refusal = Refusal(ErrorCode.BUSY, "conditioning: a degauss is under way")
    bench.do(bench.controller.degauss_answered(bench.degauss_runs[-1].number, bench.now, refusal=refusal))


def unanswered(bench: Bench) -> None:
    bench.wait(21.0)


def unreported(bench: Bench) -> None:
    bench.do(bench.controller.degauss_answered(bench.degauss_runs[-1].number, bench.now, 0.2))
    bench.wait(2.5)


@pytest.mark.parametrize(
    ("accident", "code", "text"),
    [
        (stopped, ErrorCode.DRIVER_UNAVAILABLE, "left its active state (deactivated)"),
        (restarted, ErrorCode.DRIVER_UNAVAILABLE, "pdm_driver was restarted"),
        (silent, ErrorCode.DRIVER_UNAVAILABLE, "has not reported"),
        (refused, ErrorCode.BUSY, "a degauss is under way"),
        (unanswered, ErrorCode.DRIVER_UNAVAILABLE, "no answer within 20 s"),
        (unreported, ErrorCode.TIMEOUT, "did not report the degauss"),
    ],
)
def test_a_degauss_that_fails_ends_the_order(
    bench: Bench, accident: Callable[[Bench], None], code: int, text: str
) -> None:
    bench.history_known = False
    bench.report()
    order = bench.ask(0.01, time_budget=60.0)
    accident(bench)
    bench.do(bench.controller.tick(bench.now))
    assert bench.refusal().error_code == code and text in str(bench.refusal())
    assert order.request is bench.outcomes[-1].request and bench.commands == []
    # An answer that comes too late counts for nothing.
    assert bench.controller.degauss_answered(bench.degauss_runs[0].number, bench.now, 0.2) == []


def test_a_recipe_follows_its_degauss(bench: Bench) -> None:
    assert bench.controller.active is not None
    tilt = bench.controller.active.mirror.tilt
    assert tilt is not None
    effective = np.random.default_rng(3).uniform(-0.4, 0.4, ACTUATORS)
    effective -= np.linalg.pinv(tilt) @ tilt @ effective  # which every recipe has as it is wanted
    recipe = Recipe(curvature=0.01, effective=doubles(effective), signals=doubles(effective), max_zernike=5e-10)
    book = RecipeBook(calibration_id="recipes", degauss_steps=60, recipes=[recipe])
    bench.do(bench.controller.use(calibration("recipes"), MIRROR, book))
    bench.ask(0.01, mode=CONDITIONED)
    assert bench.degauss_runs[-1].steps == 60
    bench.degauss()
    bench.do(bench.controller.degauss_answered(bench.degauss_runs[-1].number, bench.now, 1.0))
    assert bench.outcomes[-1].applied
    bench.time += 0.05
    assert bench.error(effective) < 1e-6
    assert health(bench.controller, VALUES, bench.now).values["conditioned"] is True
    bench.ask(0.01)
    assert health(bench.controller, VALUES, bench.now).values["conditioned"] is False


@pytest.mark.parametrize("fields", [{"curvature": np.nan}, {"curvature": 200.0}, {"zernike": [1e-7]}])
def test_recipes_of_no_surface_are_no_calibration(bench: Bench, fields: dict[str, Any]) -> None:
    nowhere = doubles(np.zeros(ACTUATORS))
    book = RecipeBook(calibration_id="known", recipes=[Recipe(effective=nowhere, signals=nowhere, **fields)])
    bench.do(bench.controller.use(calibration(), MIRROR, book))
    told = capabilities_message(bench.controller, MIRROR, VALUES, bench.now)
    assert told.error_code == ErrorCode.CALIBRATION_UNREADABLE
    assert f"recipes: {next(iter(fields))}" in told.message


# --- the driver ---


def test_a_lost_driver(bench: Bench) -> None:
    order = bench.ask(0.01)
    bench.obeys = False
    bench.wait(4.0)
    failed = bench.controller.monitor.progress(order, bench.time).failed
    assert failed is not None and failed.error_code == ErrorCode.DRIVER_UNAVAILABLE
    bench.ask(0.02)
    assert "has not reported" in str(bench.refusal())
    bench.obeys = True
    bench.report()
    bench.ask(0.02)
    assert bench.outcomes[-1].applied


def test_a_driver_that_is_not_active(bench: Bench) -> None:
    bench.ask(0.01)
    bench.state = ActuatorState.STATE_LINK_LOST
    bench.report(message="the link is lost")
    assert not bench.controller.hold.active
    bench.ask(0.02)
    assert bench.refusal().error_code == ErrorCode.ELECTRONICS_UNREACHABLE and "the link is lost" in str(
        bench.refusal()
    )


def test_a_driver_that_does_not_take_the_command(bench: Bench) -> None:
    bench.obeys = False
    order = bench.ask(0.01)
    assert not bench.outcomes
    for _ in range(8):
        bench.time += 0.5
        bench.report()
        bench.do(bench.controller.tick(bench.now))
    assert bench.refusal().error_code == ErrorCode.PREEMPTED
    assert "has not confirmed the command" in str(bench.refusal())
    assert order.request is bench.outcomes[-1].request and len(bench.outcomes) == 1
    assert not bench.controller.hold.active


def replaced(bench: Bench) -> None:
    bench.move(np.full(ACTUATORS, 0.1))


def corrected(bench: Bench) -> None:
    bench.wait(20.0)


def timeless(_bench: Bench) -> None:
    raise ClockError("ROS time did not advance")


@pytest.mark.parametrize(
    ("accident", "code"),
    [
        (stopped, ErrorCode.DRIVER_INACTIVE),
        (silent, ErrorCode.DRIVER_UNAVAILABLE),
        (replaced, ErrorCode.PREEMPTED),
        (Bench.degauss, ErrorCode.PREEMPTED),
        (corrected, ErrorCode.OK),
        (timeless, ErrorCode.TIMEOUT),
    ],
)
def test_a_shape_that_is_lost_while_it_settles_is_no_success(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, accident: Callable[[Bench], object], code: int
) -> None:
    server = SimpleNamespace(preempted=lambda _handle: False)
    monkeypatch.setattr(focus_actions, "WorkerActionServer", lambda *_arguments, **_fields: server)
    monkeypatch.setattr(focus_actions, "sleep", lambda *_arguments: accident(bench) is None)
    node: Any = SimpleNamespace(
        await_start=lambda: None,
        order=lambda request: bench.ask(request.curvature),
        answer=lambda order: state_message(order, VALUES, None),
        controller=lambda: nullcontext((bench.controller, bench.now)),
        get_clock=lambda: None,
    )
    goal = MoveFocus.Goal(request=FocusRequest(curvature=0.02))
    handle: Any = SimpleNamespace(request=goal, is_cancel_requested=False, publish_feedback=lambda _feedback: None)
    outcome, result = focus_actions.MoveFocusAction(node, VALUES)._run(handle)
    assert (outcome, result.error_code) == ("abort" if code else "succeed", code)
    assert result.state.curvature == 0.02 and result.duration >= 0.0


def test_nothing_moves_before_simulated_time_has_begun(bench: Bench) -> None:
    request, early = FocusRequest(curvature=0.01), Moment(0, 0.0, bench.time, simulated=True)
    order, effects = bench.controller.request(request, early)
    assert order.refusal is not None and order.refusal.error_code == ErrorCode.TIMEOUT
    assert "/clock" in str(order.refusal) and not any(isinstance(effect, SendCommand) for effect in effects)
    assert bench.controller.request(request, early, dry_run=True)[0].refusal is None
    told = capabilities_message(bench.controller, None, VALUES, early)
    assert (told.error_code, told.quality) == (ErrorCode.TIMEOUT, Capabilities.UNCALIBRATED)


def test_an_order_that_takes_too_long(bench: Bench) -> None:
    order = bench.ask(0.01)
    bench.report(moving=True)
    bench.time += 11.0
    bench.report(moving=True, message="the slew rate is low")
    failed = bench.controller.monitor.progress(order, bench.time).failed
    assert failed is not None and failed.error_code == ErrorCode.TIMEOUT and "slew rate" in str(failed)


# --- holding a shape ---


def test_a_held_shape_is_corrected_for_creep(bench: Bench) -> None:
    order = bench.ask(0.02)
    left_alone = bench.mirror
    bench.wait(20.0)
    corrections = bench.commands[1:]
    assert len(corrections) > 5
    # Each counts only for the shape before it.
    assert [command.expected_turns for command in corrections] == list(range(2, 2 + len(corrections)))
    effective = move_of(order).effective
    drifted = np.abs(LAW.effective(LAW.advance(left_alone, bench.time)) - effective).max()
    assert bench.error(effective) < 0.05 * drifted
    assert bench.controller.monitor.progress(order, bench.time).reached
    assert len(bench.outcomes) == 1
    bench.obeys, sent = False, len(bench.commands)
    while len(bench.commands) == sent:
        bench.time += 0.02
        bench.report()
        bench.do(bench.controller.tick(bench.now))
    under_way = bench.controller.monitor.progress(order, bench.time)
    assert not under_way.reached and under_way.failed is None
    bench.move(bench.commands[-1].signals)
    assert bench.controller.monitor.progress(order, bench.time).reached


@pytest.mark.parametrize("timeout", [3.0, 0.5])
def test_a_correction_that_is_lost_is_sent_again(timeout: float) -> None:
    bench = Bench(driver_timeout=timeout)
    bench.degauss()
    order = bench.ask(0.02)
    bench.wait(2.0)
    bench.obeys, sent, bench.written = False, len(bench.commands), bench.now.ns  # a driver stamps what it has written
    for _ in range(60):
        bench.wait(0.1)
        bench.report()
        assert bench.controller.monitor.progress(order, bench.time).failed is None
    assert len(bench.commands) > sent
    bench.obeys, bench.written = True, None
    bench.wait(3.0)
    assert bench.controller.hold.active and bench.controller.monitor.progress(order, bench.time).reached
    assert bench.error(move_of(order).effective) < 1e-4


def test_a_driver_that_refuses_corrections_is_told_of_once(bench: Bench) -> None:
    bench.ask(0.02)
    bench.wait(2.0)
    for told in (1, 2):
        bench.obeys, bench.error_code, sent = False, ErrorCode.STALE, len(bench.commands)
        while len(bench.commands) < sent + 4:
            bench.wait(0.1)
            bench.report(message="actuator_command refused: 2 s old")
            if len(bench.commands) % 2:
                bench.error_code = ErrorCode.OK  # another client's command passed
                bench.report()
                bench.error_code = ErrorCode.STALE
        text = "a correction for creep was not taken; the driver's last refusal: actuator_command refused: 2 s old"
        assert bench.log.count(text) == told
        bench.obeys, bench.error_code = True, ErrorCode.OK
        bench.wait(10.0)


def test_a_correction_that_arrives_late_is_known_again(bench: Bench) -> None:
    order = bench.ask(0.02)
    bench.wait(2.0)
    bench.obeys, sent = False, len(bench.commands)
    while len(bench.commands) == sent:
        bench.wait(0.1)
    correction = bench.commands[sent]
    bench.wait(1.5)
    assert len(bench.commands) == sent + 1
    bench.obeys = True
    bench.move(correction.signals)
    assert bench.controller.monitor.progress(order, bench.time).reached
    bench.wait(3.0)
    assert bench.controller.hold.active and bench.controller.monitor.progress(order, bench.time).reached
    assert bench.error(move_of(order).effective) < 1e-4


def test_a_correction_that_arrives_after_a_later_one_was_sent_is_known_again(bench: Bench) -> None:
    order = bench.ask(0.02)
    bench.wait(2.0)
    bench.obeys, sent = False, len(bench.commands)
    while len(bench.commands) < sent + 2:
        bench.wait(0.1)
        bench.report()
    bench.obeys = True
    bench.move(bench.commands[sent].signals)  # the driver then drops the second one, which does not count any more
    bench.wait(3.0)
    assert bench.controller.hold.active and bench.controller.monitor.progress(order, bench.time).reached
    assert bench.error(move_of(order).effective) < 1e-4


@pytest.mark.parametrize("corrected", [False, True])
def test_a_shape_is_held_where_its_command_was_long_on_its_way(bench: Bench, corrected: bool) -> None:
    if corrected:  # and a correction of the shape before it is lost
        bench.ask(0.01)
        bench.wait(0.3)
    bench.obeys, sent = False, len(bench.commands)
    bench.wait(0.2)
    assert (len(bench.commands) > sent) == corrected
    order = bench.ask(0.02)
    bench.wait(1.5)
    bench.report()  # the driver still holds the shape before
    bench.obeys = True
    bench.move(move_of(order).signals)
    bench.wait(5.0)
    assert order.applied and bench.controller.hold.active
    assert bench.error(move_of(order).effective) < 1e-4


def test_a_shape_is_held_where_its_command_was_long_on_its_way_and_an_earlier_correction_came_first() -> None:
    bench = Bench(driver_timeout=3.0)
    bench.degauss()
    bench.ask(0.02)
    correction = bench.send_correction()
    order = bench.ask(0.01)
    bench.wait(0.1)
    bench.report()  # the driver still holds the shape before the correction
    bench.move(correction.signals)
    bench.wait(1.5)
    bench.report()
    bench.move(move_of(order).signals)
    bench.obeys = True
    bench.wait(5.0)
    assert order.applied and bench.controller.hold.active
    assert bench.error(move_of(order).effective) < 1e-4


@pytest.mark.parametrize(
    ("state", "code"),
    [
        (ActuatorState.STATE_LINK_LOST, ErrorCode.ELECTRONICS_UNREACHABLE),
        (ActuatorState.STATE_INACTIVE, ErrorCode.DRIVER_INACTIVE),
        (ActuatorState.STATE_ACTIVE, ErrorCode.PREEMPTED),
    ],
)
def test_a_move_that_ends_on_its_way_is_told_of_once(bench: Bench, state: int, code: int) -> None:
    bench.obeys = False
    order = bench.ask(0.02)
    start, bench.requested = bench.signals, move_of(order).signals
    bench.report(moving=True)
    assert [outcome.applied for outcome in bench.outcomes] == [True]
    bench.signals = bench.requested = 0.5 * (start + move_of(order).signals)  # the driver stays where it is
    bench.state = state
    bench.report()
    bench.state = ActuatorState.STATE_ACTIVE
    bench.report()
    bench.wait(2.0)
    assert [outcome.applied for outcome in bench.outcomes] == [True, False] and bench.refusal().error_code == code
    assert bench.outcomes[-1].request is order.request


@pytest.mark.parametrize("lost", ["", "pdm_driver has died"])
def test_a_move_that_ends_well_while_the_driver_is_not_heard_is_told_of_again(lost: str) -> None:
    """It said that the shape was not applied, for as long as that shape stood and was held."""
    bench = Bench(driver_timeout=1.0)
    bench.degauss()
    bench.obeys = False
    order = bench.ask(0.02)
    bench.requested = move_of(order).signals
    bench.report(moving=True)
    bench.do(bench.controller.tick(bench.now, lost))
    bench.wait(1.5)
    assert [outcome.applied for outcome in bench.outcomes] == [True, False]
    assert bench.refusal().error_code == ErrorCode.DRIVER_UNAVAILABLE
    bench.obeys = True
    bench.move(move_of(order).signals)
    bench.wait(3.0)
    assert [outcome.applied for outcome in bench.outcomes] == [True, False, True]
    assert bench.outcomes[-1].refusal is None and bench.controller.hold.active


def test_a_move_that_is_cancelled_on_its_way_is_told_of_once(bench: Bench) -> None:
    bench.obeys = False
    order = bench.ask(0.02)
    bench.requested = move_of(order).signals
    bench.report(moving=True)
    bench.do(bench.controller.stop(order, bench.now) or [])
    bench.move(bench.commands[-1].signals)
    bench.wait(2.0)
    assert [outcome.applied for outcome in bench.outcomes] == [True, False]
    assert bench.refusal().error_code == ErrorCode.CANCELED and bench.outcomes[-1].request is order.request


def test_a_request_for_the_shape_that_stands_is_told_of_once_where_the_link_is_lost(bench: Bench) -> None:
    bench.obeys = False
    order = bench.ask(0.0)
    assert (move_of(order).signals == bench.requested).all()
    bench.state = ActuatorState.STATE_LINK_LOST  # the driver refuses the command, and stands where it is
    bench.report()
    bench.wait(4.0)
    assert len(bench.outcomes) == 1 and bench.refusal().error_code == ErrorCode.ELECTRONICS_UNREACHABLE


def test_a_driver_that_dies_on_the_way_is_told_of_with_the_request(bench: Bench) -> None:
    bench.obeys = False
    order = bench.ask(0.02)
    bench.requested = move_of(order).signals
    bench.report(moving=True)
    bench.do(bench.controller.tick(bench.now, "pdm_driver is not heard any more"))
    assert bench.refusal().error_code == ErrorCode.DRIVER_UNAVAILABLE and bench.outcomes[-1].request is order.request


def test_a_shape_that_stood_is_left_without_a_word(bench: Bench) -> None:
    bench.ask(0.02)
    bench.move(np.full(ACTUATORS, 0.1))  # somebody else
    bench.wait(2.0)
    assert [outcome.applied for outcome in bench.outcomes] == [True]


def test_a_request_that_fails_leaves_the_shape_that_stands_held(bench: Bench) -> None:
    bench.history_known = False
    bench.report()
    order = bench.ask(0.02)
    bench.wait(1.0)
    bench.ask(0.01, time_budget=60.0)
    sent = len(bench.commands)
    bench.wait(5.0)
    assert len(bench.commands) == sent  # a correction would end the degauss
    refused(bench)
    bench.wait(5.0)
    assert len(bench.commands) > sent and bench.error(move_of(order).effective) < 1e-4
    bench.obeys = False
    bench.ask(0.01)
    bench.obeys = True
    bench.wait(5.0)
    assert bench.refusal().error_code == ErrorCode.PREEMPTED and bench.outcomes[-1].request.curvature == 0.01
    assert bench.error(move_of(order).effective) < 1e-4
    values = health(bench.controller, VALUES, bench.now).values
    assert (values["curvature"], values["held"]) == (0.02, True)


def test_a_request_that_fails_while_a_correction_is_on_its_way_leaves_the_shape_held(bench: Bench) -> None:
    order = bench.ask(0.02)
    correction = bench.send_correction()
    bench.ask(0.01)
    bench.obeys = True
    bench.move(correction.signals)  # the driver takes the correction, and not the request
    bench.wait(6.0)
    assert bench.refusal().error_code == ErrorCode.PREEMPTED
    assert bench.controller.monitor.order is order and bench.controller.hold.active
    assert bench.error(move_of(order).effective) < 1e-4


def test_a_request_that_the_driver_refuses_while_a_correction_is_lost_leaves_the_shape_held(bench: Bench) -> None:
    order = bench.ask(0.02)
    bench.send_correction()
    bench.ask(0.01)  # takes the place of the correction, and is refused
    bench.error_code = ErrorCode.STALE
    bench.obeys = True
    bench.wait(6.0)
    assert bench.outcomes[-1].request.curvature == 0.01 and bench.refusal().error_code == ErrorCode.STALE
    assert bench.controller.monitor.order is order and bench.controller.hold.active
    assert bench.error(move_of(order).effective) < 1e-4


def test_a_clock_that_jumps_while_a_command_is_on_its_way_leaves_its_shape_held(bench: Bench) -> None:
    """As does simulated time that runs fast: how long the driver may take is a matter of the steady clock."""
    bench.obeys = False
    order = bench.ask(0.02)
    bench.ahead = 2.0
    bench.report()
    bench.obeys = True
    bench.move(move_of(order).signals)
    assert bench.controller.hold.active


def test_a_correction_never_undoes_the_command_of_another(bench: Bench) -> None:
    bench.ask(0.02)
    shape = np.full(ACTUATORS, 0.1)
    # It reaches the driver first; its report is on the way when the correction goes out.
    bench.time += 0.5
    report = bench.controller.driver_report
    bench.controller.driver_report = lambda *_: []  # type: ignore[method-assign]
    bench.move(shape)
    bench.do(bench.controller.tick(bench.now))
    bench.controller.driver_report = report  # type: ignore[method-assign]
    assert bench.commands[-1].expected_turns == bench.turns - 1
    assert (bench.signals == shape).all()
    bench.wait(3.0)
    assert (bench.signals == shape).all() and not bench.controller.hold.active
    bench.wait(5.0)
    assert not any("not confirmed" in line for line in bench.log), "it is no trouble"


def test_the_command_of_another_is_noticed_while_a_correction_is_on_its_way(bench: Bench) -> None:
    """Else a cancel of the move would undo it."""
    order = bench.ask(0.02)
    bench.send_correction()
    bench.report()
    assert bench.controller.monitor.progress(order, bench.time).failed is None
    bench.move(np.full(ACTUATORS, 0.1))  # the driver then drops the correction
    failed = bench.controller.monitor.progress(order, bench.time).failed
    assert failed is not None and failed.error_code == ErrorCode.PREEMPTED


def test_a_new_calibration_while_a_shape_is_held(bench: Bench) -> None:
    bench.ask(0.02)
    bench.do(bench.controller.use(calibration(revision=2), MIRROR))
    assert bench.controller.hold.active  # the same calibration, improved by a map
    assert bench.controller.observer.unknown == ""
    bench.do(bench.controller.use(calibration("another"), MIRROR))
    assert not bench.controller.hold.active and "another calibration" in bench.controller.hold.ended
    assert bench.controller.observer.unknown == ""  # what was reported is followed under the new law, too
    sent = len(bench.commands)
    bench.wait(5.0)
    assert len(bench.commands) == sent
    bench.ask(0.01)
    assert bench.outcomes[-1].applied


@pytest.mark.parametrize(
    ("message", "code"),
    [
        (None, ErrorCode.NOT_CALIBRATED),
        (calibration(), ErrorCode.CALIBRATION_MISMATCH),
        (calibration(), ErrorCode.CALIBRATION_UNREADABLE),
    ],
)
def test_a_calibration_that_cannot_be_used_ends_the_hold(bench: Bench, message: Any, code: int) -> None:
    if code == ErrorCode.CALIBRATION_MISMATCH:
        message.mirror_serial = "M2"
    elif message is not None:
        message.hysteresis.creep_rate = 3.0
    bench.ask(0.02)
    bench.do(bench.controller.use(message, MIRROR))
    assert not bench.controller.hold.active
    assert len(bench.log) == 2 and "calibration" in bench.log[-1]  # using one, and why no more
    bench.ask(0.01)
    assert bench.refusal().error_code == code


def test_health_says_what_stands_as_long_as_it_does() -> None:
    bench = Bench()
    assert "curvature" not in health(bench.controller, VALUES, bench.now).values
    bench.ask(0.02)
    bench.wait(40.0)
    values = health(bench.controller, VALUES, bench.now).values
    assert (values["curvature"], values["held"]) == (0.02, True) and bench.controller.hold.corrections
    assert float(str(values["age"])) == pytest.approx(40.0, abs=0.1) and 0.0 < float(str(values["bound"])) < 3e-6
    bench.degauss()
    assert "curvature" not in health(bench.controller, VALUES, bench.now).values


def test_health_says_what_stands_while_a_correction_is_on_its_way(bench: Bench) -> None:
    bench.ask(0.02)
    bench.wait(1.0)
    order = bench.controller.monitor.order
    assert order is not None and order.command is not None and order.command.confirmed
    for _ in range(2):  # the driver has reported neither yet
        order.send(order.command.signals + 1e-4, bench.now)
        assert health(bench.controller, VALUES, bench.now).values["curvature"] == 0.02
    bench.move(np.full(ACTUATORS, 0.1))  # somebody else
    assert "curvature" not in health(bench.controller, VALUES, bench.now).values


def test_health_tells_what_is_predicted_of_a_shape_apart_from_what_is_promised_beyond(bench: Bench) -> None:
    bench.do(bench.controller.use(calibration("straight", HysteresisModel.linear()), MIRROR))
    assert bench.controller.active is not None
    order = bench.ask(bench.controller.active.reachable_range(FocusTarget(0.0), VALUES["reachable_tolerance"])[1])
    bench.wait(1.0)
    values, plan = health(bench.controller, VALUES, bench.now).values, move_of(order).plan
    assert values["predicted"] == plan.max_zernike > 1e-8
    assert float(str(values["bound"])) == pytest.approx(plan.max_zernike_upper, rel=1e-3)


def test_the_bound_of_what_stands_follows_the_calibration(bench: Bench) -> None:
    def bound(message: Calibration) -> float:
        bench.do(bench.controller.use(message, MIRROR))
        bench.wait(1.0)
        return float(str(health(bench.controller, VALUES, bench.now).values["bound"]))

    bench.time += 3e7
    bench.report()
    bench.ask(0.02)
    bench.wait(1.0)
    before, erring, bent, figure = bound(calibration()), calibration(), calibration(), np.zeros(21)
    erring.hysteresis.held_out_max_zernike = 60e-9
    assert bound(erring) > 1.4 * 60e-9
    figure[4] = 30e-9
    bent.zernike_offset = doubles(figure)
    bent.sag_offset = doubles(basis(np.asarray(bent.sample_x), np.asarray(bent.sample_y)) @ figure)
    assert bound(bent) == pytest.approx(before + 30e-9, rel=1e-3)


def test_the_bound_holds_where_nothing_holds_the_shape() -> None:
    """With the law known in full; what is held keeps the bound of the plan."""
    states = []
    for held in (True, False):
        bench = Bench(**{"hold.enable": held})
        bench.degauss()
        bench.time += 3e7
        bench.report()
        bench.mirror = LAW.advance(bench.mirror, bench.time)
        order = bench.ask(0.02)
        states.append(state_message(order, VALUES, None))
    assert bench.controller.active is not None and [state.creep_held for state in states] == [True, False]
    planner, plan = bench.controller.active.planner, move_of(order).plan
    assert states[0].predicted_max_zernike_upper == plan.max_zernike_upper
    assert states[0].predicted_rms_upper == plan.rms_upper < states[1].predicted_rms_upper
    assert states[1].message.endswith("most of that for creep, which nothing corrects")
    for age in (999.0, 3600.0):
        bench.wait(age, 10.0)
        error = planner.drift(bench.mirror, bench.time, move_of(order).effective)
        bound = float(str(health(bench.controller, VALUES, bench.now).values["bound"]))
        assert bound == pytest.approx(error + plan.max_zernike_upper, rel=1e-3)
        if age < 1000.0:
            assert plan.max_zernike_upper < error < states[1].predicted_max_zernike_upper < 1.1 * bound


@pytest.mark.slow
def test_a_shape_written_again_after_a_lost_link_is_told_with_the_bound_of_an_unknown_history() -> None:
    bench = Bench()
    bench.degauss()
    bench.ask(0.02)
    bound = float(str(health(bench.controller, VALUES, bench.now).values["bound"]))
    bench.history_known, bench.state = False, ActuatorState.STATE_LINK_LOST
    bench.report()
    bench.wait(600.0)
    bench.state = ActuatorState.STATE_ACTIVE
    bench.report()
    values = health(bench.controller, VALUES, bench.now).values
    assert (values["curvature"], values["held"]) == (0.02, False)
    assert bench.controller.active is not None
    assert float(str(values["bound"])) > max(bound, bench.controller.active.planner.error_bound(False, 0.0))
