"""What goes into the focus controller and what comes out of it, without ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from dm_msgs.msg import FocusRequest

from dm_common import Floats
from dm_common.errors import Refusal
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.planner import Move


class Moment(NamedTuple):
    """Now, by two clocks.

    Attributes:
        ns: ROS time, that commands, reports and creep go by; a simulator may let it run fast, or stop it.
        time: the same in s.
        steady: s, of a clock that goes on whatever ROS time does: silence and patience go by it.
        simulated: ROS time is a simulator's, and need not go as fast as the other.
    """

    ns: int
    time: float
    steady: float
    simulated: bool = False


@dataclass(eq=False)
class SendCommand:
    """Publish this actuator command; the controller notes in it what the driver makes of it.

    Attributes:
        signals: (N,)
        sent: when; its header has the stamp.
        expected_turns: it counts only while the driver reports so many; 0 = in any case.
        holder: who asks, where somebody holds the mirror; "" = nobody in particular.
        take_over: even if somebody else holds it.
        confirmed: the driver reported it as its own.
        lost: the driver was started anew since, and knows nothing of it.
        given_up: the driver did not report it in time, and that was said.
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
    """A request on its way through the controller, which alone changes it; the last one is also the shape that stands.

    `DriverMonitor` watches that shape come about, `CreepHold` keeps it.

    Attributes:
        request: what was asked for.
        began: when it was judged last, or refused since; its command goes out at the same time.
        active: the calibration in use then; None = there was none.
        move: None = refused before one was planned, or after.
        unknown: the reason why the actuators' history was not known then; "" = it was.
        refusal: None = not refused.
        pending: the mirror is degaussed first.
        applied: the driver has confirmed the command.
        answered: what came of its command has been said.
        gap: largest distance from its shape seen, normalised.
        command: the last one for its shape; None = none went out.
        earlier: the one before it that the driver has confirmed: it stands until the last one, on its way, arrives.
        creep_held: its shape is corrected for creep from its command on, until that is ended.
        checked: s, ROS time, when creep was looked at last.
        stood: whose shape stands on if the driver does not take the first command, until it has; None = nobody's.
        kept: its move was not stopped.
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
    gap: float = 0.0
    command: SendCommand | None = None
    earlier: SendCommand | None = None
    creep_held: bool = False
    checked: float = 0.0
    stood: Order | None = None
    kept: bool = True

    def send_on(self, signals: Floats, now: Moment, expected_turns: int = 0) -> SendCommand:
        """Another command for its shape, on behalf of the same holder."""
        self.earlier = self.command if self.command is not None and self.command.confirmed else self.earlier
        self.command = SendCommand(signals, now, expected_turns, self.request.holder)
        return self.command

    def leave_at(self, signals: Floats, now: Moment) -> SendCommand:
        """A command to stay where the mirror stands (N,), which quantised may break a limit by a step."""
        assert self.active is not None  # else nothing was commanded
        return self.send_on(self.active.mirror.limits.scaled(signals)[0], now)


class Progress(NamedTuple):
    """How far an order is.

    Attributes:
        planning: the mirror is being degaussed for it.
        share: 0 to 1 of that, or of the way.
        remaining: normalised distance to the shape.
        stands: the driver reports the shape.
        failed: the refusal that ended it; None = it goes on.
    """

    planning: bool = False
    share: float = 0.0
    remaining: float = 0.0
    stands: bool = False
    failed: Refusal | None = None


# --- commands and events ---


class StartDegauss(NamedTuple):
    """Have the driver degauss by `steps` half-swings (0 = as it does), and report the end of run `number`.

    `holder` asks for it, "" = nobody in particular; with `take_over` even if somebody else holds the mirror.
    """

    number: int
    steps: int
    holder: str = ""
    take_over: bool = False


class PublishState(NamedTuple):
    """Publish what came of an order."""

    order: Order


class PublishCapabilities(NamedTuple):
    """What the mirror can do has changed."""


class PublishEstimate(NamedTuple):
    """What is known of the actuators has changed."""


class Log(NamedTuple):
    """A line for the log; `level` is "info", "warning" or "error"."""

    level: str
    text: str


Effect = SendCommand | StartDegauss | PublishState | PublishCapabilities | PublishEstimate | Log
