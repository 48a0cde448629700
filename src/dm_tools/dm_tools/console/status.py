"""State of the bench in words: badges, what is missing, why something is not possible, diagnostics and log."""

import re
from collections.abc import Collection, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from dm_msgs.msg import ActuatorState, Capabilities

from dm_common.figures import in_nanometres
from dm_tools.console.view_models import QUALITIES
from dm_tools.running_suite import NEEDED, ago, settled_shape

DRIVER_STATES = {
    ActuatorState.STATE_UNCONFIGURED: "not configured",
    ActuatorState.STATE_INACTIVE: "inactive",
    ActuatorState.STATE_ACTIVE: "active",
    ActuatorState.STATE_LINK_LOST: "link lost",
    ActuatorState.STATE_SAFING: "going to the safe shape",
}
LEVELS = {
    DiagnosticStatus.OK: "ok",
    DiagnosticStatus.WARN: "warning",
    DiagnosticStatus.ERROR: "error",
    DiagnosticStatus.STALE: "stale",
}

#: Paths of files, as nodes write them: at least two folders deep below a folder of the system or a home.
_PATH = re.compile(r"(?<![\w/.])/(?:home|root|tmp|var|opt|mnt|media|srv|data|work|Users)(?:/[^\s/,;:'\"()]+)+")


def shortened(text: str) -> str:
    """Shorten every path in `text` to its last part: readers of the page know the folders."""
    return _PATH.sub(lambda match: f"…/{match[0].rsplit('/', 1)[-1]}", text)


def badges(snapshot: Any, doubt: str) -> list[tuple[str, str]]:
    """(text, kind) of mirror, driver, calibration and history, in a few words each; kind is "", "doubt" or "bad".

    `doubt` = why the history is not known, "" = it is.
    """
    mirror, state, calibration = snapshot.mirror_info, snapshot.actuator_state, snapshot.calibration
    shown = [(f"{mirror.name} {mirror.serial}", "")] if mirror is not None else [("no mirror", "bad")]
    if "pdm_driver" not in snapshot.health or state is None:
        shown.append(("driver: not heard", "bad"))
    else:
        active = state.driver_state == ActuatorState.STATE_ACTIVE
        text = DRIVER_STATES.get(state.driver_state, "?") + (", moving" if state.moving else "")
        shown.append((f"driver: {text}", "" if active else "bad"))
    if calibration is None:
        shown.append(("no calibration", "doubt"))
    else:
        kind = "" if calibration.quality == Capabilities.CALIBRATED else "doubt"
        shown.append((f"{QUALITIES.get(calibration.quality, '?')}: {calibration.id}", kind))
        if calibration.hysteresis.play_radius:
            shown.append(("history: not known", "doubt") if doubt else ("history: known", ""))
    worst = max((ord(bytes(status.level)) for status in snapshot.health.values()), default=0)
    if worst:
        text = LEVELS.get(bytes([worst]), "?")
        shown.append((f"diagnostics: {text}", "bad" if worst >= ord(DiagnosticStatus.ERROR) else "doubt"))
    return shown


def missing(present: Collection[str], mirror_known: bool) -> list[str]:
    """Sentences on the nodes and the mirror information that are missing, and on the consequences."""
    if not NEEDED.keys() & present:
        return ["No node of the suite is heard. Start them (./dm up) or check the namespace and the ROS domain."]
    lines = [f"The node {name} is not heard: {effect}." for name, effect in NEEDED.items() if name not in present]
    if "pdm_driver" in present and not mirror_known:
        lines.append("The driver has not published which mirror it drives (topic mirror_info).")
    return lines


def reason_against(need: str, snapshot: Any, running: str) -> str:
    """Why an operation is not possible now, in a sentence; "" = it is.

    Args:
        need: what it needs: "move" (the driver), "focus" (driver and calibration), "measure" (the interferometer),
            "calibrate" (driver and interferometer), "converge" (all), "store" (the node calibration).
        running: title of the operation under way, "" = none.
    """
    if running:
        return f"{running} is under way."
    nodes = {
        "move": ["pdm_driver"],
        "focus": ["pdm_driver", "focus_controller"],
        "measure": ["interferometer"],
        "calibrate": ["pdm_driver", "interferometer", "calibration"],
        "converge": ["pdm_driver", "interferometer", "focus_controller"],
        "store": ["calibration"],
    }[need]
    for name in nodes:
        if name not in snapshot.health:
            return f"The node {name} is not heard."
    state = snapshot.actuator_state
    if "pdm_driver" in nodes:
        if state is None:
            return "The driver has not reported yet."
        if state.driver_state != ActuatorState.STATE_ACTIVE:
            reason = f": {state.message}" if state.message else ""
            return f"The driver is {DRIVER_STATES.get(state.driver_state, 'in an unknown state')}{reason}."
    if need in ("focus", "converge"):
        capabilities = snapshot.capabilities
        if capabilities is None or not capabilities.calibration_id:
            return "The mirror is not calibrated: run a calibration or load one."
        if capabilities.error_code:
            return f"Requests are refused: {capabilities.message}."
    return ""


def diagnostic_rows(statuses: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    """(level, node, message, figures) of the latest status of each node, the worst first."""
    worst_first = sorted(statuses.values(), key=lambda status: (-ord(bytes(status.level)), status.name))
    return [
        (
            LEVELS.get(bytes(status.level), "?"),
            status.name,
            status.message,
            ", ".join(f"{pair.key} {pair.value}" for pair in status.values if pair.value),
        )
        for status in worst_first
    ]


def log_rows(lines: Sequence[tuple[str, str, str, str]], everything: bool) -> list[tuple[str, str, str, str]]:
    """(time, level, logger, message) of the log's lines, the newest first."""
    return [line for line in reversed(lines) if everything or line[1] in ("WARN", "ERROR", "FATAL")]


def now_text(snapshot: Any) -> str:
    """Present state of the mirror and who holds it, in one line."""
    state = snapshot.actuator_state
    for name in ("pdm_driver", "focus_controller"):
        if name not in snapshot.health or state is None:
            return f"now: not known, {name} is not heard"
    holds = f"; {state.holder} holds the mirror" if state.holder else ""
    if state.moving:
        return f"now: moving{holds}"
    if (shape := settled_shape(snapshot.health)) is None:
        return f"now: not at a curvature that was asked for{holds}"
    held = ", held" if shape.held else ""
    bound = f"within {in_nanometres(shape.bound)} (95 %)"
    return f"now: {shape.curvature:+.4f} 1/m for {ago(shape.seconds)}, {bound}{held}{holds}"
