"""Small parts that the cards share."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from html import escape
from typing import Any

from nicegui import ui


def heading(words: str, level: int = 2) -> None:
    """A heading that screen readers list."""
    ui.html(words, tag=f"h{level}", sanitize=False)


@contextlib.contextmanager
def card(title: str) -> Iterator[None]:
    """A card with a heading."""
    with ui.element("section").classes("card").props(f'aria-label="{title}"'):
        heading(title)
        yield


def labelled(element: Any, name: str) -> Any:
    """Give an element the name that screen readers say."""
    return element.props(f'aria-label="{name}"')


class ActionButton:
    """A button that is disabled with its reason as a tooltip.

    Args:
        words: on it.
        on_click: called without arguments.
        outline: for what is not the main thing to do.
    """

    def __init__(self, words: str, on_click: Callable[[], Any], outline: bool = False) -> None:
        self._reason: str | None = None
        with ui.element("span") as self._shell:
            self._button = ui.button(words, on_click=lambda: on_click()).props("no-caps unelevated")
            if outline:
                self._button.props("outline")

    def allow(self, reason: str) -> None:
        """Enable it when `reason` is empty, else disable it and tell why."""
        if reason == self._reason:
            return
        self._reason = reason
        self._button.set_enabled(not reason)
        # On the shell: a disabled button shows no tooltip.
        self._shell.props["title"] = reason
        self._shell.update()


class Picture:
    """A drawing that is replaced only when it changed; `words` stand there while there is none."""

    def __init__(self) -> None:
        self._shown = ""
        self._html = ui.html("", sanitize=False).classes("w-full")

    def show(self, svg: str, words: str = "") -> None:
        content = svg or (f'<div class="empty">{escape(words)}</div>' if words else "")
        if content != self._shown:
            self._shown = content
            self._html.set_content(content)


class Line:
    """A line of text that is sent only when it changed."""

    def __init__(self, classes: str = "words", live: bool = False) -> None:
        self.label = ui.label("").classes(classes)
        if live:
            self.label.props('role="status" aria-live="polite"')

    def show(self, words: str) -> None:
        if self.label.text != words:
            self.label.set_text(words)
        self.label.set_visibility(bool(words))
