"""A calibration run as read from a recording, and the calibration made again from it."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from types import SimpleNamespace
from typing import Any

import numpy as np
from dm_msgs.msg import ActuatorHysteresis
from dm_msgs.msg import Calibration as CalibrationMsg
from rclpy.parameter import parameter_value_to_python
from rclpy.serialization import deserialize_message

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_messages import calibration_message
from dm_calibration.calibration_parameters import PARAMETERS, fit_options, procedure_options
from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.procedure.recorded_run import Move, RecordedRun, RecordingError, repeat_run
from dm_common.measurement import Measurement
from dm_common.messages import measurement_from, mirror_from, stamp_ns
from dm_common.mirror import Mirror
from dm_controller.planning.active_calibration import model_of
from dm_tools.recording.bag import PARAMETER_EVENTS, BagReader, Message
from dm_tools.recording.interfaces import message_class

#: Topics that a calibration is made again from; the last part of their names.
FEEDBACK = "calibrate/_action/feedback"
TOPICS = ("mirror_info", "actuator_state", "zernike", "surface_samples", "surface_map_info", "calibration", FEEDBACK)


def _arrays(kind: Any) -> list[str]:
    """The fields of a message that are arrays of numbers of any length."""
    return [name for name, type_name in kind.get_fields_and_field_types().items() if type_name == "sequence<double>"]


#: Fields of dm_msgs/Calibration that must agree to the last bit.
COMPARED = (
    *_arrays(CalibrationMsg),
    *(f"hysteresis.{name}" for name in (*_arrays(ActuatorHysteresis), "creep_rate", "creep_slope")),
)


@dataclass(frozen=True, eq=False)
class Session:
    """One calibration run of a recording, ready to be made again.

    Attributes:
        run: what was commanded and measured.
        parameters: of the node `calibration`, defaults where the recording has none.
        published: the message on `calibration` that the run ended with; None = it was not activated.
        remarks: sentences on what the recording does not hold.
    """

    run: RecordedRun
    parameters: dict[str, Any]
    published: Any
    remarks: tuple[str, ...]


def read_session(bag: BagReader, number: int = 0, namespace: str = "") -> Session:
    """Run `number` (1 = the first, 0 = the last) of the recording.

    Raises:
        RecordingError: no such run, topics that are missing, or messages that another version recorded.
        BagError: the file is damaged.
    """
    prefix = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
    missing = [name for name in TOPICS if prefix + name not in bag.topics]
    if missing:
        hint = " (`ros2 bag record` with --include-hidden-topics)" if FEEDBACK in missing else ""
        raise RecordingError(
            f"{bag.path}: no topic {', '.join(prefix + name for name in missing)}: record them all{hint}"
        )
    received: dict[str, list[tuple[int, Any]]] = {name: [] for name in TOPICS}
    for message in bag.read([prefix + name for name in TOPICS]):
        received[message.topic.name.removeprefix(prefix)].append((message.log_time, _decode(message)))
    runs = _runs(received[FEEDBACK])
    if not runs:
        raise RecordingError(f"{bag.path}: no calibration was run in it (no message on {prefix}{FEEDBACK})")
    if not 0 <= number <= len(runs):
        raise RecordingError(f"run = {number}: must be 1 to {len(runs)}, or 0 (the last)")
    index = (number or len(runs)) - 1
    (begun, first), (ended, _last) = runs[index][0], runs[index][-1]
    end = runs[index + 1][0][0] if index + 1 < len(runs) else np.iinfo(np.int64).max
    mirrors = [info for time, info in received["mirror_info"] if time <= ended]
    if not mirrors:
        raise RecordingError(f"{bag.path}: no mirror_info before the run ended: begin the recording earlier")
    mirror = mirror_from(mirrors[-1])
    during = {
        name: [message for time, message in messages if begun <= time < end] for name, messages in received.items()
    }
    maps = _maps(during)
    moves = [move for time, move in _moves(received["actuator_state"], mirror) if begun <= time < end]
    before = [message for time, message in received["calibration"] if time < begun and message.id]
    run = RecordedRun(mirror, tuple(moves), maps, first.feedback.plan, model_of(before[-1]) if before else None)
    parameters, remarks = _parameters(bag, f"{prefix}calibration", begun)
    stamps = {measured.stamp_ns for measured in maps}  # including maps taken after the run
    known = {message.id for message in before}
    made = [each for each in during["calibration"] if each.id not in known and stamp_ns(each.header.stamp) in stamps]
    return Session(run, parameters, made[0] if made else None, remarks)


def recalibrate(session: Session, identifier: str, created_ns: int) -> Calibration:
    """The calibration of a recorded run, made again from its maps.

    Raises:
        RecordingError: the recording does not hold the whole run.
        TooFewMapsError, ValueError: as in a live calibration.
    """
    values, run = session.parameters, session.run
    _plan, outcome = repeat_run(run, procedure_options(values))
    provenance = Provenance(identifier, created_ns, "made again from a recording")
    return calibrate(outcome, mirror=run.mirror, options=fit_options(values), provenance=provenance)


def differences(calibration: Calibration, published: Any) -> list[str]:
    """Names of the fields of the message `published` that `calibration` does not give to the last bit."""
    again = calibration_message(calibration, None, "", 0.0)
    return [name for name in COMPARED if not _same(*map(attrgetter(name), (again, published)))]


def _same(one: Any, other: Any) -> bool:
    return np.asarray(one, dtype=np.float64).tobytes() == np.asarray(other, dtype=np.float64).tobytes()


def _decode(message: Message) -> Any:
    topic = message.topic
    try:
        return deserialize_message(message.data, message_class(topic.type_name))
    except RuntimeError as error:  # of the middleware
        raise RecordingError(
            f"{topic.name}: {topic.type_name} had another layout when it was recorded: only the version that recorded "
            "it can make the calibration again"
        ) from error


def _runs(messages: Iterable[tuple[int, Any]]) -> list[list[tuple[int, Any]]]:
    """The messages of each goal, with their times; goals in the order they began."""
    runs: dict[bytes, list[tuple[int, Any]]] = {}
    for time, message in messages:
        runs.setdefault(bytes(message.goal_id.uuid), []).append((time, message))
    return list(runs.values())


def _moves(states: Iterable[tuple[int, Any]], mirror: Mirror) -> Iterator[tuple[int, Move]]:
    """The moves that ended, with the time received; each is in the first message in which `turns` has changed."""
    turns: int | None = None
    degausses = 0
    for time, state in states:
        requested, applied = np.array(state.requested), np.array(state.applied)
        if requested.size != mirror.actuators or state.moving:
            continue
        if turns is not None and state.turns != turns:
            yield time, Move(stamp_ns(state.header.stamp), requested, applied, state.degausses != degausses)
        turns, degausses = state.turns, state.degausses


def _maps(messages: dict[str, list[Any]]) -> tuple[Measurement, ...]:
    """The maps in the order of their stamps, put together from the messages of their topics."""
    parts: dict[int, dict[str, Any]] = {}
    for topic, part in (("zernike", "zernike"), ("surface_samples", "samples"), ("surface_map_info", "info")):
        for message in messages[topic]:
            parts.setdefault(stamp_ns(message.header.stamp), {})[part] = message
    whole = [parts[stamp] for stamp in sorted(parts) if len(parts[stamp]) == 3]
    return tuple(measurement_from(SimpleNamespace(**each)) for each in whole)


def _parameters(bag: BagReader, node: str, begun: int) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Parameters of `node` when the run began, and what is not known of them."""
    defaults = {parameter.name: parameter.default for parameter in PARAMETERS}
    recorded: dict[str, Any] = {}
    # The recorder writes answers later than their stamps; only a finished file is read in order of time.
    for message in sorted(bag.read([PARAMETER_EVENTS]), key=lambda each: each.log_time):
        event, before = _decode(message), message.log_time < begun
        if event.node == node:
            for each in [*event.new_parameters, *(event.changed_parameters if before else ())]:
                if before or each.name not in recorded:  # the recorder may have been answered during the run
                    recorded[each.name] = parameter_value_to_python(each.value)
    missing = defaults.keys() - recorded.keys()
    remarks = (f"The recording does not hold all parameters of {node}; defaults are taken.",) if missing else ()
    return defaults | {name: value for name, value in recorded.items() if name in defaults}, remarks
