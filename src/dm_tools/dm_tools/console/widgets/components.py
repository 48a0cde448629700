"""Small parts that the cards share."""

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from nicegui import ui

from dm_tools.console.charts.plots import Drawing
from dm_tools.console.view_models import decimal, number_in, whole_number_in


def heading(text: str, level: int = 2) -> None:
    """A heading that screen readers list."""
    ui.html(text, tag=f"h{level}", sanitize=False)


@contextlib.contextmanager
def card(title: str, folded: bool = False) -> Iterator[None]:
    """A card with a heading; a `folded` one is unfolded by a click on it."""
    with ui.element("details" if folded else "section").classes("card").props(f'aria-label="{title}"'):
        with ui.element("summary") if folded else contextlib.nullcontext():
            heading(title)
        # Browsers put what is folded into a box of their own, which has neither the card's grid nor its box sizing.
        with ui.element("div").classes("unfolded") if folded else contextlib.nullcontext():
            yield


class DecimalField(ui.input):
    """A text field for a number with point or comma: a browser's own number field would read `0,02` as 2."""

    def __init__(self, label: str, number: float | None, on_change: Callable[[], Any] | None = None) -> None:
        super().__init__(
            label,
            value="" if number is None else f"{number:g}",
            on_change=on_change,
            validation=self._fault,
        )
        self.props('inputmode="decimal" hide-bottom-space')

    def _fault(self, text: str | None) -> str | None:
        """What is wrong with `text`, in the few words that fit under the field."""
        return None if decimal(text) is not None else "not a number"

    @property
    def name(self) -> str:
        """The label without its unit or explanation, as refusals name the field."""
        return self.label.partition(",")[0].partition(":")[0].lower()

    @property
    def number(self) -> float | None:
        """The number in the field; None = not a number."""
        return decimal(self.value)

    @property
    def valid_number(self) -> float:
        """The number in the field. Raises ValueError naming the field when it holds none."""
        return number_in(self.name, self.value)

    def set_number(self, number: float) -> None:
        """Set the number, unless the field already holds it in another notation."""
        if self.number != number:
            self.set_value(f"{number:g}")


class WholeNumberField(DecimalField):
    """A text field for a whole number; a browser's own number field would move one out of range into it, in silence.

    Arrow keys count up and down. A field that is empty at first may be left empty.

    Attributes:
        allowed: the range.
    """

    def __init__(
        self, label: str, number: int | None, allowed: range, on_change: Callable[[], Any] | None = None
    ) -> None:
        super().__init__(label, number, on_change)
        self.allowed, self._optional = allowed, number is None
        self.props('inputmode="numeric"')
        for key, step in (("up", 1), ("down", -1)):
            self.on(f"keydown.{key}.prevent", partial(self._count, step))

    def _fault(self, text: str | None) -> str | None:
        empty = not (text or "").strip()
        right = self._optional if empty else decimal(text) in self.allowed
        return None if right else f"whole, {self.allowed[0]} to {self.allowed[-1]}"

    @property
    def valid_number(self) -> int:
        """The number in the field. Raises ValueError naming field and range when it holds none of the range."""
        return whole_number_in(self.name, self.value, self.allowed)

    def _count(self, step: int) -> None:
        if (number := self.number) is not None and number + step in self.allowed:
            self.set_number(number + step)


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
