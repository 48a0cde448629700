"""The card of recipes: those of the calibration in use, and how to build more."""

from html import escape

from dm_msgs.action import BuildRecipes
from nicegui import ui

from dm_common.recipes import recipe_row, terms_of
from dm_tools.console import operations
from dm_tools.console.console_node import Snapshot
from dm_tools.console.session import Session
from dm_tools.console.status import reason_against
from dm_tools.console.view_models import NUMBER_MAX, evenly
from dm_tools.console.widgets.components import ActionButton, DecimalField, Line, folded

#: Range of [1], section 3.2, 1/m, and the number of its curvatures.
FIRST, LAST, NUMBER = -0.05, 0.05, 11
HEADER = ("1/m", "conic", "added terms", "largest coefficient, nm", "rms, nm", "maps")


class RecipesCard:
    """Table of the recipes, fields and button to build some: curvatures, with one conic constant and the same terms."""

    def __init__(self, session: Session) -> None:
        self._session = session
        with folded("Recipes"):
            self._text = Line("text")
            self._table = ui.html("", sanitize=False).classes("scroll")
            self._table.props('tabindex="0" role="region" aria-label="Recipes of the calibration in use"')
            with ui.element("div").classes("line"):
                self._first = DecimalField("First, 1/m", FIRST).classes("w-24")
                self._last = DecimalField("Last, 1/m", LAST).classes("w-24")
                self._number = ui.number("Recipes", value=NUMBER, min=1, max=NUMBER_MAX, step=1, format="%d")
                self._number.classes("w-20")
                self._conic = DecimalField("Conic", 0.0).classes("w-20")
                self._terms = ui.input("Added terms, nm").classes("w-full")
                self._terms.props('hint="astigmatism cos=200, coma sin=-50"')
            self._build = ActionButton(
                "Build recipes", session.begin, "Recipes", operations.build_recipes, self._goal, "build_recipes"
            )
            self._reason = Line("reason")

    def _goal(self) -> BuildRecipes.Goal:
        """What the fields say. Raises ValueError naming the one that makes no sense."""
        if (conic := self._conic.number) is None:
            raise ValueError("conic: must be a number")
        terms = terms_of(self._terms.value) if self._terms.value.strip() else []
        curvatures = evenly(self._first.number, self._last.number, self._number.value)
        return BuildRecipes.Goal(curvatures=curvatures, conic_constant=conic, zernike=terms)

    def refresh(self, snapshot: Snapshot) -> None:
        reason = reason_against("converge", snapshot, self._session.running)
        self._build.allow(reason)
        self._reason.show(f"Not possible now: {reason}" if reason else "")
        calibration = snapshot.calibration
        rows = [recipe_row(recipe) for recipe in calibration.recipes.recipes] if calibration is not None else []
        self._table.set_visibility(bool(rows))
        none = "This calibration holds none." if calibration is not None else "No calibration is in use."
        self._text.show(
            "A recipe is a command that was corrected on the interferometer from the conditioned mirror; the mode "
            f"“Conditioned” uses them. {'' if rows else none}"
        )
        head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in HEADER)
        body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        content = f'<table class="numbers"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>' if rows else ""
        self._table.set_content(content)
