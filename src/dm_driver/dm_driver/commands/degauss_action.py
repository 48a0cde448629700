"""The body of the action `degauss`."""

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from dm_msgs.action import Degauss
from rclpy.node import Node

from dm_common.errors import ErrorCode, Refusal
from dm_common.limits import DEGAUSS_STEPS_MIN
from dm_common.ros.worker import WorkerActionServer, WorkerGoal
from dm_driver.actuator_writer import ActuatorWriter
from dm_driver.commands.command_gate import CODE_OF_OUTCOME, MARGIN_S, CommandGate
from dm_driver.degauss import degauss_move
from dm_driver.driver_configuration import DriverConfiguration
from dm_driver.moves import Move, Outcome

#: How often the state of a degauss is checked, s, and how often its feedback is published, s.
POLL_S, FEEDBACK_S = 0.02, 0.1


class DegaussAction:
    """Serves `degauss` in worker threads; a newer permitted goal pre-empts, after a cancel the mirror slews back."""

    def __init__(self, node: Node, gate: CommandGate, values: Mapping[str, Any]) -> None:
        self._gate, self._values = gate, values
        self._server = WorkerActionServer(node, Degauss, "degauss", self._run, exclusive="preempt", admit=self._admit)

    def _move(self, goal: Any, configuration: DriverConfiguration) -> Move:
        """The move that a goal asks for. Raises Refusal if it is not allowed."""
        limits = configuration.limiter.limits
        middle = np.full(limits.actuators, limits.middle)
        end = configuration.limiter.check_shape(goal.end_signals or middle, "end_signals")
        name = "steps" if goal.steps else "degauss.steps"
        steps = goal.steps or self._values["degauss.steps"]
        return degauss_move(limits, goal.amplitude, steps, end, self._values["degauss.duration_max"], name)

    def _admit(self, goal: Any) -> None:
        """Raise the Refusal, logged by the gate, of a goal that is not allowed: it must not end the running one."""

        def check(_writer: ActuatorWriter, configuration: DriverConfiguration) -> None:
            self._move(goal, configuration)

        if isinstance(refusal := self._gate.attempt("degauss", goal, check), Refusal):
            raise refusal

    def _run(self, handle: WorkerGoal) -> tuple[str, Any]:
        began, result = time.monotonic(), Degauss.Result()
        outcome, result.error_code, result.message = self._carry_out(handle)
        result.duration = time.monotonic() - began
        return outcome, result

    def _carry_out(self, handle: WorkerGoal) -> tuple[str, int, str]:
        """Outcome, ErrorCode and message of a goal."""
        if handle.is_cancel_requested:
            return "canceled", ErrorCode.CANCELED, "cancelled before anything moved"
        if self._server.preempted(handle):
            return "abort", ErrorCode.PREEMPTED, "a newer goal took over before anything moved"

        def begin(writer: ActuatorWriter, configuration: DriverConfiguration) -> tuple[ActuatorWriter, Move]:
            return writer, writer.submit(self._move(handle.request, configuration))

        begun = self._gate.attempt("degauss", handle.request, begin)  # things may have changed since it was admitted
        if isinstance(begun, Refusal):
            return "abort", begun.error_code, str(begun)
        writer, move = begun
        began, next_feedback = time.monotonic(), 0.0
        while (ended := move.wait(POLL_S)) is None:
            if handle.is_cancel_requested:
                if text := self._slew_back(writer, move, handle.request.holder):
                    return "canceled", ErrorCode.CANCELED, text
                continue
            if self._server.preempted(handle):
                return "abort", ErrorCode.PREEMPTED, "a newer goal took over"
            now = time.monotonic()
            if now >= next_feedback:
                next_feedback = now + FEEDBACK_S
                handle.publish_feedback(
                    Degauss.Feedback(
                        step=min(move.begun, move.steps),
                        steps=move.steps,
                        remaining=max(0.0, move.duration - (now - began)),
                    )
                )
        ended = self._gate.outcome(ended)
        if ended is not Outcome.REACHED:
            open_to_all = ended is Outcome.SUPERSEDED and not handle.request.holder
            cure = "; hold_mirror keeps other commands away: give its holder in this goal" if open_to_all else ""
            return "abort", CODE_OF_OUTCOME[ended], ended.value + cure
        too_little = f"; the history is known only after {DEGAUSS_STEPS_MIN} or more over the whole range"
        swings = f"{move.steps} half-swings in {time.monotonic() - began:.1f} s"
        return "succeed", ErrorCode.OK, swings if move.wipes else swings + too_little

    def _slew_back(self, writer: ActuatorWriter, move: Move, holder: str) -> str:
        """Abandon a degauss for the shape held before; if somebody else has the mirror now, only halt.

        Returns the outcome as text; "" = the degauss had ended by itself.
        """
        lost = ""
        try:
            self._gate.hold.check(holder, take_over=False)
        except Refusal as refusal:
            lost = str(refusal)
        back = writer.turn_back(move, halt=bool(lost))
        if back is None:
            superseded = move.wait(MARGIN_S) in (None, Outcome.SUPERSEDED)
            return "cancelled; the mirror follows a newer command" if superseded else ""
        if lost:
            return f"cancelled; the mirror stops where it is, since another program took it: {lost}"
        ended = back.wait(writer.ramp_time(back.target) + MARGIN_S)
        if ended is Outcome.REACHED:
            return "cancelled; the mirror is back in the shape it held before, its history is not known"
        return f"cancelled; the return to the shape held before: {ended.value if ended else 'not ended in time'}"
