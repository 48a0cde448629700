"""Lifecycle nodes, and the health of a node on `/diagnostics` (the Python diagnostic_updater is not on PyPI)."""

import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from dm_common.errors import ErrorCode, Refusal
from dm_common.ros.executor import ResendingActionServer, spin_once
from dm_common.ros.parameters import Parameter, declare

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR
#: How often health is published, s.
PERIOD_S = 1.0
#: When a node ends: longest wait for the ends of its goals, and time to send their results, s.
GOALS_END_S, RESULTS_S = 1.0, 0.1


@dataclass
class Health:
    """One status: a level (OK, WARN, ERROR, STALE), a line for a person, and figures."""

    level: bytes = OK
    message: str = "ok"
    values: Mapping[str, object] = field(default_factory=dict)


class Diagnostics:
    """Publish `check()` on `/diagnostics` once a second of wall time, whatever ROS time does."""

    def __init__(self, node: Node, hardware_id: str, check: Callable[[], Health]) -> None:
        self._node = node
        self._check = check
        self.hardware_id = hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._timer = node.create_timer(PERIOD_S, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        """Publish now."""
        health = self._check()
        status = DiagnosticStatus(
            level=health.level,
            name=self._node.get_fully_qualified_name().lstrip("/"),
            message=health.message,
            hardware_id=self.hardware_id,
            values=[KeyValue(key=str(key), value=str(value)) for key, value in health.values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


class ManagedNode(LifecycleNode):
    """A lifecycle node that configures and activates itself, unless its parameter `autostart` is false.

    Subclasses define the transitions in `configure`, `activate`, `deactivate` and `clean_up`. The first two raise
    ValueError if the parameters are not acceptable: the node then keeps its state, says why, and accepts other values.

    Args:
        name, keywords: of the node.
        table, on_change, check: of its parameters, see `parameters.declare`.
        hardware_id: shown in its diagnostics.

    Attributes:
        configured, active: its state.
        trouble: why the last transition failed; "" = it did not.
        session: if it `requires_activation`, changes with every (de)activation, which makes earlier goals invalid.
    """

    #: True: parameters that are not live change only while the node is inactive, and requests are then refused with
    #: NODE_INACTIVE. False: they change only while it is not configured, and the node judges requests by itself.
    requires_activation = True

    def __init__(
        self,
        name: str,
        table: Sequence[Parameter],
        on_change: Callable[[Mapping[str, Any]], None] | None = None,
        check: Callable[[Mapping[str, Any]], None] = lambda changes: None,
        hardware_id: str = "",
        **keywords: Any,
    ) -> None:
        super().__init__(name, **keywords)
        self.configured = self.active = False
        self.session = 0
        self.trouble = ""
        self._made: Mapping[str, Any] | None = None  # parameters of the last `configure`
        self._values = declare(self, table, on_change, self._locked, check)
        self._diagnostics = Diagnostics(self, hardware_id, self._health_in_any_state)
        for service in self.services:
            if service.srv_name.endswith("/change_state"):
                service.callback = self._answering(service.callback)

    # --- what nodes do ---

    def configure(self) -> None:
        """Set up the node from its parameters; with `requires_activation`, again before activation if they changed."""

    def activate(self) -> None:
        """Begin to work."""

    def deactivate(self) -> None:
        """Stop working. Goals end as if they were cancelled."""

    def clean_up(self) -> None:
        """Return to the state after the start."""

    def refused(self, reason: str) -> None:
        """Called with the reason when the parameters are not acceptable."""

    def health(self) -> Health:
        """Health of the node; if it `requires_activation`, called only while it is active."""
        return Health()

    # --- what all have in common ---

    def inactive(self) -> str:
        """The reason why the node serves no requests, and what to do, as a sentence; "" = it serves them."""
        if self.active:
            return ""
        if self._state_machine.current_state[1] in ("shuttingdown", "finalized"):
            return f"{self.get_name()} was shut down: start its process again"
        name, trouble = self.get_fully_qualified_name(), f" ({self.trouble})" if self.trouble else ""
        steps = "activate" if self.configured else "configure`, then `activate"
        return f"{self.get_name()} is not active{trouble}: `ros2 lifecycle set {name} {steps}`"

    def check_active(self) -> None:
        """Raise Refusal if the node `requires_activation` and is not active."""
        if self.requires_activation and (reason := self.inactive()):
            raise Refusal(ErrorCode.NODE_INACTIVE, reason)

    def _health_in_any_state(self) -> Health:
        if self.requires_activation and (reason := self.inactive()):
            return Health(ERROR if self.trouble else WARN, reason)
        return self.health()

    def make_safe(self) -> None:
        """At the end of the process: goals end as when the node is deactivated, and their clients are told."""
        if self.requires_activation:
            self._done(self._rest)
        servers = [each for each in self.waitables if isinstance(each, ResendingActionServer) and each.unfinished]
        end = time.monotonic() + GOALS_END_S
        while self.executor is not None and servers and time.monotonic() < end:
            spin_once(self.executor, 0.02)
            if not any(each.unfinished for each in servers):
                end = min(end, time.monotonic() + RESULTS_S)

    def _locked(self) -> str:
        if self.active:
            return "deactivate" if self.requires_activation else "deactivate`, then `cleanup"
        return "cleanup" if self.configured and not self.requires_activation else ""

    def autostart(self) -> None:
        """Configure and activate the node unless its parameter `autostart` is false; called when it is served."""
        if self._values["autostart"] and self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()

    def _answering(self, change: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Wrap `change_state` so that it refuses transitions that its state does not allow; rclpy would not answer."""

        def answer(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except RuntimeError:
                wanted, state = request.transition.label or request.transition.id, self._state_machine.current_state[1]
                self.get_logger().warning(f"transition {wanted}: not possible in the state {state}")
                response.success = False
                return response

        return answer

    def _done(self, *steps: Callable[[], None]) -> TransitionCallbackReturn:
        """Take the steps of a transition and log their exceptions, which rclpy does not do."""
        self.trouble = ""
        try:
            for step in steps:
                step()
        except ValueError as error:
            self.active, self.trouble = False, str(error)
            self.get_logger().error(f"configuration refused: {error}")
            self.refused(self.trouble)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.trouble = f"a defect, see the log: {error}"
            self.get_logger().error(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _make(self) -> None:
        """Configure, unless that was already done for the present parameters."""
        if self._made != self._values:
            self._made = None
            self._values.check()
            self.configure()
            self._made = dict(self._values)

    def _rest(self) -> None:
        if self.active:
            self.active, self.session = False, self.session + self.requires_activation
            self.deactivate()

    def _release(self) -> None:
        self._rest()
        self.configured, self._made = False, None
        self.clean_up()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        done = self._done(self._make)
        self.configured = done == TransitionCallbackReturn.SUCCESS
        return done

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        if self.requires_activation and (done := self._done(self._make)) != TransitionCallbackReturn.SUCCESS:
            return done
        super().on_activate(state)  # publishers, before anything is published
        self.active, self.session = True, self.session + self.requires_activation
        done = self._done(self.activate)
        if done == TransitionCallbackReturn.FAILURE:
            super().on_deactivate(state)
        return done

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        done = self._done(self._rest)
        super().on_deactivate(state)
        return done

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._done(self._release)

    on_shutdown = on_cleanup

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        trouble = self.trouble
        done = self._done(self._release)
        self.trouble = trouble  # it is unconfigured now, for this reason
        return done
