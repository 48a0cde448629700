"""What all open pages of one console share: the operation under way, its progress, and everything that went wrong."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from dm_common.errors import Refusal
from dm_tools.console.console_node import ConsoleNode, Snapshot
from dm_tools.console.loops import Loop
from dm_tools.long_actions import calibration_step, converge_step, recipe_step

#: Messages are shown for this time unless dismissed before, s of wall time; the log keeps failures.
SHOWN_S = 120.0
FAILURES_KEPT = 50
#: Titles of actions that were not started here.
EXTERNAL = {
    "build_recipes": "A run of recipes that was started elsewhere",
    "calibrate": "A calibration that was started elsewhere",
    "converge": "A closed loop that was started elsewhere",
}


@dataclass(frozen=True)
class Failure:
    """Something that was refused or went wrong; shown until `ends`, s of the monotonic clock."""

    clock: str
    title: str
    sentence: str
    ends: float


@dataclass
class Progress:
    """How far the operation under way is.

    Attributes:
        title: of the operation, "" = none is under way.
        step, steps: i of n; steps 0 = not known.
        text: what it does now.
        can_cancel: whether it can be cancelled.
    """

    title: str = ""
    step: int = 0
    steps: int = 0
    text: str = ""
    can_cancel: bool = False

    def take(self, action: str, feedback: Any, goal: Any = None) -> None:
        """Show the feedback of an action; `goal` = None: another client's, whose goal is not known."""
        match action:
            case "move_focus":
                self.step, self.steps = round(100 * feedback.progress), 100
                self.text = feedback.phase
            case "degauss":
                self.step, self.steps = feedback.step, feedback.steps
                self.text = "alternating with falling amplitude about mid range"
            case "calibrate":
                self.step, self.steps, self.text = feedback.step, feedback.steps, calibration_step(feedback)
            case "converge":
                self.step, self.text = feedback.step, converge_step(feedback)
            case "build_recipes":
                self.step, self.steps = feedback.recipes, len(goal.curvatures) if goal is not None else 0
                self.text = recipe_step(feedback, goal.zernike if goal is not None else ())


@dataclass
class Session:
    """One console.

    Attributes:
        outcome: the last success, in words.
        chosen: number of the actuator that is shown.
        poke: signals before the last poke, and with it; None = there was none, or it was released.
        loops: {(id of the calibration, actuator): measured loop}.
    """

    ros: ConsoleNode
    failures: list[Failure] = field(default_factory=list)
    progress: Progress = field(default_factory=Progress)
    outcome: str = ""
    chosen: int = 1
    poke: tuple[list[float], list[float]] | None = None
    loops: dict[tuple[str, int], Loop] = field(default_factory=dict)
    _outcome_ends: float = 0.0
    _cancel: str | None = None
    _task: asyncio.Task[None] | None = None
    cancelled: bool = False

    def snapshot(self) -> Snapshot:
        """What is known of the bench now; also removes messages whose time is over."""
        now = time.monotonic()
        self.failures[:] = [failure for failure in self.failures if failure.ends > now]
        if now > self._outcome_ends:
            self.outcome = ""
        return self.ros.snapshot()

    @property
    def base(self) -> list[float] | None:
        """Signals to go back to when the poke is released; None = nothing is poked, or the mirror was moved since."""
        state = self.ros.snapshot().actuator_state
        return self.poke[0] if self.poke and state is not None and list(state.requested) == self.poke[1] else None

    @property
    def running(self) -> str:
        """Title of the operation under way, here or elsewhere; "" = none."""
        return self.progress.title or EXTERNAL.get(self.ros.external_action, "")

    @property
    def calibrating(self) -> bool:
        """Whether a calibration is under way, here or elsewhere."""
        return self.progress.title == "Calibration" or self.ros.external_action == "calibrate"

    @property
    def shown_progress(self) -> Progress:
        """Progress of the operation under way here, otherwise of the one elsewhere."""
        name = self.ros.external_action
        if self.progress.title or not name:
            return self.progress
        shown = Progress(EXTERNAL[name], text="no feedback yet", can_cancel=True)
        if (feedback := self.ros.watched[name].feedback) is not None:
            shown.take(name, feedback)
        return shown

    def fail(self, title: str, sentence: str) -> None:
        """Show a sentence until it is dismissed or its time is over."""
        ends = time.monotonic() + SHOWN_S
        self.failures.append(Failure(time.strftime("%H:%M:%S"), title, sentence, ends))
        del self.failures[:-FAILURES_KEPT]
        self.ros.take_log(time.time(), "ERROR", "console", f"{title}: {sentence}")

    def dismiss(self, failure: Failure) -> None:
        """Take a failure off the pages."""
        self.failures[:] = [each for each in self.failures if each is not failure]

    def begin(
        self,
        title: str,
        operation: Callable[..., Awaitable[str]],
        get_argument: Callable[[], Any] | None = None,
        cancel: str | None = None,
    ) -> None:
        """Start an operation; when another is under way, say so instead.

        Args:
            operation: called with this session and the result of `get_argument` if given; returns its outcome in words.
                Both raise Refusal or ValueError with the sentence to show.
            cancel: the action that is cancelled to stop it; "" = it reads `cancelled` itself, None = cannot be stopped.
        """
        if self.running:
            self.fail(title, f"not begun: {self.running} is under way")
            return
        self.progress = Progress(title, can_cancel=cancel is not None)
        self._cancel, self.cancelled, self.outcome = cancel, False, ""
        self._task = asyncio.get_running_loop().create_task(self._follow(title, operation, get_argument))

    async def _follow(
        self, title: str, operation: Callable[..., Awaitable[str]], get_argument: Callable[[], Any] | None
    ) -> None:
        try:
            outcome = await operation(self, *([get_argument()] if get_argument is not None else []))
            self.outcome = f"{title}: {outcome} ({time.strftime('%H:%M:%S')})"
            self._outcome_ends = time.monotonic() + SHOWN_S
        except (Refusal, ValueError) as error:
            self.fail(title, str(error))
        except Exception as error:  # a defect of the console must be visible, too
            self.fail(title, f"{type(error).__name__}: {error}")
            raise
        finally:
            self.progress = Progress()

    async def run(self, action: str, goal: Any) -> Any:
        """Run an action to its end, with its progress shown, and return its result. Raises Refusal."""
        return await self.ros.run(action, goal, lambda feedback: self.progress.take(action, feedback, goal))

    async def cancel(self) -> None:
        """Ask the operation under way to stop, here or elsewhere."""
        name = self.ros.external_action
        if self.progress.title:
            if self._cancel is None:
                return
            name, self.cancelled, self.progress.text = self._cancel, True, "cancelling"
        try:
            await self.ros.cancel(name)
        except Refusal as error:
            self.fail("Cancel", str(error))

    async def end(self) -> None:
        """Cancel the operation under way here and wait for its end, for an orderly shutdown."""
        if self.progress.title:
            await self.cancel()
        if self._task is not None and not self._task.done():
            await asyncio.wait([self._task], timeout=10.0)
