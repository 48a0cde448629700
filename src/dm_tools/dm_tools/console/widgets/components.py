"""Small parts that the cards share."""

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from nicegui import ui

from dm_tools.console.charts.plots import Drawing
from dm_tools.console.view_models import decimal


def heading(text: str, level: int = 2) -> None:
    """A heading that screen readers list."""
    ui.html(text, tag=f"h{level}", sanitize=False)


@contextlib.contextmanager
def card(title: str, folded: bool = False) -> Iterator[None]:
    """A card with a heading; a `folded` one is unfolded by a click on it."""
    with ui.element("details" if folded else "section").classes("card").props(f'aria-label="{title}"'):
        with ui.element("summary") if folded else contextlib.nullcontext():
            heading(title)
        yield


class DecimalField(ui.input):
    """A text field for a number with point or comma: a browser's own number field would read `0,02` as 2."""

    def __init__(self, label: str, number: float, on_change: Callable[[], Any] | None = None) -> None:
        super().__init__(
            label,
            value=f"{number:g}",
            on_change=on_change,
            validation={"not a number": lambda text: decimal(text) is not None},
        )
        self.props('inputmode="decimal" hide-bottom-space')

    @property
    def number(self) -> float | None:
        """The number in the field; None = not a number."""
        return decimal(self.value)

    def set_number(self, number: float) -> None:
        """Set the number, unless the field already holds it in another notation."""
        if self.number != number:
            self.set_value(f"{number:g}")


class ActionButton(ui.element):
    """A button that is disabled with its reason as a tooltip; a click calls `on_click` with the arguments.

    `outline` marks a secondary action.
    """

    def __init__(self, text: str, on_click: Callable[..., Any], *arguments: Any, outline: bool = False) -> None:
        super().__init__("span")
        with self:
            self._button = ui.button(text, on_click=partial(on_click, *arguments)).props("no-caps unelevated")
            # The page's style sets the text colour of a filled button, so that it fits the dark scheme too.
            self._button.props("outline" if outline else "text-color=none")

    def allow(self, reason: str) -> None:
        """Enable it when `reason` is empty, else disable it and say why."""
        self._button.set_enabled(not reason)
        if reason != self.props.get("title"):  # of the span around the button: a disabled button shows no tooltip
            self.props["title"] = reason


class Chart(ui.element):
    """A chart that is sent only when it has changed; a text is shown in its place while there is none.

    Args:
        shape: class of the page's style that gives its height.
        on_click: called with the value of the datum that was clicked.
    """

    def __init__(self, shape: str, on_click: Callable[[Any], None] | None = None) -> None:
        super().__init__("div")
        self.classes("chart")
        self._shape, self._on_click = shape, on_click
        self._shown: Drawing | None = None
        self._chart: ui.echart | None = None  # made with the first drawing: it must have its size from the beginning
        with self:
            self._empty = Line("empty")

    def show(self, drawing: Drawing | None, text: str = "") -> None:
        """Show a drawing, or `text` when there is none."""
        self._empty.show(text if drawing is None else "")
        if self._chart is not None:
            self._chart.set_visibility(drawing is not None)
        if drawing is not None and drawing != self._shown:
            if self._chart is None:
                with self:
                    self._chart = ui.echart({}, renderer="svg").classes(self._shape).props('role="img"')
                if (on_click := self._on_click) is not None:
                    self._chart.on_point_click(lambda event: on_click(event.value))
            self._chart.options.clear()
            self._chart.options.update(drawing.options)
            self._chart.props["aria-label"] = drawing.description
            self._chart.update()
        self._shown = drawing


class Line(ui.label):
    """A line of text, hidden while it is empty; with `live`, screen readers announce its changes."""

    def __init__(self, classes: str = "text", live: bool = False) -> None:
        super().__init__("")
        self.classes(classes)
        if live:
            self.props('role="status" aria-live="polite"')

    def show(self, text: str) -> None:
        self.set_text(text)  # NiceGUI sends only what has changed
        self.set_visibility(bool(text))
