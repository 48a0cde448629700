"""The cards of calibrations (run, follow and load one) and of recipes (list and build them)."""

from collections.abc import Iterable
from html import escape
from typing import Any

from dm_msgs.action import BuildRecipes, Calibrate
from dm_msgs.srv import ListCalibrations
from nicegui import background_tasks, ui

from dm_calibration.hysteresis.excitation import MAPS_MAX, MAPS_MIN
from dm_common.errors import Refusal
from dm_common.recipes import recipe_row, terms_of
from dm_tools.console import operations
from dm_tools.console.charts.plots import residual_chart
from dm_tools.console.console_node import Snapshot
from dm_tools.console.session import Session
from dm_tools.console.status import reason_against
from dm_tools.console.view_models import calibration_text, evenly
from dm_tools.console.widgets.components import ActionButton, Chart, DecimalField, Line, WholeNumberField, card

#: Range of [1], section 3.2, 1/m, and the number of its curvatures.
FIRST, LAST, NUMBER = -0.05, 0.05, 11
#: Numbers of recipes in one run, and of commands in one calibration.
NUMBERS, LENGTHS = range(1, 1001), range(MAPS_MIN, MAPS_MAX + 1)
HEADER = ("1/m", "conic", "added terms", "largest coefficient, nm", "rms, nm", "maps")


def _rows(lines: Iterable[str]) -> str:
    return "".join(f"<div>{escape(line)}</div>" for line in lines)


class CalibrationCard:
    """Plan, progress with the live residual, and the store."""

    def __init__(self, session: Session) -> None:
        self._session = session
        #: Key of what the list of the store depends on; None = the list must be requested.
        self._listed: tuple[Any, ...] | None = None
        with card("Calibration"):
            self._text = ui.html("", sanitize=False).classes("text figures")
            self._plan = ui.select(operations.PLANS, value=Calibrate.Goal.PLAN_HYSTERESIS, label="Plan").classes(
                "w-full"
            )
            self._maps = WholeNumberField("Length: commands of the plan", None, LENGTHS)
            self._maps.classes("w-full").props('placeholder="as configured"')
            self._maps.bind_visibility_from(self._plan, "value", value=Calibrate.Goal.PLAN_HYSTERESIS)
            self._note = ui.input("Note, stored with it").classes("w-full")
            with ui.element("div").classes("line"):
                self._start = ActionButton(
                    "Calibrate", session.begin, "Calibration", operations.calibrate, self._goal, "calibrate"
                )
                self._estimate = ActionButton(
                    "How long?", session.begin, "Estimate", operations.estimate, self._goal, outline=True
                )
                self._cancel = ActionButton("Cancel calibration", session.cancel, outline=True)
            self._reason = Line("reason")
            self._progress = Line("text figures", live=True)
            self._residuals = Chart("run")
            self._choice = ui.select({}, label="In the store").classes("w-full")
            self._choice.on("popup-show", self._forget_list)
            self._load = ActionButton(
                "Load", session.begin, "Load", operations.load, lambda: str(self._choice.value or ""), outline=True
            )

    def _goal(self) -> Calibrate.Goal:
        """The goal from the fields. Raises ValueError naming the field."""
        goal = Calibrate.Goal(plan=str(self._plan.value), note=str(self._note.value or ""), activate=True)
        if goal.plan == Calibrate.Goal.PLAN_HYSTERESIS and self._maps.value.strip():
            goal.hysteresis_maps = self._maps.valid_number
        return goal

    def refresh(self, snapshot: Snapshot) -> None:
        session = self._session
        reason = reason_against("calibrate", snapshot, session.running)
        self._start.allow(reason)
        self._estimate.allow(reason)
        self._reason.show(f"Not possible now: {reason}" if reason else "")
        running = session.calibrating
        self._cancel.allow("" if running else "No calibration is under way.")
        progress = session.shown_progress
        step = f"Step {progress.step} of {progress.steps}: {progress.text}" if progress.steps else "The run begins."
        self._progress.show(step if running else "")
        residuals_nm = [1e9 * residual for residual in list(session.ros.watched["calibrate"].residuals)]
        self._residuals.show(residual_chart(residuals_nm) if residuals_nm else None)
        limitations = snapshot.calibration.known_limitations if snapshot.calibration is not None else []
        lines = _rows(calibration_text(snapshot.calibration))
        if limitations:
            lines += f"<details><summary>Known limitations: {len(limitations)}</summary>{_rows(limitations)}</details>"
        self._text.set_content(lines)
        unchosen = "" if self._choice.value else "Choose a calibration first."
        self._load.allow(reason_against("store", snapshot, session.running) or unchosen)
        in_use = snapshot.calibration.id if snapshot.calibration is not None else ""
        # The list is also requested after runs that were started elsewhere, and after a restart of the node.
        key = (in_use, session.ros.watched["calibrate"].goals, "calibration" in snapshot.health)
        if key != self._listed and key[-1] and not running:
            self._listed = key
            background_tasks.create(self._list())

    def _forget_list(self) -> None:
        self._listed = None

    async def _list(self) -> None:
        try:
            answer: Any = await self._session.ros.call("list_calibrations", ListCalibrations.Request())
        except Refusal as error:
            self._session.fail("List of calibrations", str(error))
            return
        options = {
            name: f"{name} ({residual * 1e9:.1f} nm held out){f', {remark}' if remark else ''}"
            for name, residual, remark in zip(answer.ids, answer.held_out_rms, answer.remarks, strict=True)
        }
        if options != self._choice.options:
            chosen = self._choice.value
            if chosen not in options:  # while none is in use, the newest that can be is offered
                usable = (name for name, remark in zip(answer.ids, answer.remarks, strict=True) if not remark)
                chosen = None if "in use" in answer.remarks else next(usable, None)
            self._choice.set_options(options, value=chosen)


