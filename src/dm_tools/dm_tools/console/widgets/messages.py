"""Messages about the bench: the header, which is always visible, and the cards of log and diagnostics."""

from functools import partial
from html import escape

from nicegui import ui

from dm_tools.console.console_node import Snapshot
from dm_tools.console.session import Session
from dm_tools.console.status import badges, diagnostic_rows, log_rows, missing, now_text, shortened
from dm_tools.console.widgets.components import ActionButton, Line, card, heading


class Header:
    """Badges, outcome, progress and failures."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._shown: tuple[object, ...] = ()
        with ui.element("header").classes("header"):
            with ui.element("div").classes("line one"):
                heading("Deformable mirror console", 1)
                self._badges = ui.html("", sanitize=False).classes("state").props('role="status" aria-label="State"')
            with ui.element("div").classes("line below"):
                self._now = Line("text figures now")
                with ui.element("div").classes("work") as self._line:
                    self._bar = ui.linear_progress(show_value=False).style("flex: 1; min-width: 80px")
                    self._bar.props('aria-label="Progress"')
                    self._text = Line("text figures")
                    self._cancel = ActionButton("Cancel", session.cancel, outline=True)
                self._outcome = Line("text outcome", live=True)
        # At the foot of the window, apart from the header: failures come and go without moving anything.
        with ui.element("footer").classes("foot"):
            self._failures = ui.element("div").classes("failures")
            self._failures.props('role="alert" aria-live="assertive" aria-label="Errors"')

    def refresh(self, snapshot: Snapshot) -> None:
        progress = self._session.shown_progress
        shown = badges(snapshot, self._session.ros.observer.now(snapshot.bench_time).doubt)
        self._badges.set_content("".join(f'<span class="badge {kind}">{escape(text)}</span>' for text, kind in shown))
        running = bool(progress.title)
        self._line.set_visibility(running)
        if running:
            share = progress.step / progress.steps if progress.steps else 0.0
            self._bar.set_value(round(share, 3))
            self._bar.props(
                add="indeterminate" if not progress.steps else "", remove="" if not progress.steps else "indeterminate"
            )
        count = f" {progress.step}/{progress.steps}" if progress.steps else ""
        self._text.show(f"{progress.title}{count}: {progress.text}" if running else "")
        self._cancel.allow("" if progress.can_cancel else "This operation cannot be cancelled; it ends by itself.")
        self._now.show(now_text(snapshot))
        self._outcome.show("" if running else self._session.outcome)
        lacking = missing(snapshot.health, snapshot.mirror_info is not None)
        state = snapshot.actuator_state
        if state is not None and state.error_code and state.message:
            lacking.append(f"Driver: {state.message} (error {state.error_code})")
        key = (*lacking, *self._session.failures)
        if key != self._shown:
            self._shown = key
            self._fill(lacking)

    def _fill(self, lacking: list[str]) -> None:
        self._failures.clear()
        with self._failures:
            for failure in reversed(self._session.failures):
                with ui.element("div").classes("failure"):
                    ui.label(f"{failure.clock} {failure.title}: {failure.sentence}")
                    button = ui.button("Dismiss", on_click=partial(self._session.dismiss, failure))
                    button.props(f'flat dense no-caps color=negative aria-label="Dismiss: {failure.title}"')
            for sentence in lacking:
                with ui.element("div").classes("failure missing"):
                    ui.label(sentence)


def _short(text: str) -> str:
    """HTML of a sentence with its paths shortened; the tooltip shows the full text."""
    short = shortened(text)
    return escape(short) if short == text else f'<span title="{escape(text)}">{escape(short)}</span>'


def _empty(text: str) -> str:
    return f'<div class="empty">{escape(text)}</div>'


class DiagnosticsCard:
    """The health that the nodes report, the worst first."""

    def __init__(self) -> None:
        with card("Diagnostics", folded=True):
            self._place = ui.html("", sanitize=False).classes("scroll")
            self._place.props('tabindex="0" role="region" aria-label="Diagnostics"')

    def refresh(self, snapshot: Snapshot) -> None:
        content = "".join(
            f'<div class="status"><b>{escape(level)}: {escape(node)}</b> {_short(message)}'
            f'<div class="faint">{_short(figures)}</div></div>'
            for level, node, message, figures in diagnostic_rows(snapshot.diagnostics)
        ) or _empty("No node has reported its health yet.")
        self._place.set_content(content)


class LogCard:
    """What the nodes logged since the console was started, the newest first."""

    def __init__(self, session: Session) -> None:
        self._session = session
        with card("Log", folded=True):
            self._all = ui.switch("Show everything, not only warnings and errors", value=True)
            self._place = ui.html("", sanitize=False).classes("scroll")
            self._place.props('tabindex="0" role="log" aria-label="Log"')

    def refresh(self, _snapshot: Snapshot) -> None:
        rows = log_rows(list(self._session.ros.log), bool(self._all.value))
        cells = ("".join(f"<td>{_short(cell)}</td>" for cell in row) for row in rows)
        table = "".join(f"<tr>{row}</tr>" for row in cells)
        self._place.set_content(f"<table>{table}</table>" if rows else _empty("Nothing was logged yet."))
