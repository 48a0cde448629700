"""The card of calibrations: run one, see how it goes, load one."""

from __future__ import annotations

from html import escape
from typing import Any

from dm_msgs.action import Calibrate
from dm_msgs.srv import ListCalibrations
from nicegui import background_tasks, ui

from dm_controller.console import operations
from dm_controller.console.drawing.charts import residual_chart
from dm_controller.console.ros_side import RefusedError, Snapshot
from dm_controller.console.session import Session
from dm_controller.console.status import why_not
from dm_controller.console.view_models import calibration_words
from dm_controller.console.widgets.parts import ActionButton, Line, Picture, card


class CalibrationCard:
    """Plan, progress with the live residual, and the store."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._listed: str | None = None
        with card("Calibration"):
            self._words = ui.html("", sanitize=False).classes("words figures")
            self._shown = ""
            self._plan = ui.select(operations.PLANS, value=Calibrate.Goal.PLAN_MEMORY, label="Plan").classes("w-full")
            self._note = ui.input("Note, stored with it").classes("w-full")
            with ui.element("div").classes("line"):
                self._start = ActionButton("Calibrate", self._begin)
                self._cancel = ActionButton("Cancel calibration", session.cancel, True)
            self._why = Line("why")
            self._progress = Line("words figures", live=True)
            self._residuals = Picture()
            self._choice = ui.select({}, label="In the store").classes("w-full")
            self._load = ActionButton("Load", self._begin_load, True)

    def _begin(self) -> None:
        session = self._session
        goal = Calibrate.Goal(plan=int(self._plan.value), note=str(self._note.value or ""), activate=True)
        work = lambda: operations.calibrate(session, goal)  # noqa: E731
        session.begin("Calibration", work, lambda: session.ros.cancel("calibrate"))

    def _begin_load(self) -> None:
        session, name = self._session, str(self._choice.value or "")
        session.begin("Load", lambda: operations.load(session, name))

    def refresh(self, snapshot: Snapshot) -> None:
        session = self._session
        why = why_not("calibrate", snapshot, session.running)
        self._start.allow(why)
        self._why.show(f"Not possible now: {why}" if why else "")
        running = session.running == "Calibration"
        self._cancel.allow("" if running else "No calibration that was started here is under way.")
        progress = session.progress
        self._progress.show(f"Step {progress.step} of {progress.steps}: {progress.words}" if running else "")
        self._residuals.show(residual_chart(session.residuals_nm) if session.residuals_nm else "")
        lines = "".join(f"<div>{escape(line)}</div>" for line in calibration_words(snapshot.calibration))
        if lines != self._shown:
            self._shown = lines
            self._words.set_content(lines)
        self._load.allow(
            why_not("store", snapshot, session.running) or ("" if self._choice.value else "Choose a calibration first.")
        )
        in_use = snapshot.calibration.id if snapshot.calibration is not None else ""
        if in_use != self._listed and "calibration" in snapshot.present and not running:
            self._listed = in_use
            background_tasks.create(self._list())

    async def _list(self) -> None:
        try:
            answer: Any = await self._session.ros.call("list_calibrations", ListCalibrations.Request())
        except RefusedError as error:
            self._session.fail("List of calibrations", str(error))
            return
        options = {
            name: f"{name} ({residual * 1e9:.1f} nm held out){f', {remark}' if remark else ''}"
            for name, residual, remark in zip(answer.ids, answer.held_out_rms, answer.remarks, strict=True)
        }
        self._choice.set_options(options, value=self._choice.value if self._choice.value in options else None)
