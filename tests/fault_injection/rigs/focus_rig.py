"""A real `focus_controller` process in front of a driver rig, with a calibration and an interferometer played here.

The calibration is that of an analytic plate whose hysteresis was identified on the simulation's actuators. The
interferometer answers at once with the surface which that plate has under the signals at the emulated electronics.
"""

from __future__ import annotations

import signal
import time
from collections import deque
from pathlib import Path
from random import Random
from typing import Any, Self

import numpy as np
import yaml
from dm_msgs.action import Converge, MoveFocus
from dm_msgs.msg import (
    Calibration,
    Capabilities,
    ErrorCode,
    FocusRequest,
    FocusState,
    MirrorInfo,
)
from dm_msgs.msg import RecipeBook as RecipeBookMsg
from dm_msgs.srv import Flatten, Measure, SetFocus
from numpy.typing import ArrayLike
from rclpy.qos import QoSProfile

from dm_bringup.nodes import MODULES
from dm_common.messages import doubles, mirror_from, recipe_book_message
from dm_common.recipes import Recipe, RecipeBook
from dm_common.ros import qos
from dm_common.ros.clients import ThreadedActionClient
from dm_common.ros.worker import WorkerService
from dm_controller.planning.mirror_model import CalibratedMirror
from dm_controller.planning.target import FocusTarget
from fault_injection.fault import FaultRecord
from fault_injection.rigs.common_steps import overtaken, same_shape
from fault_injection.rigs.driver_rig import SERIAL, DriverRig, RigError, end_process
from fault_injection.rigs.forked_node import Process
from studies.benchmarks import stand_in_mirror

LAW = "Prandtl-Ishlinskii"
#: Curvatures asked for lie within ± this, 1/m; two in a row differ by at least the other.
REACH, LEAST_CHANGE = 0.02, 0.004
#: Half-swings of a degauss, few: faults are to meet it on its way.
DEGAUSS_STEPS = 8
#: The controller's own time-outs, short enough for a run; s.
DRIVER_TIMEOUT_S = 2.0
#: Answers wait for nothing but their turn: without one in this time the request counts as not answered.
ANSWER_S = 20.0
#: What the interferometer of the rig measures beside the plate: its surface answers more weakly than calibrated.
GAIN = 0.85


