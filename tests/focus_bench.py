"""The neighbours of the focus controller, played by the test: calibration, driver, and a mirror that is known exactly.

`Bench` has a driver that follows at once and a mirror without hysteresis; `HysteresisBench` has one with it.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from dm_msgs.action import Degauss
from dm_msgs.msg import (
    ActuatorCommand,
    ActuatorHysteresis,
    ActuatorState,
    Calibration,
    Capabilities,
    FocusRequest,
    FocusState,
    MirrorInfo,
)
from dm_msgs.msg import RecipeBook as RecipeBookMsg
from dm_msgs.srv import SetFocus
from numpy.typing import NDArray

from dm_common.errors import ErrorCode
from dm_common.hysteresis.law_shape import normalised
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel, HysteresisState
from dm_common.messages import doubles, mirror_info_of, recipe_book_message, time_message
from dm_common.recipes import Recipe, RecipeBook
from dm_common.ros import qos
from dm_common.ros.worker import WorkerActionServer
from linear_mirror import RADIUS, LinearMirror, hexagon, make_mirror
from support import NodeProcess, Observer, wait_until

MIRROR = LinearMirror(*hexagon())
SLEW_RATE = 40.0
REPORT_PERIOD = 0.5


def mirror_info(serial: str = "T-1") -> MirrorInfo:
    return mirror_info_of(make_mirror(serial=serial), full_aperture_diameter=0.03, slew_rate_max=SLEW_RATE)


def calibration(serial: str = "T-1", radius: float = RADIUS, **fields: Any) -> Calibration:
    points = MIRROR.points
    message = Calibration(
        id="known",
        mirror_serial=serial,
        aperture_radius=radius,
        actuators=37,
        influence_zernike=MIRROR.fit_terms(MIRROR.influence.T).T.ravel().tolist(),
        zernike_offset=MIRROR.figure_coefficients.tolist(),
        sample_x=points.x.tolist(),
        sample_y=points.y.tolist(),
        sample_weight=points.weight.tolist(),
        influence_sag=MIRROR.influence.ravel().tolist(),
        sag_offset=(MIRROR.modes @ MIRROR.figure_coefficients).tolist(),
        held_out_rms=2e-10,
        held_out_max_zernike=3e-10,
        maps_used=100,
        quality=Capabilities.CALIBRATED,
    )
    for name, value in fields.items():
        setattr(message, name, value)
    return message


class Bench:
    """The controller under test with the stand-ins of its neighbours."""

    def __init__(self, observer: Observer, follow: bool = True) -> None:
        self.observer = observer
        node = observer.node
        self.info = node.create_publisher(MirrorInfo, "mirror_info", qos.LATCHED)
        self.calibration = node.create_publisher(Calibration, "calibration", qos.LATCHED)
        self.recipes = node.create_publisher(RecipeBookMsg, "recipes", qos.LATCHED)
        self.state = node.create_publisher(ActuatorState, "actuator_state", qos.STATE)
        self.request = node.create_publisher(FocusRequest, "focus_request", qos.COMMAND)
        self.commands: list[ActuatorCommand] = []
        self.follow = follow
        self._report: ActuatorState | None = None
        node.create_timer(REPORT_PERIOD, lambda: self._report and self.state.publish(self._report))
        node.create_subscription(ActuatorCommand, "actuator_command", self._on_command, qos.COMMAND)
        self.focus_states = observer.record(FocusState, "focus_state", qos.STATE)
        self.capabilities: list[Capabilities] = observer.record(Capabilities, "capabilities", qos.LATCHED)

    def _on_command(self, command: ActuatorCommand) -> None:
        self.commands.append(command)
        if self.follow:
            self.publish_state(list(command.signals))

    def publish_state(self, applied: list[float], state: int = ActuatorState.STATE_ACTIVE) -> None:
        self.report(ActuatorState(driver_state=state, requested=applied, applied=applied, history_known=True))

    def report(self, message: ActuatorState) -> None:
        """Publish it, and again from time to time."""
        self._report = message
        self.state.publish(message)

    def ready(self, message: Calibration | None = None) -> Bench:
        """Mirror, calibration and an active driver are known to the controller."""
        self.info.publish(mirror_info())
        self.calibration.publish(message or calibration())
        wait_until(lambda: self.capabilities and self.capabilities[-1].calibration_id == "known", 60)
        self.activate()
        # A request must not overtake the driver's first report.
        wait_until(lambda: self.capabilities[-1].error_code == ErrorCode.OK, 60)
        return self

    def fall_silent(self) -> None:
        """The driver reports no more, until it is activated."""
        self._report, self.follow = None, False

    def activate(self) -> None:
        wait_until(lambda: self.state.get_subscription_count() > 0)
        self.publish_state([0.0] * 37)

    def set_focus(self, dry_run: bool = False, **fields: Any) -> Any:
        return self.observer.call(
            SetFocus, "set_focus", SetFocus.Request(request=FocusRequest(**fields), dry_run=dry_run)
        )


def make_law(creep_rate: float = 0.01) -> HysteresisModel:
    """Ten per cent of hysteresis, and creep."""
    radius = np.array([0.0, 0.2, 0.5])
    weight = np.array([[0.8], [0.1], [0.1]])
    none = np.zeros(0)
    law = HysteresisModel(radius, weight, none, 0.0, creep_rate, CREEP_TIMES)
    return normalised(law)


def hysteresis_message(law: HysteresisModel) -> ActuatorHysteresis:
    return ActuatorHysteresis(
        law="known",
        play_radius=doubles(law.play_radius),
        powers=law.play_weight.shape[-1],
        play_weight=doubles(law.play_weight),
        creep_rate=law.creep_rate,
        creep_time=doubles(law.creep_time),
        held_out_max_zernike=1e-9,
        unknown_sigma=0.05,
    )


def recipe(curvature: float, effective: NDArray[np.float64]) -> Recipe:
    return Recipe(curvature, 0.0, effective, effective, max_zernike=5e-10, rms=2e-9, maps=4)


def recipe_book(*recipes: Recipe) -> RecipeBookMsg:
    """Of the calibration here; recipes that begin with a degauss of 60 half-swings."""
    return recipe_book_message(RecipeBook(recipes, 60, 1e-10), "known")


def calibration_with_history(law: HysteresisModel, **fields: Any) -> Calibration:
    """With the law of hysteresis `law`."""
    return calibration(hysteresis=hysteresis_message(law), **fields)


class HysteresisBench(Bench):
    """A driver that counts turns and degausses as the real one does, before a mirror that follows `law`.

    Attributes:
        degauss_may_end: while it is clear, a degauss goes on.
        begun: half-swings asked for, a value for each degauss.
        reached: the state after each command.
        controller: under test, where it is to be stopped.
    """

    def __init__(self, observer: Observer, law: HysteresisModel | None = None) -> None:
        super().__init__(observer)
        self.law = law or make_law()
        self.mirror = self.law.demagnetised(37, self._now())
        self.turns, self.turned_at, self.degausses, self.known = 0, [0.0] * 37, 0, False
        self.degauss_may_end = threading.Event()
        self.degauss_may_end.set()
        self.begun: list[int] = []
        self.controller: NodeProcess | None = None
        self.reached: list[HysteresisState] = []
        self.other = observer.node.create_publisher(ActuatorCommand, "actuator_command", qos.COMMAND)
        WorkerActionServer(observer.node, Degauss, "degauss", self._on_degauss)

    def _now(self) -> float:
        return 1e-9 * float(self.observer.node.get_clock().now().nanoseconds)

    def publish_state(
        self, applied: list[float], state: int = ActuatorState.STATE_ACTIVE, moving: bool = False
    ) -> None:
        """Go to `applied`, within the time that it takes, and report it."""
        signals, when = np.array(applied), self._now()
        if not moving:
            when += float(np.abs(signals - self.mirror.signals).max()) / SLEW_RATE
            self.mirror = self.law.move(self.mirror, signals, when)
        message = ActuatorState(driver_state=state, requested=applied, applied=applied, history_known=self.known)
        message.moving, message.degausses = moving, self.degausses
        message.turns, message.turned_at = self.turns, self.turned_at
        message.header.stamp = time_message(round(1e9 * when))
        self.report(message)

    def _on_command(self, command: ActuatorCommand) -> None:
        if command.expected_turns not in (0, self.turns):
            return  # as the driver: it was meant for another shape than the one that stands
        self.turns, self.turned_at = self.turns + 1, list(command.signals)
        super()._on_command(command)
        self.reached.append(self.mirror)

    def _on_degauss(self, handle: Any) -> tuple[str, Degauss.Result]:
        self.begun.append(handle.request.steps)
        self.known = False
        self.publish_state([0.0] * 37, moving=True)
        assert self.degauss_may_end.wait(20.0)
        self.mirror = self.law.degaussed(self.mirror, self._now())
        self.degausses, self.known = self.degausses + 1, True
        self.turns, self.turned_at = self.turns + 1, [0.0] * 37
        self.publish_state([0.0] * 37)
        return "succeed", Degauss.Result(duration=0.2)

    def command(self, signals: NDArray[np.float64]) -> None:
        """A command of another publisher, carried out."""
        count = len(self.commands)
        self.other.publish(ActuatorCommand(signals=doubles(signals)))
        wait_until(lambda: len(self.commands) > count)

    def surface_error(self, curvature: float, state: HysteresisState | None = None, age: float | None = None) -> float:
        """Largest coefficient error beyond tilt, m.

        Args:
            curvature: 1/m, that should be.
            state: of the mirror; None = the present one.
            age: s after the move to that state; None = now.
        """
        state = state or self.mirror
        time = self._now() if age is None else state.time + age
        effective = self.law.effective(self.law.advance(state, time))
        radius = RADIUS * np.hypot(MIRROR.points.x, MIRROR.points.y)
        error = MIRROR.fit_terms(MIRROR.sag(effective) - curvature * radius**2 / 2)
        return float(np.abs(error[3:]).max())
