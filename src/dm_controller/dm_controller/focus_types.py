"""Inputs and outputs of the focus controller, without ROS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from dm_msgs.msg import FocusRequest

from dm_common import Floats
from dm_common.errors import ErrorCode, Refusal
from dm_common.limits import same_signals
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.planner import Move

#: Number of unconfirmed commands for a shape that are known again when the driver reports one.
UNCONFIRMED = 8


class Moment(NamedTuple):
    """Now, by two clocks.

    Attributes:
        ns: ROS time, used for commands, reports and creep; a simulator may let it run fast, or stop it.
        time: the same in s.
        steady: s, of a clock that runs independently of ROS time, used for silence and time limits.
        simulated: ROS time is simulated, and need not run as fast as the steady clock.
    """

    ns: int
    time: float
    steady: float
    simulated: bool = False

    @property
    def refusal(self) -> Refusal | None:
        """The refusal of commands until a simulator is heard; creep would take the clock's jump for time at a shape."""
        if self.ns or not self.simulated:
            return None
        return Refusal(ErrorCode.TIMEOUT, "use_sim_time is set, but nothing has come on /clock yet")


@dataclass(eq=False)
class SendCommand:
    """Publish this actuator command; the controller records in it whether the driver took it.

    Attributes:
        signals: (N,)
        sent: when; the stamp of its header.
        expected_turns: it is valid only while the driver reports this number of turns; 0 = always.
        holder: name of the client, if somebody holds the mirror; "" = nobody in particular.
        take_over: send it even if somebody else holds the mirror.
        confirmed: the driver reported it as its own.
        lost: the driver was restarted since, and has not received it.
        given_up: the driver did not report it in time, and this was published.
    """

    signals: Floats
    sent: Moment
    expected_turns: int = 0
    holder: str = ""
    take_over: bool = False
    confirmed: bool = False
    lost: bool = False
    given_up: bool = False


@dataclass(eq=False)
class Order:
    """A request on its way through the controller, which alone changes this record; the last one is the present shape.

    `DriverMonitor` follows how the shape is reached, `CreepHold` keeps it.

    Attributes:
        request: what was asked for.
        began: when it was last judged, or refused after that; its command is sent at the same time.
        active: the calibration in use then; None = there was none.
        move: None = refused before one was planned, or after.
        unknown: the reason why the actuators' history was not known then; "" = it was.
        refusal: None = not refused.
        pending: it waits for a degauss.
        applied: the driver has confirmed the command.
        answered: the outcome of its command has been published.
        reached: the mirror has stood in its shape.
        gap: largest distance of the applied signals from its shape that was reported, normalised.
        command: the command for its shape that the driver follows, or is to follow; None = none was sent.
        sent: the last confirmed one and those after it: on a bad network one that seems lost may still arrive.
        creep_held: its shape is corrected for creep, from its command until the hold ends.
        checked: s, ROS time, of the last check for creep.
        previous_order: its shape is held until the driver takes the first command of this one; None = none.
        stopped: its move was stopped.
        starts: number of times that the driver had been activated anew when its first command was sent.
    """

    request: FocusRequest
    began: Moment
    active: ActiveCalibration | None = None
    move: Move | None = None
    unknown: str = ""
    refusal: Refusal | None = None
    pending: bool = False
    applied: bool = False
    answered: bool = False
    reached: bool = False
    gap: float = 0.0
    command: SendCommand | None = None
    sent: list[SendCommand] = field(default_factory=list)
    creep_held: bool = False
    checked: float = 0.0
    previous_order: Order | None = None
    stopped: bool = False
    starts: int = 0

    def send(self, signals: Floats, now: Moment, expected_turns: int = 0) -> SendCommand:
        """Another command for its shape, under the same holder."""
        self.command = SendCommand(signals, now, expected_turns, self.request.holder)
        confirmed = [each for each in self.sent if each.confirmed][-1:]
        unconfirmed = self.sent[self.sent.index(confirmed[0]) + 1 :] if confirmed else self.sent
        self.sent = [*confirmed, *unconfirmed[-UNCONFIRMED:], self.command]
        return self.command

    def has_sent(self, requested: Sequence[float] | Floats) -> bool:
        """Whether a command in `sent` asked for these signals (N,)."""
        return any(same_signals(requested, each.signals) for each in self.sent)

    def follow(self, requested: Sequence[float] | Floats) -> bool:
        """Take another command in `sent` as the present one, if the driver follows it; return whether."""
        for other in reversed(self.sent):
            past = other is self.command or (other.confirmed and self.command is not None and self.command.confirmed)
            if not past and same_signals(requested, other.signals):
                other.confirmed, self.command = True, other
                return True
        return False

    def leave_at(self, signals: Floats, now: Moment) -> SendCommand:
        """A command to stay at the present signals (N,), which after quantisation may break a limit by a step."""
        assert self.active is not None  # else nothing was commanded
        return self.send(self.active.mirror.limits.scaled(signals)[0], now)


class Progress(NamedTuple):
    """How far an order is.

    Attributes:
        planning: the mirror is being degaussed for it.
        share: 0 to 1, of the degauss or of the move.
        remaining: normalised distance to the shape.
        reached: the driver reports the shape.
        failed: the refusal that ended it; None = it goes on.
    """

    planning: bool = False
    share: float = 0.0
    remaining: float = 0.0
    reached: bool = False
    failed: Refusal | None = None


# --- commands and events ---


class StartDegauss(NamedTuple):
    """Have the driver degauss by `steps` half-swings (0 = as configured there), and report the end of run `number`.

    `holder` asks for it, "" = nobody in particular; with `take_over` even if somebody else holds the mirror.
    """

    number: int
    steps: int
    holder: str = ""
    take_over: bool = False


class PublishState(NamedTuple):
    """Publish the outcome of an order."""

    order: Order


class PublishCapabilities(NamedTuple):
    """Publish the capabilities of the mirror, which have changed."""


class PublishEstimate(NamedTuple):
    """Publish the estimate of the actuators, which has changed."""


class Log(NamedTuple):
    """A line for the log; `level` is "info", "warning" or "error"."""

    level: str
    text: str


Effect = SendCommand | StartDegauss | PublishState | PublishCapabilities | PublishEstimate | Log
