"""The driver's health on /diagnostics."""

from __future__ import annotations

from collections.abc import Mapping

from dm_common.errors import ErrorCode, Refusal
from dm_common.ros.diagnostics import ERROR, OK, WARN, Health
from dm_driver.actuator_writer import ActuatorWriter


def driver_health(writer: ActuatorWriter | None, refusal: Refusal | None, refused: Mapping[str, int]) -> Health:
    """Judge the driver: level, one line for a person, and the counts since the configuration.

    Args:
        writer: None when the driver is not configured.
        refusal: of the last command, or of the configuration.
        refused: number of refused commands by the name of their code.
    """
    values: dict[str, object] = {f"refused {name}": count for name, count in sorted(refused.items())}
    if writer is None:
        if refusal is not None and refusal.error_code == ErrorCode.INVALID_ARGUMENT:
            return Health(ERROR, str(refusal), values)
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
    if refusal is not None:
        return Health(WARN, f"the last command was refused: {refusal}", values)
    if not state.enabled:
        return Health(WARN, "inactive: commands are refused", values)
    if not state.history_known:
        return Health(WARN, "active; the actuators' history is not known: a degauss makes it known", values)
    return Health(OK, "active", values)
