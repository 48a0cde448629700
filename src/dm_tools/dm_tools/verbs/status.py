"""`dm status`: the running suite on one screen."""

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dm_common.errors import ErrorCode
from dm_common.figures import accuracy_text
from dm_common.optics.conic import range_text
from dm_tools.output import JsonOption, NamespaceOption, console, in_namespace, write_json
from dm_tools.running_suite import (
    BUSY_S,
    NEEDED,
    SettledShape,
    ago,
    calibration_refused,
    holder,
    nodes_of_suite,
    promise,
    receive_health,
    running_suite,
    settled_shape,
    unknown_history,
    where,
)
from dm_tools.verbs.up import poke_check

#: A node not found within this time is not running, s: each announces itself every second; a busy machine may miss it.
MISSING_S = 10.0


def status(namespace: NamespaceOption = "", json: JsonOption = None) -> None:
    """Show on one screen what runs, the present shape and its error bound, and what to do next."""
    with running_suite(namespace) as client:
        times: list[int] = []
        health = receive_health(client, times)
        client.wait(lambda: set(NEEDED) <= nodes_of_suite(client).keys(), MISSING_S)
        client.wait(lambda: not _silent(nodes_of_suite(client), health), BUSY_S)
        client.wait(lambda: {"mirror_info", "calibration", "capabilities"} <= client.messages.keys(), 0.5)
        by = holder(client)
        found, place = nodes_of_suite(client), where(client)
    mirror, latest, capabilities, state = (
        client.messages.get(name) for name in ("mirror_info", "calibration", "capabilities", "actuator_state")
    )
    calibration = latest if latest is not None and latest.id else None
    shape, lacking = settled_shape(health), [name for name in NEEDED if not found[name]]
    twice = [name for name, count in found.items() if count > 1]
    rows = {
        "nodes": f"{', '.join(found)}: running {place}"
        + (f"; [red]not running: {', '.join(lacking)}[/]" if lacking else "")
        + (f"; [red]running more than once: {', '.join(twice)}[/]" if twice else ""),
        "mirror": f"{mirror.name} {mirror.serial}, {mirror.actuators} actuators" if mirror is not None else "not heard",
        "now": _now(by, shape, state),
        "calibration": _calibration(latest, times[-1] if times else time.time()),
        "promise": _promise(capabilities),
        "absolute": _absolute(capabilities, calibration),
        "health": _health(health, _silent(found, health), namespace),
        "next": in_namespace(
            _next(lacking, by, state, calibration, shape, capabilities, "virtual_bench" in found), namespace
        ),
    }
    for name, text in rows.items():
        console.print(f"[bold]{name:12s}[/]{text}")
    figures = {
        "nodes": list(found),
        "mirror": mirror.serial if mirror is not None else None,
        "held_by": by or None,
        "curvature": shape.curvature if shape else None,
        "bound_nm": 1e9 * shape.bound if shape else None,
        "calibration": calibration.id if calibration is not None else None,
        "error_bound_nm": 1e9 * capabilities.error_bound if capabilities and not capabilities.error_code else None,
    }
    write_json(json, {"status": figures})


def _silent(found: Mapping[str, int], health: dict[str, Any]) -> list[str]:
    """The nodes in `found` that have not reported their health."""
    return [name for name in NEEDED if found[name] and name not in health]


def _health(health: dict[str, Any], silent: list[str], namespace: str = "") -> str:
    """Health messages of the nodes that are not well, each sentence once; `silent` nodes have not said how they are."""
    said: dict[str, list[str]] = {"not heard": silent} if silent else {}
    for name, each in health.items():
        if each.level != b"\0":
            said.setdefault(each.message, []).append(name)
    texts = (f"{', '.join(names)}: {in_namespace(message, namespace)}" for message, names in said.items())
    return "; ".join(texts) or "ok"


