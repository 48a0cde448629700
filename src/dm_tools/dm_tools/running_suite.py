"""State of the running suite for the verbs: which nodes run, who holds the mirror, and the present shape."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from dm_bringup.nodes import NAMES
from dm_common.errors import HISTORY_UNKNOWN, ErrorCode
from dm_common.figures import distinct_from, in_nanometres
from dm_common.limits import AT_LIMIT
from dm_common.mirror import actuators_text
from dm_tools.output import NotRunningError, errors

if TYPE_CHECKING:
    from dm_client import DeformableMirrorClient

#: Time in which nodes on this machine are found, s: usually, and on a busy machine.
FIND_S = 1.2
BUSY_S = 5.0
#: Time in which every node reports its health, and an action its progress, s.
REPORT_S = 1.5
#: Curvatures of the spheres in [1] (docs/references.md), section 3.2, 1/m.
CURVATURES = tuple(round(-0.05 + 0.01 * step, 3) for step in range(11))
#: A predicted error is mentioned from this size on, m.
MENTIONED = 0.5e-9

#: Nodes without which there is no bench, and the effect when one is missing.
NEEDED = {
    "pdm_driver": "nothing can move, and the signals at the electronics are not known",
    "interferometer": "no maps can be measured",
    "calibration": "no calibration can be made or loaded",
    "focus_controller": "no curvature can be asked for",
}


def usual_spheres(capabilities: Any) -> tuple[float, ...]:
    """Curvatures, 1/m, of the spheres in [1], or eleven over the range of a mirror that does not reach them.

    Raises RuntimeError when it reaches none.
    """
    low, high = capabilities.curvature_min, capabilities.curvature_max
    if not low <= high:
        raise RuntimeError(capabilities.message)
    if low <= CURVATURES[0] and CURVATURES[-1] <= high:
        return CURVATURES
    spheres = (low + (high - low) * (0.02 + 0.096 * step) for step in range(11))
    return tuple(float(f"{curvature:.4g}") for curvature in spheres)


def nodes_of_suite(client: DeformableMirrorClient) -> Counter[str]:
    """How often each node of the suite runs in the client's namespace."""
    place = client.node.get_namespace()
    found = client.node.get_node_names_and_namespaces()
    return Counter(name for name, where in found if where == place and name in NAMES)


def where(client: DeformableMirrorClient) -> str:
    """The ROS domain and namespace that the client looks at."""
    return f"in the ROS domain {os.environ.get('ROS_DOMAIN_ID') or '0'}, namespace {client.node.get_namespace()}"


@contextmanager
def running_suite(namespace: str) -> Iterator[DeformableMirrorClient]:
    """A client of the suite that runs in this namespace. Raises NotRunningError when none of its nodes is found."""
    from dm_client import DeformableMirrorClient

    with DeformableMirrorClient(namespace) as client:
        if not client.wait(lambda: nodes_of_suite(client), FIND_S):
            errors.print(f"no node of the suite found yet {where(client)}: ./dm up starts it")
            if not client.wait(lambda: nodes_of_suite(client), BUSY_S - FIND_S):
                others = {place for name, place in client.node.get_node_names_and_namespaces() if name in NAMES}
                seen = f"; some are running in {', '.join(sorted(others))} (--namespace)" if others else ""
                raise NotRunningError(f"no node of the suite is running {where(client)}{seen}: start it with ./dm up")
        yield client


def latest_message(client: DeformableMirrorClient, topic: str, timeout_s: float) -> Any:
    """The latest message of a topic that the client follows; None = none came in time."""
    client.wait(lambda: topic in client.messages, timeout_s)
    return client.messages.get(topic)


def promise(bound: float) -> str:
    """A 95 % bound on the largest coefficient error (m) as text, the same in all verbs."""
    return f"{in_nanometres(bound)} (95 % bound)" if bound > 0.0 else "not known"


def promise_of(calibration: Any) -> float:
    """95 % bound on the largest coefficient error of a request without creep, m, from a calibration's message."""
    from dm_common.hysteresis.model import request_error
    from dm_common.messages import hysteresis_model_from

    without_law = hysteresis_model_from(calibration.hysteresis) is None
    return request_error(calibration, None if without_law else calibration.hysteresis)


def saturation_text(state: Any, mirror: Any) -> str:
    """Which limits the signals of a dm_msgs/FocusState are at, by actuators; `mirror`: mirror_info, None: not heard."""
    if mirror is None:
        return actuators_text(state.saturated_actuators, "at a limit")
    low, high = mirror.signal_min + AT_LIMIT, mirror.signal_max - AT_LIMIT
    inside = {number for number in state.saturated_actuators if low < state.signals[number - 1] < high}
    at_end = actuators_text(sorted({*state.saturated_actuators} - inside), "at an end of the range")
    return ", ".join(filter(None, (at_end, actuators_text(sorted(inside), "at the limit between neighbours"))))


