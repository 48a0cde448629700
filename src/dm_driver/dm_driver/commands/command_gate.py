"""Checks that every command passes before the writer: driver configured, mirror not held by another. Knows no ROS."""

from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

from dm_common.errors import ErrorCode, Refusal
from dm_driver.actuator_writer import ActuatorWriter
from dm_driver.commands.mirror_hold import TEXT, MirrorHold
from dm_driver.driver_configuration import DriverConfiguration
from dm_driver.moves import Outcome

Result = TypeVar("Result")

#: Time allowed to the electronics on top of the duration of a ramp, s.
MARGIN_S = 2.0

CODE_OF_OUTCOME = {
    Outcome.REACHED: ErrorCode.OK,
    Outcome.SUPERSEDED: ErrorCode.PREEMPTED,
    Outcome.LINK_LOST: ErrorCode.ELECTRONICS_UNREACHABLE,
    Outcome.STOPPED: ErrorCode.DRIVER_INACTIVE,
}


class CommandGate:
    """Carries out the commands that are permitted, and keeps the last refusal.

    Args:
        report: called with a line for the log after each refusal, and, with True, when the mirror was taken over.
        inactive: returns the reason why the driver takes no commands, as a sentence; "" = it is active.

    Attributes:
        writer, configuration: of the configured driver; None = it is not configured.
        refusal: of the last command; None = it was carried out.
        refused: number of refused commands by the name of their code.
    """

    def __init__(
        self, hold: MirrorHold, report: Callable[[str, bool], None], inactive: Callable[[], str] = lambda: ""
    ) -> None:
        self.hold, self._report, self._inactive = hold, report, inactive
        self.writer: ActuatorWriter | None = None
        self.configuration: DriverConfiguration | None = None
        self.refusal: Refusal | None = None
        self.refused: Counter[str] = Counter()

    def outcome(self, outcome: Outcome) -> Outcome:
        """The outcome of a move; if the way to the safe shape ended it, the driver stopped."""
        return Outcome.STOPPED if outcome is Outcome.SUPERSEDED and self._inactive() else outcome

    def attempt(
        self,
        source: str,
        request: Any,
        carry_out: Callable[[ActuatorWriter, DriverConfiguration], Result],
        dry_run: bool = False,
    ) -> Result | Refusal:
        """Carry out a request, or return and report its refusal; a refused dry run is not reported.

        Args:
            source: where the request came from, for the log.
            request: its fields `holder` and `take_over` are judged here.
            carry_out: returns what has begun to move; None = nothing has, and the holder keeps the mirror.
        """
        writer, configuration = self.writer, self.configuration
        if not dry_run:
            self.refusal = None  # before the writer's thread publishes the first write
        try:
            reason = self._inactive()
            if writer is None or configuration is None or (reason and not dry_run):
                raise Refusal(ErrorCode.DRIVER_INACTIVE, reason or "pdm_driver ends")
            TEXT.check("holder", request.holder)
            with self.hold.lock:  # else somebody might be granted the mirror in between, and lose it to this command
                takes_over = not dry_run and self.hold.check(request.holder, request.take_over)
                result, holder = carry_out(writer, configuration), self.hold.holder
                if result is not None:
                    self.hold.evict(request.holder, request.take_over)
            if takes_over and result is not None:
                by = request.holder or "nobody in particular"
                self._report(f"{source} of {by} took the mirror from {holder}", True)
            return result
        except Refusal as refusal:
            if not dry_run:
                self.refused[ErrorCode(refusal.error_code).name] += 1
                text = f"{source} refused: {refusal}"
                self.refusal = Refusal(refusal.error_code, text, refusal.actuators)
                self._report(text, False)
            return refusal
