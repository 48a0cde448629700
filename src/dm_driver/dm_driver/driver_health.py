"""The driver's health on /diagnostics."""

from __future__ import annotations

from collections.abc import Mapping

from dm_common.errors import ErrorCode
from dm_common.ros.diagnostics import ERROR, OK, WARN, Health
from dm_driver.actuator_writer import ActuatorWriter
from dm_driver.driver_messages import Complaint


def driver_health(writer: ActuatorWriter | None, complaint: Complaint, refused: Mapping[str, int]) -> Health:
    """Judge the driver: level, one line for a person, and the counts since the configuration.

    Args:
        writer: None when the driver is not configured.
        complaint: about the last command or the configuration.
        refused: refused commands by reason.
    """
    values: dict[str, object] = {f"refused {name}": count for name, count in sorted(refused.items())}
    if writer is None:
        if complaint.error_code == ErrorCode.INVALID_ARGUMENT:
            return Health(ERROR, complaint.message, values)
        return Health(WARN, "not configured", values)
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
    if complaint.error_code != ErrorCode.OK:
        return Health(WARN, f"the last command was refused: {complaint.message}", values)
    if not state.enabled:
        return Health(WARN, "inactive: commands are refused", values)
    if not state.history_known:
        return Health(OK, "active; hysteresis history unknown (a degauss makes it known)", values)
    return Health(OK, "active", values)
