"""The card of log and diagnostics."""

from html import escape

from nicegui import ui

from dm_tools.console.console_node import Snapshot
from dm_tools.console.session import Session
from dm_tools.console.status import diagnostic_rows, log_rows, shortened
from dm_tools.console.widgets.components import folded


def _short(text: str) -> str:
    """HTML of a sentence with its paths shortened; the whole of it is the tooltip."""
    short = shortened(text)
    return escape(short) if short == text else f'<span title="{escape(text)}">{escape(short)}</span>'


def _empty(text: str) -> str:
    return f'<div class="empty">{escape(text)}</div>'


def _table(rows: list[tuple[str, str, str, str]]) -> str:
    if not rows:
        return _empty("Nothing was logged yet.")
    cells = ("".join(f"<td>{_short(cell)}</td>" for cell in row) for row in rows)
    return "<table>" + "".join(f"<tr>{row}</tr>" for row in cells) + "</table>"


class DiagnosticsCard:
    """What the nodes say of their health, the worst first."""

    def __init__(self) -> None:
        with folded("Diagnostics"):
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
        with folded("Log"):
            self._all = ui.switch("Show everything, not only warnings and errors", value=True)
            self._place = ui.html("", sanitize=False).classes("scroll")
            self._place.props('tabindex="0" role="log" aria-label="Log"')

    def refresh(self, _snapshot: Snapshot) -> None:
        self._place.set_content(_table(log_rows(list(self._session.ros.log), bool(self._all.value))))
