"""What the driver last said, whether it still says anything, and whether it took the last command.

A driver that is stopped or was killed tells nobody: its last report says for ever that it is active. So reports grow
old here, by the steady clock, and a command that no report confirms is told of.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, NamedTuple

from dm_msgs.msg import ActuatorCommand, ActuatorState, FocusRequest

from dm_common.errors import ErrorCode, Refusal
from dm_controller.request_checks import check_driver


class _Sent(NamedTuple):
    command: ActuatorCommand
    request: FocusRequest | None
    at: float


class DriverWatch:
    """May be asked from any thread.

    Args:
        values: parameter `driver_timeout`.

    Attributes:
        latest: the driver's last report; None before the first.
        starts: how often the driver was activated anew, as far as reports tell.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        self.latest: ActuatorState | None = None
        self.starts = 0
        self._heard = 0.0
        self._sent: _Sent | None = None

    def observe(self, report: ActuatorState) -> None:
        """Take the driver's next report."""
        before, self.latest, self._heard = self.latest, report, time.monotonic()
        if before is not None and report.sequence < before.sequence:
            self.starts += 1
        sent = self._sent
        if sent is not None and report.requested == sent.command.signals:
            self._sent = None

    def sent(self, command: ActuatorCommand, request: FocusRequest | None) -> None:
        """This command went out, for `request` or, None, for nobody who waits."""
        self._sent = _Sent(command, request, time.monotonic())

    @property
    def silent(self) -> str:
        """That the driver does not report any more, in words; "" = it does, or never did."""
        limit = self._values["driver_timeout"]
        age = time.monotonic() - self._heard
        if self.latest is None or not limit or age <= limit:
            return ""
        return f"pdm_driver has not reported for {age:.1f} s (driver_timeout {limit:g} s): is it running?"

    def check(self) -> None:
        """Raise Refusal when the driver, by its last report and the age of that, takes no commands."""
        check_driver(self.latest)
        if silent := self.silent:
            raise Refusal(ErrorCode.DRIVER_UNAVAILABLE, silent)

    @property
    def stopped(self) -> str:
        """Why what was begun with the driver will not end any more, in words; "" = it may: a lost link comes back."""
        report = self.latest
        if report is not None and report.driver_state in (
            ActuatorState.STATE_UNCONFIGURED, ActuatorState.STATE_INACTIVE, ActuatorState.STATE_SAFING
        ):  # fmt: skip
            return "pdm_driver left its active state" + (f": {report.message}" if report.message else "")
        return self.silent

    def untaken(self) -> tuple[FocusRequest | None, Refusal] | None:
        """The request whose command the driver has not confirmed in time, and why; each is told once.

        None = there is none. A command that went out later is the one that counts: the latest wins at the driver too.
        """
        sent, limit = self._sent, self._values["driver_timeout"]
        if sent is None or not limit or time.monotonic() - sent.at <= limit:
            return None
        self._sent = None
        words = f"the driver has not taken the command within {limit:g} s"
        try:
            self.check()
        except Refusal as refusal:
            return sent.request, Refusal(refusal.error_code, f"{words}: {refusal}")
        report = self.latest
        assert report is not None  # else the check had refused
        if report.error_code != ErrorCode.OK:
            return sent.request, Refusal(report.error_code, f"{words}: {report.message}")
        return sent.request, Refusal(ErrorCode.PREEMPTED, f"{words}: it follows another one")
