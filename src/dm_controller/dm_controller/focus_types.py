"""What goes into the focus controller and what comes out of it, without ROS."""

from dataclasses import dataclass
from typing import NamedTuple

from dm_msgs.msg import FocusRequest

from dm_common import Floats
from dm_common.errors import Refusal
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.planner import Move, Planner


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


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of a request so far.

    Attributes:
        request: what was asked for.
        stamp_ns: of the command, where one went out; else of the judgement.
        active: the calibration in use; None = there was none.
        move: None = refused before one was planned.
        applied: the driver has confirmed the command.
        pending: the mirror is degaussed first.
        unknown: the reason why the actuators' history is not known; "" = it is.
        creep_held: the shape is corrected for creep from now on.
        refusal: None = not refused.
    """

    request: FocusRequest
    stamp_ns: int
    active: ActiveCalibration | None = None
    move: Move | None = None
    applied: bool = False
    pending: bool = False
    unknown: str = ""
    creep_held: bool = False
    refusal: Refusal | None = None


@dataclass(eq=False)
class Order:
    """A request on its way through the controller, which alone changes it.

    Attributes:
        outcome: the latest.
        pending: the mirror is degaussed first.
        began: s, steady, when it was given or its command went out.
        taken: the driver was seen to follow its command.
        gap: largest distance from its shape seen, normalised.
    """

    request: FocusRequest
    outcome: Outcome
    pending: bool = False
    began: float = 0.0
    taken: bool = False
    gap: float = 0.0


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


@dataclass(frozen=True, eq=False)
class SendCommand:
    """Publish this actuator command.

    Attributes:
        signals: (N,)
        stamp_ns: of its header.
        expected_turns: it counts only while the driver reports so many; 0 = in any case.
        holder: who asks, where somebody holds the mirror; "" = nobody in particular.
        take_over: even if somebody else holds it.
    """

    signals: Floats
    stamp_ns: int
    expected_turns: int = 0
    holder: str = ""
    take_over: bool = False


class StartDegauss(NamedTuple):
    """Have the driver degauss by `steps` half-swings (0 = as it does), and report the end of run `number`.

    `holder` asks for it, "" = nobody in particular; with `take_over` even if somebody else holds the mirror.
    """

    number: int
    steps: int
    holder: str = ""
    take_over: bool = False


class PublishState(NamedTuple):
    """Publish what came of a request."""

    outcome: Outcome


class PublishCapabilities(NamedTuple):
    """What the mirror can do has changed."""


class Log(NamedTuple):
    """A line for the log; `level` is "info", "warning" or "error"."""

    level: str
    text: str


# --- what was commanded ---


@dataclass(eq=False)
class Sent:
    """A command that went out.

    Attributes:
        order: that it answers; None = it corrects a shape for creep, or stops its move.
        time, steady: s, when.
        confirmed: the driver reported it as its own.
        lost: the driver was started anew since, and knows nothing of it.
        given_up: the driver did not report it in time, and that was said.
    """

    command: SendCommand
    order: Order | None
    time: float
    steady: float
    confirmed: bool = False
    lost: bool = False
    given_up: bool = False


@dataclass(eq=False)
class CommandedShape:
    """The shape that was commanded last: `DriverMonitor` watches it come about, `CreepHold` keeps it.

    Attributes:
        move: to it.
        planner: of the move.
        sent: the last command for it.
        held: it is corrected for creep.
        checked: s, ROS time, when creep was looked at last.
        kept: its move was not stopped.
        began: s, ROS time, when it was commanded first.
    """

    move: Move
    planner: Planner
    sent: Sent
    held: bool
    checked: float
    kept: bool = True
    began: float = 0.0

    def bound(self, known: bool) -> float:
        """m, 95 % bound on its largest coefficient error, with the history of the actuators `known` to this day or not.

        What was written again after a lost link is on another branch of the hysteresis than it was found for.
        """
        plan, lost = self.move.plan, self.move.known and not known
        return plan.max_zernike + self.planner.error_bound(not lost, plan.max_zernike_upper - plan.max_zernike)

    def send_on(self, signals: Floats, now: Moment, expected_turns: int = 0) -> SendCommand:
        """Another command for the shape that was commanded last, on behalf of the same holder."""
        command = SendCommand(signals, now.ns, expected_turns, self.sent.command.holder)
        self.sent = Sent(command, None, now.time, now.steady)
        return command


Effect = SendCommand | StartDegauss | PublishState | PublishCapabilities | Log