class RecipesCard:
    """Table of the recipes, and fields to build more: curvatures that share one conic constant and the added terms."""

    def __init__(self, session: Session) -> None:
        self._session = session
        with card("Recipes", folded=True):
            self._text = Line("text")
            self._table = ui.html("", sanitize=False).classes("scroll")
            self._table.props('tabindex="0" role="region" aria-label="Recipes of the calibration in use"')
            with ui.element("div").classes("line"):
                self._first = DecimalField("First, 1/m", FIRST).classes("w-24")
                self._last = DecimalField("Last, 1/m", LAST).classes("w-24")
                self._number = WholeNumberField("Recipes", NUMBER, NUMBERS).classes("w-20")
                self._conic = DecimalField("Conic", 0.0).classes("w-20")
                self._terms = ui.input("Added terms, nm").classes("w-full")
                self._terms.props('hint="astigmatism cos=200, coma sin=-50"')
            self._build = ActionButton(
                "Build recipes", session.begin, "Recipes", operations.build_recipes, self._goal, "build_recipes"
            )
            self._reason = Line("reason")

    def _goal(self) -> BuildRecipes.Goal:
        """The goal from the fields. Raises ValueError naming the field that is not valid."""
        terms = terms_of(self._terms.value) if self._terms.value.strip() else []
        curvatures = evenly(self._first.valid_number, self._last.valid_number, self._number.valid_number)
        return BuildRecipes.Goal(curvatures=curvatures, conic_constant=self._conic.valid_number, zernike=terms)

    def refresh(self, snapshot: Snapshot) -> None:
        reason = reason_against("converge", snapshot, self._session.running)
        self._build.allow(reason)
        self._reason.show(f"Not possible now: {reason}" if reason else "")
        rows = [recipe_row(recipe) for recipe in snapshot.recipes.recipes] if snapshot.recipes is not None else []
        self._table.set_visibility(bool(rows))
        none = "This calibration holds none." if snapshot.calibration is not None else "No calibration is in use."
        self._text.show(
            "A recipe is a command that was corrected on the interferometer from the conditioned mirror; the mode "
            f"“Conditioned” uses them. {'' if rows else none}"
        )
        head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in HEADER)
        body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        content = f'<table class="numbers"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>' if rows else ""
        self._table.set_content(content)
