"""The card of recipes: those of the calibration in use, and how to build more."""

from __future__ import annotations

from functools import partial
from html import escape

from nicegui import ui

from dm_tools.console import operations
from dm_tools.console.console_node import Snapshot
from dm_tools.console.session import Session
from dm_tools.console.status import reason_against
from dm_tools.console.view_models import NUMBER_MAX, evenly, recipe_rows
from dm_tools.console.widgets.components import ActionButton, DecimalField, Line, folded

#: Range of [1], section 3.2, 1/m, and the number of its curvatures.
FIRST, LAST, NUMBER = -0.05, 0.05, 11
HEADER = ("1/m", "conic", "added terms", "largest coefficient, nm", "rms, nm", "maps")


class RecipesCard:
    """Table of the recipes, fields and button to build some."""

    def __init__(self, session: Session) -> None:
        self._session = session
        with folded("Recipes"):
            self._text = Line("text")
            self._table = ui.html("", sanitize=False).classes("scroll")
            self._table.props('tabindex="0" role="region" aria-label="Recipes of the calibration in use"')
            with ui.element("div").classes("line"):
                self._first = DecimalField("First, 1/m", FIRST, "w-24")
                self._last = DecimalField("Last, 1/m", LAST, "w-24")
                self._number = ui.number("Recipes", value=NUMBER, min=1, max=NUMBER_MAX, step=1, format="%d")
                self._number.classes("w-20")
            self._build = ActionButton("Build recipes", self._begin)
            self._reason = Line("reason")

    def _begin(self) -> None:
        session = self._session
        session.begin(
            "Recipes",
            lambda: operations.build_recipes(session, evenly(self._first.value, self._last.value, self._number.value)),
            partial(session.ros.cancel, "build_recipes"),
        )

    def refresh(self, snapshot: Snapshot) -> None:
        reason = reason_against("converge", snapshot, self._session.running)
        self._build.allow(reason)
        self._reason.show(f"Not possible now: {reason}" if reason else "")
        rows = recipe_rows(snapshot.calibration)
        self._table.set_visibility(bool(rows))
        in_use = snapshot.calibration is not None and bool(snapshot.calibration.id)
        none = "This calibration holds none." if in_use else "No calibration is in use."
        self._text.show(
            "A recipe is a command that was corrected on the interferometer from the conditioned mirror; the mode "
            f"“Conditioned” uses them. {'' if rows else none}"
        )
        head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in HEADER)
        body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        content = f'<table class="numbers"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>' if rows else ""
        self._table.set_content(content)