class FocusRig(DriverRig):
    """Driver and focus controller as processes. Use as a context manager.

    Args:
        folder: for files and logs.
        domain: ROS domain.
        changes: parameters of the controller.
    """

    def __init__(self, folder: Path, domain: int, **changes: Any) -> None:
        super().__init__(folder, domain, degauss__steps=DEGAUSS_STEPS)
        values = {
            "driver_timeout": DRIVER_TIMEOUT_S,
            "converge.settle_time": 0.02,
            "converge.driver_timeout": 5.0,
            **{name.replace("__", "."): value for name, value in changes.items()},
        }
        self._controller_parameters = folder / "controller.yaml"
        self._controller_parameters.write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}))
        self.controller: Process | None = None
        self.focus_states: deque[FocusState] = deque(maxlen=50_000)
        self.domain = domain
        self.capabilities: list[Capabilities] = []
        self._infos: list[MirrorInfo] = []
        self._curvature = 0.0

    def __enter__(self) -> Self:
        super().__enter__()
        try:
            return self._begun()
        except BaseException:
            self.__exit__()
            raise

    def _begun(self) -> Self:
        node = self.node
        node.create_subscription(MirrorInfo, "mirror_info", self._infos.append, qos.LATCHED)
        node.create_subscription(Capabilities, "capabilities", self._on_capabilities, qos.LATCHED)
        # Deep: not one of the answers to a hundred clients may be overlooked here.
        node.create_subscription(
            FocusState, "focus_state", lambda m: self.focus_states.append(m), QoSProfile(depth=5000)
        )
        self.request = node.create_publisher(FocusRequest, "focus_request", qos.COMMAND)
        self._clients |= {
            SetFocus: node.create_client(SetFocus, "set_focus"),
            Flatten: node.create_client(Flatten, "flatten"),
        }
        self.actions = {
            kind: ThreadedActionClient(node, kind, name)
            for kind, name in ((MoveFocus, "move_focus"), (Converge, "converge"))
        }
        WorkerService(node, Measure, "measure", self._on_measure)
        self._model = stand_in_mirror.influence_model()
        self._publisher_of_calibration: Any = None
        self._publisher_of_recipes = node.create_publisher(RecipeBookMsg, "recipes", qos.LATCHED)
        self.start_controller()
        self.wait(lambda: self._infos, "mirror_info")
        self.calibrate()
        self.wait(
            lambda: all(client.server_is_ready() for client in self.actions.values()),
            "the controller's actions",
        )
        return self

    def __exit__(self, *exception: object) -> None:
        self.kill_controller(signal.SIGINT)
        super().__exit__(*exception)

    # The controller as a process

    def start_controller(self) -> None:
        """Start the controller."""
        assert self.controller is None
        self.controller = self._start(
            MODULES["focus_controller"], self._controller_parameters, self.folder / "controller.log"
        )

    def kill_controller(self, number: int = signal.SIGKILL) -> None:
        """End the controller by a signal."""
        process, self.controller = self.controller, None
        if process is not None:
            end_process(process, number, "the focus controller")

    # Calibration and maps

    def _on_capabilities(self, message: Capabilities) -> None:
        self.capabilities.append(message)
        del self.capabilities[:-100]

    def calibration(self, **fields: Any) -> Calibration:
        """A calibration with memory."""
        message = stand_in_mirror.calibration(LAW, SERIAL)
        message.header.stamp = self.node.get_clock().now().to_msg()
        for name, value in fields.items():
            setattr(message, name, value)
        return message

    def publish_calibration(self, message: Calibration) -> None:
        """Publish it, latched, in place of the last."""
        if self._publisher_of_calibration is None:
            self._publisher_of_calibration = self.node.create_publisher(Calibration, "calibration", qos.LATCHED)
        self._publisher_of_calibration.publish(message)

    def withdraw_calibration(self) -> None:
        """The calibration's publisher goes, and with it what was latched."""
        self.node.destroy_publisher(self._publisher_of_calibration)
        self._publisher_of_calibration = None

    def calibrate(self) -> None:
        """Have the controller take a calibration, and recipes of the mirror that the driver announces."""
        message = self.calibration()
        mirror = CalibratedMirror(self._model, mirror_from(self._infos[-1]).limits)
        plans = {c: mirror.plan(FocusTarget(c)).signals for c in np.linspace(-1.2 * REACH, 1.2 * REACH, 5).tolist()}
        recipes = tuple(Recipe(c, 0.0, signals, signals, 1e-9, 1e-9, 3) for c, signals in plans.items())
        book = RecipeBook(recipes, DEGAUSS_STEPS, 1e-9)
        self._publisher_of_recipes.publish(recipe_book_message(book, message.id))
        self.publish_calibration(message)
        self.wait(
            lambda: self.capabilities and self.capabilities[-1].quality == Capabilities.CALIBRATED,
            "the controller's calibration",
        )

    def _on_measure(self, request: Measure.Request, response: Measure.Response) -> Measure.Response:
        model, signals = self._model, GAIN * self.signals
        coefficients = model.zernike_offset + model.influence_zernike @ signals
        response.zernike.coefficients = doubles(coefficients)
        response.zernike.radius = model.aperture_radius
        response.info.valid_fraction = 1.0
        samples = response.samples
        samples.x, samples.y, samples.weight = (
            doubles(values) for values in (model.points.x, model.points.y, model.points.weight)
        )
        samples.sag = doubles(model.sag_offset + model.influence_sag @ signals)
        response.zernike.header.stamp = self.node.get_clock().now().to_msg()
        return response

    # Requests

    def curvature(self, random: Random) -> float:
        """1/m, within reach and well apart from the last one."""
        while True:
            curvature = random.uniform(-REACH, REACH)
            if abs(curvature - self._curvature) >= LEAST_CHANGE:
                self._curvature = curvature
                return curvature

    def far_curvature(self, random: Random) -> float:
        """1/m, so far from the last one that the way takes many frames."""
        side = -1.0 if self._curvature > 0.0 else 1.0
        self._curvature = side * random.uniform(0.7 * REACH, REACH)
        return self._curvature

    def set_focus(self, curvature: float, **fields: Any) -> FocusState:
        """The answer of the service; `fields` of the request.

        Raises:
            RigError: there is none.
        """
        request = FocusRequest(curvature=curvature, **fields)
        future = self.begin(SetFocus, SetFocus.Request(request=request))
        self.wait(future.done, "the controller's answer", ANSWER_S)
        return future.result().state

    def ask(self, curvature: float, **fields: Any) -> None:
        """Publish a request."""
        message = FocusRequest(curvature=curvature, **fields)
        message.header.stamp = self.node.get_clock().now().to_msg()
        self.request.publish(message)

    def goal(self, kind: Any, goal: Any) -> tuple[Any, Any]:
        """Send a goal of an action; returns its handle and the future of its result.

        Raises:
            RigError: no answer.
        """
        client = self.actions[kind]
        accepted = client.send_goal_async(goal)
        self.wait(accepted.done, f"the acceptance by {kind.__name__}", ANSWER_S)
        handle = accepted.result()
        return handle, handle.get_result_async()

    def near(self, signals: ArrayLike) -> bool:
        """Whether the actuators stand in this shape, but for corrections of creep."""
        return same_shape(self.signals, signals)

    def states_of(self, curvature: float) -> list[FocusState]:
        """All that `focus_state` said of the request of just this curvature."""
        return [state for state in list(self.focus_states) if state.curvature == curvature]

    def account_for(self, state: FocusState, record: FaultRecord, patience_s: float = 20.0, loop: bool = False) -> None:
        """Count a request as lost that was accepted with `state` and neither is carried out nor told of as failed.

        Args:
            loop: one begins, and its commands replace those of a request that came just before it held the mirror.
        """

        def settled() -> bool:
            told = self.states_of(state.curvature)
            refused = any(answer.error_code != ErrorCode.OK for answer in told)
            newest = told[-1] if told else state  # after a degauss, a request is planned anew, from what is known then
            return refused or self.near(newest.signals) or (loop and overtaken(list(self.states), state))

        if state.error_code != ErrorCode.OK:
            if not state.message:
                record.lost += 1
                record.remarks.append(f"refused without a word: error code {state.error_code}")
            return
        try:
            self.wait(settled, "the request to be carried out or told of", patience_s)
        except RigError:
            record.lost += 1
            off = np.abs([self.signals, self.states[-1].requested] - np.asarray(state.signals)).max(axis=1).round(3)
            remark = f"accepted, {state.curvature:+.5f} 1/m: neither carried out nor told of; off by {off}"
            record.remarks.append(f"{remark}, driver: {self.states[-1].message}")

    def refocus(self, random: Random) -> float:
        """Ask for a shape until it stands; the seconds that took.

        Raises:
            RigError: not within PATIENCE_S.
        """
        begun = time.monotonic()

        def applied() -> bool:
            if not self._clients[SetFocus].service_is_ready():
                return False
            request = SetFocus.Request(request=FocusRequest(curvature=self.curvature(random)))
            future = self._clients[SetFocus].call_async(request)
            try:
                self.wait(future.done, "an answer", 5.0)
                state = future.result().state
                if state.error_code != ErrorCode.OK:
                    time.sleep(0.05)
                    return False
                self.wait(lambda: self.near(state.signals), "the shape", 5.0)
            except RigError:
                self._clients[SetFocus].remove_pending_request(future)
                return False
            return True

        self.wait(applied, "a request that is carried out")
        return time.monotonic() - begun