def _now(by: str, shape: SettledShape | None, state: Any) -> str:
    if by:
        return by
    if shape is not None:
        return (
            f"{shape.curvature:+.4f} 1/m ({2 * shape.curvature:+.3f} dioptre) for {ago(shape.seconds)}, within "
            f"{promise(shape.bound)}{', held against creep' if shape.held else ''}"
        )
    if state is None or not state.applied:
        return "nothing was commanded yet, or the driver is not heard"
    low, high = (round(signal, 2) + 0.0 for signal in (min(state.applied), max(state.applied)))  # no "-0.00"
    moving = ", moving" if state.moving else ""
    return f"signals {low:+.2f} to {high:+.2f}, no requested curvature and so without a bound{moving}"


def _calibration(calibration: Any, now: float = 0.0) -> str:
    """The calibration in one line; its age at `now`, s in the time of the bench, which may not be the wall clock."""
    if calibration is None or not calibration.id:
        return "not heard" if calibration is None else "none in use"
    age = now - calibration.header.stamp.sec
    doubtful = sum(grade != "good" for grade in calibration.actuator_grade)
    law = f"law {calibration.hysteresis.law}" if calibration.hysteresis.play_radius else "[yellow]without hysteresis[/]"
    return (
        f"{calibration.id}: {calibration.maps_used} maps {ago(age)} ago, {law}; "
        f"{calibration.actuators - doubtful} of {calibration.actuators} actuators good"
    )


def _promise(capabilities: Any) -> str:
    if capabilities is None:
        return "not known: focus_controller is not heard"
    if capabilities.error_code:
        return f"none now: {capabilities.message}"
    remarks = capabilities.message.partition("; ")[2]  # the part after the range
    return (
        f"largest coefficient error within {promise(capabilities.error_bound)} in addition to the predicted error and "
        f"creep, from {range_text(capabilities.curvature_min, capabilities.curvature_max, '1/m')}; each move states "
        f"its own{f'; [yellow]{remarks}[/]' if remarks else ''}"
    )


def _absolute(capabilities: Any, calibration: Any) -> str:
    if capabilities is None or calibration is None or capabilities.error_code:
        return "not known"
    farthest = max(capabilities.curvature_min, capabilities.curvature_max, key=abs)
    farthest = math.trunc(1e4 * farthest) / 1e4  # as the range is printed
    at = f", at {farthest:+.4f} 1/m" if min(calibration.instrument_error, calibration.scale_error) > 0.0 else ""
    return accuracy_text(capabilities.error_bound, calibration, farthest) + at


def _next(
    lacking: list[str],
    by: str,
    state: Any,
    calibration: Any,
    shape: SettledShape | None,
    capabilities: Any,
    simulated: bool = False,
) -> str:
    if lacking:
        return "end ./dm up with Ctrl-C and start it again; ./dm doctor says more"
    doctor = f"./dm doctor{'' if simulated else ' --config FILE'}"
    if state is not None and state.driver_state == state.STATE_LINK_LOST:
        return f"the driver must reach the electronics first: {doctor} says what is wrong"
    if state is None or state.driver_state != state.STATE_ACTIVE:
        resting = state is not None and state.driver_state == state.STATE_INACTIVE
        first = "`ros2 lifecycle set /pdm_driver activate`; " if resting else ""
        return f"the driver must be active first: {first}{doctor} says what it lacks"
    if capabilities is not None and capabilities.error_code == ErrorCode.NODE_INACTIVE:
        return str(capabilities.message)
    if by:
        return "wait for its end; ./dm console shows how far it is, and can cancel it"
    if calibration is None and not simulated and not calibration_refused(capabilities):
        return f"./dm {poke_check(Path('FILE'))}; when it finds the wiring as configured, ./dm calibrate"
    if calibration is None or not calibration.hysteresis.play_radius or calibration_refused(capabilities):
        return "./dm calibrate"
    if unknown_history(capabilities):
        return "./dm degauss: the actuators' history is not known, and the promise is wider for it"
    if shape is None:
        return "./dm focus 0.02"
    if capabilities is not None and shape.predicted > capabilities.residual_tolerance:  # as refused when asked for now
        return "ask for the shape again: its command is from before the calibration changed, and misses it now"
    return "./dm check"
