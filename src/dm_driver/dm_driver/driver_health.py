"""The driver's health on /diagnostics, and what it logs of the link."""

import math
from collections.abc import Mapping

from dm_common.errors import ErrorCode, Refusal
from dm_common.ros.lifecycle import ERROR, OK, WARN, Health
from dm_driver.actuator_writer import ActuatorWriter
from dm_driver.moves import WriterState

#: Time after the configuration, s, for which a silent unit is awaited, since the driver may have been started first;
#: later it counts as missing.
AWAIT_S = 15.0


class LinkLog:
    """What to log of the link to the electronics: each change once, and an error only where something is wrong.

    `now` is the steady time of the configuration, s.
    """

    def __init__(self, now: float) -> None:
        self._began = now
        self._up, self._logged = False, ""

    def news(self, state: WriterState, now: float) -> tuple[str, str] | None:
        """Severity ("info" or "error") and text of what is to be logged now; None = nothing."""
        if state.link_up:
            text = "" if self._up else "the link to the drive electronics is up"
            self._up, self._logged = True, ""
            return ("info", text) if text else None
        if state.fault in ("", "closed"):
            return None
        missing = self._up or now - self._began > AWAIT_S
        severity = "error" if missing else "info"
        text = f"{state.fault}; {'trying again' if missing else 'waiting for the drive electronics'}"
        # While the unit is awaited, the exact error is of no interest.
        key = text if missing else "awaited"
        self._up, before, self._logged = False, self._logged, key
        if missing:
            self._began = -math.inf
        return (severity, text) if key != before else None


def driver_health(
    writer: ActuatorWriter | None, refusal: Refusal | None, refused: Mapping[str, int], trouble: str = ""
) -> Health:
    """Judge the driver: level, one line for a person, and counts (refusals since the start, others since the
    configuration). Arguments are the attributes of `CommandGate`.
    """
    values: dict[str, object] = {f"refused {name}": count for name, count in sorted(refused.items())}
    if writer is None:
        return Health(ERROR, trouble, values) if trouble else Health(WARN, "not configured", values)
    state, counters = writer.state(), writer.counters
    values |= {
        "refused total": sum(refused.values()),
        "frames written": counters.frames,
        "link losses": counters.link_losses,
        "reconnects": counters.reconnects,
        "overtaken": counters.overtaken,
        "overruns": counters.overruns,
        "history known": state.history_known,
        "moving": state.moving.value if state.moving is not None else "no",
    }
    if not state.link_up:
        return Health(ERROR, f"link lost: {state.fault}", values)
    if not state.enabled:
        return Health(WARN, "inactive: commands are refused", values)
    if writer.unrecorded:
        return Health(WARN, f"{writer.unrecorded}; if the driver is killed, its next start moves in one step", values)
    # A refusal for want of a link is out of date, as the link is up.
    if refusal is not None and refusal.error_code != ErrorCode.ELECTRONICS_UNREACHABLE:
        return Health(WARN, f"the last command was refused: {refusal}", values)
    if not state.history_known:
        return Health(WARN, "active; the actuators' history is not known: a degauss makes it known", values)
    return Health(OK, "active", values)
