"""The card of log and diagnostics."""

from __future__ import annotations

from html import escape

from nicegui import ui

from dm_controller.console.ros_side import Snapshot
from dm_controller.console.session import Session
from dm_controller.console.status import diagnostic_rows, log_rows
from dm_controller.console.widgets.parts import card


def _table(rows: list[tuple[str, ...]]) -> str:
    cells = ("".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows)
    return "<table>" + "".join(f"<tr>{row}</tr>" for row in cells) + "</table>"


class DiagnosticsCard:
    """What the nodes say of their health, the worst first."""

    def __init__(self) -> None:
        self._shown = ""
        with card("Diagnostics", "last"):
            self._place = ui.html("", sanitize=False).classes("scroll")
            self._place.props('tabindex="0" role="region" aria-label="Diagnostics"')

    def refresh(self, snapshot: Snapshot) -> None:
        content = "".join(
            f'<div class="status"><b>{escape(row.level)}: {escape(row.node)}</b> {escape(row.message)}'
            f'<div class="faint">{escape(row.figures)}</div></div>'
            for row in diagnostic_rows(snapshot.diagnostics)
        )
        if content != self._shown:
            self._shown = content
            self._place.set_content(content)


class LogCard:
    """What the nodes logged since the console was started, the newest first."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._shown: tuple[int, bool] | None = None
        with card("Log"):
            self._all = ui.switch("Show everything, not only warnings and errors", value=True)
            self._place = ui.html("", sanitize=False).classes("scroll")
            self._place.props('tabindex="0" role="log" aria-label="Log"')

    def refresh(self, _snapshot: Snapshot) -> None:
        log = self._session.ros.log
        key = (log.count, bool(self._all.value))
        if key != self._shown:
            self._shown = key
            self._place.set_content(_table(log_rows(list(log.lines), bool(self._all.value))))
