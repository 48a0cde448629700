"""What all open pages of one console share: the operation under way, its progress, and everything that went wrong."""

import asyncio
import itertools
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from dm_common.errors import Refusal
from dm_tools.console.console_node import ConsoleNode, Snapshot
from dm_tools.console.loops import Loop
from dm_tools.long_actions import calibration_step, converge_step, recipe_step

#: Messages are shown so long, s of wall time, unless somebody dismisses them before; the log keeps failures.
SHOWN_S = 120.0
FAILURES_KEPT = 50
#: What an action that was not started here is called.
EXTERNAL = {
    "build_recipes": "A run of recipes that was started elsewhere",
    "calibrate": "A calibration that was started elsewhere",
    "converge": "A closed loop that was started elsewhere",
}


@dataclass(frozen=True)
class Failure:
    """Something that was refused or went wrong; `ends` is when it is shown no more, s of the steady clock."""

    number: int
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


@dataclass
class Session:
    """One console.

    Attributes:
        outcome: the last success, in words.
        chosen: number of the actuator that is shown.
        base: signals to go back to when a poke is released; None = nothing is poked.
        poked: signals of the last poke.
        loops: {actuator: measured loop}.
    """

    ros: ConsoleNode
    failures: list[Failure] = field(default_factory=list)
    progress: Progress = field(default_factory=Progress)
    outcome: str = ""
    chosen: int = 1
    base: list[float] | None = None
    poked: list[float] = field(default_factory=list)
    loops: dict[int, Loop] = field(default_factory=dict)
    _outcome_ends: float = 0.0
    _numbers: Any = field(default_factory=lambda: itertools.count(1))
    _cancel: Callable[[], Awaitable[None]] | None = None
    _task: asyncio.Task[None] | None = None
    cancelled: bool = False

    def snapshot(self) -> Snapshot:
        """What is known of the bench now; messages whose time is over go."""
        now = time.monotonic()
        self.failures[:] = [failure for failure in self.failures if failure.ends > now]
        if now > self._outcome_ends:
            self.outcome = ""
        return self.ros.snapshot()

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
        """The operation under way here, else the one elsewhere."""
        name = self.ros.external_action
        if self.progress.title or not name:
            return self.progress
        feedback = self.ros.watched[name].feedback
        shown = Progress(EXTERNAL[name], can_cancel=True)
        if feedback is None:
            shown.text = "no word of it yet"
        elif name == "calibrate":
            shown.step, shown.steps, shown.text = feedback.step, feedback.steps, calibration_step(feedback)
        else:
            shown.text = recipe_step(feedback) if name == "build_recipes" else converge_step(feedback)
        return shown

    def fail(self, title: str, sentence: str) -> None:
        """Show a sentence until it is dismissed or its time is over."""
        ends = time.monotonic() + SHOWN_S
        self.failures.append(Failure(next(self._numbers), time.strftime("%H:%M:%S"), title, sentence, ends))
        del self.failures[:-FAILURES_KEPT]
        self.ros.take_log(time.time(), "ERROR", "console", f"{title}: {sentence}")

    def dismiss(self, number: int) -> None:
        """Take a failure off the pages."""
        self.failures[:] = [failure for failure in self.failures if failure.number != number]

    def begin(
        self,
        title: str,
        work: Callable[[], Awaitable[str]],
        cancel: Callable[[], Awaitable[None]] | None = None,
    ) -> None:
        """Start an operation; when another is under way, say so instead.

        Args:
            work: returns its outcome in words; raises Refusal or ValueError with the sentence to show.
            cancel: how to stop it; None = it cannot be.
        """
        if self.running:
            self.fail(title, f"not begun: {self.running} is under way")
            return
        self.progress = Progress(title, can_cancel=cancel is not None)
        self._cancel, self.cancelled, self.outcome = cancel, False, ""
        self._task = asyncio.get_running_loop().create_task(self._follow(title, work))

    async def _follow(self, title: str, work: Callable[[], Awaitable[str]]) -> None:
        try:
            self.outcome = f"{title}: {await work()} ({time.strftime('%H:%M:%S')})"
            self._outcome_ends = time.monotonic() + SHOWN_S
        except (Refusal, ValueError) as error:
            self.fail(title, str(error))
        except Exception as error:  # a defect of the console must be seen, too
            self.fail(title, f"{type(error).__name__}: {error}")
            raise
        finally:
            self.progress = Progress()

    async def cancel(self) -> None:
        """Ask the operation under way to stop, here or elsewhere."""
        try:
            if not self.progress.title and (name := self.ros.external_action):
                await self.ros.cancel(name)
            elif self._cancel is not None and self.progress.title:
                self.cancelled = True
                self.progress.text = "cancelling"
                await self._cancel()
        except Refusal as error:
            self.fail("Cancel", str(error))

    async def between_steps(self) -> None:
        """How work that checks `cancelled` between its steps is cancelled."""

    async def end(self) -> None:
        """Cancel what is under way here and wait for its end, for a shutdown in order."""
        if self.progress.title:
            await self.cancel()
        if self._task is not None and not self._task.done():
            await asyncio.wait([self._task], timeout=10.0)