def unknown_history(capabilities: Any) -> str:
    """Why the focus controller does not know the history of the actuators; "" = it does, or is not heard."""
    said = capabilities.message.split("; ") if capabilities is not None else []
    return next((text.removeprefix(HISTORY_UNKNOWN) for text in said if text.startswith(HISTORY_UNKNOWN)), "")


def calibration_refused(capabilities: Any) -> bool:
    """Whether the focus controller does not use the calibration that is published."""
    refused = (ErrorCode.CALIBRATION_MISMATCH, ErrorCode.CALIBRATION_UNREADABLE)
    return capabilities is not None and capabilities.error_code in refused


def ago(seconds: float) -> str:
    """A time that has passed, in the unit that fits it; negative = by another clock, as with simulated time."""
    if seconds < 0.0:
        return "(by another clock) an unknown time"
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"


def kept(promised: float, measured: float) -> bool:
    """Whether a measured largest coefficient error (m) is inside the promise; 0 = nothing is promised."""
    return measured <= promised or not promised > 0.0


def verdict(promised: float, measured: float) -> str:
    """Promised (0 = not known) and measured largest coefficient error (m), and whether the promise was kept."""
    judged = "[green]inside[/]" if kept(promised, measured) else "[red]outside[/]"
    found = f"promised {promise(promised)}, measured {distinct_from(measured, promised)}"
    return f"{found}: {judged}" if promised > 0.0 else found


def holder(client: DeformableMirrorClient) -> str:
    """Who holds the mirror and since when, as reported by the driver, and the progress made; "" = nobody."""
    from dm_client.client import INTERFACES
    from dm_tools.long_actions import LONG, ExternalGoals

    state = latest_message(client, "actuator_state", BUSY_S)
    if state is None or not state.holder:
        return ""
    holding = state.holding.partition(": ")[0]  # without the driver's hint how to end it: the commands give their own
    goals = [ExternalGoals(client.node, INTERFACES[name], name) for name in LONG]
    client.wait(lambda: any(goal.running for goal in goals), 0.5)
    running = next((goal for goal in goals if goal.running), None)
    if running is None:
        return holding
    client.wait(lambda: running.feedback, REPORT_S)
    step, steps = (getattr(running.feedback, field, 0) for field in ("step", "steps"))
    return f"{holding} (step {step}{f' of {steps}' if steps else ''})" if step or steps else holding


@contextmanager
def naming_holder(client: DeformableMirrorClient) -> Iterator[None]:
    """Add to the error of a request that is refused in this block who holds the mirror, and how to end that.

    NOT_CALIBRATED is treated as BUSY is: while the first calibration runs, it alone does not explain the refusal.
    """
    from dm_client import DeformableMirrorError

    try:
        yield
    except DeformableMirrorError as error:
        if error.error_code in (ErrorCode.BUSY, ErrorCode.NOT_CALIBRATED) and (by := holder(client)):
            none = "no calibration is in use yet; " if error.error_code == ErrorCode.NOT_CALIBRATED else ""
            text = f"{none}{by}: wait for its end, or cancel it (Ctrl-C where it was started, or ./dm console)"
            # Taking over is no help against a goal of the same action, nor before there is a calibration.
            if error.response is not None and error.error_code == ErrorCode.BUSY:
                text += ", or end it with --take-over"
            raise DeformableMirrorError(error.error_code, text, error.response) from error
        raise


def receive_health(client: DeformableMirrorClient, times: list[int] | None = None) -> dict[str, Any]:
    """{node: its latest status on /diagnostics}, filled from now on, as is `times` with times of the bench, s."""
    from diagnostic_msgs.msg import DiagnosticArray

    health: dict[str, Any] = {}

    def take(message: Any) -> None:
        for status in message.status:
            place, _, name = status.name.rpartition("/")
            if place == client.node.get_namespace().lstrip("/"):
                health[name] = status
                if times is not None and name in NEEDED:
                    times.append(message.header.stamp.sec)

    client.node.create_subscription(DiagnosticArray, "/diagnostics", take, 10)
    return health


class SettledShape(NamedTuple):
    """The present shape, as the controller reports it.

    Attributes:
        curvature: 1/m.
        seconds: since its command.
        bound: m, 95 % bound on its largest coefficient error.
        held: it is corrected for creep.
        predicted: m, the part of that error that was predicted: it is due to the limits, and maps should show it.
        conditioned: it was set after a degauss, by a recipe where there is one.
    """

    curvature: float
    seconds: float
    bound: float
    held: bool
    predicted: float
    conditioned: bool


def settled_shape(health: dict[str, Any]) -> SettledShape | None:
    """The present shape; None = it was not requested as a curvature."""
    controller = health.get("focus_controller")
    values = {pair.key: pair.value for pair in controller.values} if controller is not None else {}
    if "curvature" not in values:
        return None
    curvature, age, bound, predicted = (float(values[name]) for name in ("curvature", "age", "bound", "predicted"))
    held, conditioned = (values[name] == "True" for name in ("held", "conditioned"))
    return SettledShape(curvature, age, bound, held, predicted, conditioned)
