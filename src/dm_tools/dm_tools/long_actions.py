"""Actions that take long: goals that other clients sent, and their feedback in words.

The console shows such goals, can cancel them and starts nothing meanwhile; commands name them as holder of the mirror.
"""

import threading
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

from action_msgs.msg import GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal
from rclpy.node import Node
from rclpy.qos import qos_profile_action_status_default
from rclpy.task import Future

from dm_common.figures import in_nanometres
from dm_common.optics.zernike import SPOKEN
from dm_common.recipes import shape_text
from dm_common.ros import qos

#: Actions that occupy mirror or interferometer for long. `move_focus` is not among them: the next move replaces it.
LONG = ("build_recipes", "calibrate", "converge")
RUNNING = (GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING, GoalStatus.STATUS_CANCELING)


class ExternalGoals:
    """Follows all goals of one action by its status and feedback topics. May be queried from any thread.

    Attributes:
        goals: goals that were seen to begin.
        feedback: the latest of the running goal; None before the first.
        residuals: feedback field `residual_rms` (m) of every step of the last goal.
    """

    def __init__(self, node: Node, action_type: Any, name: str) -> None:
        self._node, self._status_topic = node, f"{name}/_action/status"
        self._lock = threading.Lock()
        self._running: bytes = b""
        self._own: set[bytes] = set()
        self._ended: set[bytes] = set()
        self._servers: set[bytes] = set()  # publishers of the status since the goal began
        self.goals = 0
        self.feedback: Any = None
        self.residuals: list[float] = []
        latched, feedback = qos_profile_action_status_default, f"{name}/_action/feedback"
        node.create_subscription(GoalStatusArray, self._status_topic, self._on_status, latched)
        node.create_subscription(action_type.Impl.FeedbackMessage, feedback, self._on_feedback, qos.STATE)
        self._cancel = node.create_client(CancelGoal, f"{name}/_action/cancel_goal")

    def own(self, identity: Any) -> None:
        """Note that this console is about to send the goal `identity`, a unique_identifier_msgs/UUID."""
        self._own.add(bytes(identity.uuid))

    def disown(self, identity: Any) -> None:
        """Note that this console has lost track of the goal `identity`; if it runs, it counts as another client's."""
        self._own.discard(bytes(identity.uuid))

    @property
    def running(self) -> bool:
        """Whether a goal runs that this console did not send."""
        with self._lock:
            if not self._running or self._running in self._own:
                return False
        known = self._node.get_publishers_info_by_topic(self._status_topic)
        there = {bytes(server.endpoint_gid) for server in known}
        with self._lock:
            self._servers = self._servers or there
            if not self._servers & there:  # its node has died; a restarted node does not report the goal
                self._running = b""
            return bool(self._running)

    def cancel(self) -> Future | None:
        """Ask the running goal to stop; returns the answer, None = no goal runs. Its status shows when it has ended."""
        request = CancelGoal.Request()
        with self._lock:
            if not self._running:
                return None
            request.goal_info.goal_id.uuid = list(self._running)
        return self._cancel.call_async(request)

    def _on_status(self, message: Any) -> None:
        goals = [(bytes(entry.goal_info.goal_id.uuid), entry.status) for entry in message.status_list]
        with self._lock:
            self._ended |= {identity for identity, status in goals if status not in RUNNING}
            newest = next((identity for identity, status in reversed(goals) if status in RUNNING), b"")
            if newest and newest != self._running:
                self._begin(newest)
            self._running = newest

    def _on_feedback(self, message: Any) -> None:
        identity, feedback = bytes(message.goal_id.uuid), message.feedback
        with self._lock:
            # Status and feedback are two topics: either may be late.
            if identity in self._ended:
                return
            if identity != self._running:
                self._begin(identity)
            if self.feedback is None:
                self.residuals = []
            if feedback.residual_rms > 0.0 and (self.feedback is None or feedback.step != self.feedback.step):
                self.residuals.append(float(feedback.residual_rms))
            self.feedback = feedback

    def _begin(self, identity: bytes) -> None:
        self._running, self.feedback, self._servers = identity, None, set()
        self.goals += 1


def calibration_step(feedback: Any) -> str:
    """Feedback of the action `calibrate`: phase, what is measured, what was dropped, and the accuracy so far."""
    text = feedback.phase if feedback.label in ("", feedback.phase) else f"{feedback.phase} {feedback.label}".strip()
    if feedback.maps_dropped:
        text += f", {feedback.maps_dropped} dropped"
    return ", ".join(filter(None, (text, reached_so_far(feedback))))


def reached_so_far(feedback: Any) -> str:
    """Accuracy so far of a calibration that may end early, by its feedback, and what is left; "" = not known yet."""
    if not feedback.reached_max_zernike > 0.0:
        return ""
    text = f"accurate to {in_nanometres(feedback.reached_max_zernike)} so far"
    if not feedback.maps_left:
        return text
    if not feedback.expected_max_zernike > 0.0:
        time = f"{feedback.time_left:.0f} s"
        return (
            f"{text}, the hysteresis law is hardly found yet (then the error falls) or fits this mirror worse than "
            f"most, {feedback.maps_left} more maps at most ({time})"
        )
    expected = in_nanometres(feedback.expected_max_zernike)
    return f"{text}, {expected} expected after {feedback.maps_left} more maps ({feedback.time_left:.0f} s)"


def converge_step(feedback: Any) -> str:
    """Feedback of the action `converge`: the map and how far off it was."""
    if feedback.message or not feedback.step:
        return feedback.message or "no map yet"
    return f"map {feedback.step}: largest coefficient {feedback.max_zernike * 1e9:.1f} nm"


def recipe_step(feedback: Any, zernike: Sequence[float] = ()) -> str:
    """Feedback of the action `build_recipes`: number in the list, shape, the map and how far off it was.

    `zernike` is that of the goal; () = another client's goal, which is not known.
    """
    if not feedback.step:
        return converge_step(feedback)
    begin = len(SPOKEN) * feedback.recipes if len(zernike) > len(SPOKEN) else 0  # one set for all, or one for each
    shape = SimpleNamespace(curvature=feedback.curvature, zernike=zernike[begin : begin + len(SPOKEN)])
    return f"{feedback.recipes + 1}: {shape_text(shape)}, {converge_step(feedback)}"
