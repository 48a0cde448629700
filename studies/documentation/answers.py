"""The section Answers of docs/interfaces.md, from a run (`python -m studies.documentation.answers`).

Every case of `answer_cases` and `special_cases` is tried over ROS, one after another, on a calibrated mirror; the table
lists code and sentence. Whatever differs from run to run, names of files and measured figures, becomes an ellipsis.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from dm_msgs.action import Calibrate
from dm_msgs.msg import ActuatorState, FocusState
from rcl_interfaces.msg import Log

from dm_client.connection import Connection
from dm_common.errors import ErrorCode
from dm_common.ros import qos
from dm_common.ros.clients import ThreadedActionClient, call
from studies.documentation.answer_cases import CASES
from studies.documentation.special_cases import BENCH, HELD, HOLD, MAP, TOPICS
from studies.documentation.state_answers import SHOWN, Nodes

#: Topics that carry commands, with the topics and types of their answers.
ANSWERED_ON = {"actuator_command": ("actuator_state", ActuatorState), "focus_request": ("focus_state", FocusState)}
#: Figures that may be 0 in a refused answer: values of the request, values known anyway, and those where 0 = unknown.
KNOWN = {"curvature", "power", "conic_constant", "dioptre", "duration", "gain_drift", "offset_drift"}
KNOWN |= {"expected_max_zernike"}
PATIENCE_S = 120.0
#: Time for which focus is tracked before that is cancelled, s.
TRACK_S = 2.0
TITLE = "## Answers\n"
#: Codes whose sentences contain no measured figures.
EXACT = (
    ErrorCode.INVALID_LENGTH,
    ErrorCode.NOT_FINITE,
    ErrorCode.OUT_OF_RANGE,
    ErrorCode.INVALID_ARGUMENT,
    ErrorCode.NODE_INACTIVE,
)
PAGE = Path(__file__).resolve().parents[2] / "docs" / "interfaces.md"


@dataclass(frozen=True)
class Answer:
    """The answer to one call.

    Attributes:
        name: of the interface.
        values: as typed.
        code: ErrorCode; None = none, for parameters, the bench and lines of logs.
        message: as it came.
    """

    name: str
    values: str
    code: int | None
    message: str

    def sentence(self) -> str:
        """The message without the parts that differ from run to run."""
        text = re.sub(r"PDM30-37_\S+?Z|/\S+/(?:\S+\.dat\b)?|\S+\.dat\b", "…", self.message)
        text = re.sub(r"inside [-+]0\.\d{4} to [-+]0\.\d{4}", "inside … to …", text)  # what the calibration reaches
        text = re.sub(r"error is \S+ nm; nothing", "error is … nm; nothing", text)
        text = re.sub(r"; the range was swept: .*", "", text)  # which search serves depends on the images,
        text = re.sub(r" \+- \S+ dioptre", " dioptre", text)  # and only one of them knows its standard error
        exact = self.code is None or self.code in EXACT
        return text if exact else re.sub(r"(?<!\^)[-+]?\d+(\.\d+)?(e[-+]?\d+)?(?!\d*/m)", "…", text)


def fill(message: Any, values: Mapping[str, Any]) -> Any:
    """Set the fields of `message` from a mapping, nested ones too."""
    for name, value in values.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            kind = message.get_fields_and_field_types()[name].removeprefix("sequence<").rstrip(">").split("/")[-1]
            module = __import__("dm_msgs.msg", fromlist=[kind])
            setattr(message, name, [fill(getattr(module, kind)(), item) for item in value])
        else:
            setattr(message, name, value)
    return message


def parsed(values: str, names: Mapping[str, str]) -> dict[str, Any]:
    """Parse `values` to a mapping; `names` replaces the names that only the run knows."""
    for name, actual in names.items():
        values = values.replace(name, actual)
    values = re.sub(r"\[(\d+) x ([^\]]+)\]", lambda m: f"[{', '.join([m[2]] * int(m[1]))}]", values)
    return yaml.safe_load(f"{{{values}}}") or {}


def zeros(message: Any) -> set[str]:
    """The names of all figures in a message that are 0."""
    found = set()
    for name, kind in message.get_fields_and_field_types().items():
        if kind == "double" and getattr(message, name) == 0.0:
            found.add(name)
        elif "/" in kind and not kind.startswith("sequence"):
            found |= zeros(getattr(message, name))
    return found


class InterfaceCaller(Connection):
    """Calls every interface; see `Connection`."""

    def __init__(self, domain: int | None) -> None:
        topics = {topic: (kind, qos.STATE) for topic, kind in ANSWERED_ON.values()}
        super().__init__("answers", "", domain, topics, {}, timeout_s=60.0)
        node = self.node
        for name, (kind, _) in (CASES | BENCH).items():
            if hasattr(kind, "Goal"):
                self.clients[name] = ThreadedActionClient(node, kind, name)
            elif name not in ANSWERED_ON:
                self.clients[name] = node.create_client(kind, name)
        self._publishers = {name: self.node.create_publisher(CASES[name][0], name, qos.COMMAND) for name in ANSWERED_ON}
        self._log: list[Log] = []
        self.node.create_subscription(Log, "/rosout", self._log.append, 1000)
        self.start()

    def try_case(self, name: str, values: str, names: Mapping[str, str]) -> Answer:
        """Try one case."""
        kind, fields = (CASES | BENCH)[name][0], parsed(values, names)
        if name in ANSWERED_ON:
            answer = self._publish(name, fill(kind(), fields))
        elif hasattr(kind, "Goal"):
            answer = self._goal(self.clients[name], fill(kind.Goal(), fields))
        else:
            answer = call(self.clients[name], fill(kind.Request(), fields), PATIENCE_S)
        code = getattr(answer, "error_code", None)
        assert not code or zeros(answer) <= KNOWN, f"{name}: {values}: {zeros(answer) - KNOWN} = 0, not NaN"
        return Answer(name, values, code, answer.message)

    def try_topic(self, topic: str) -> Answer:
        """Publish wrong values on a topic with data until the receiving node reports them in its log."""
        kind, values, node = TOPICS[topic]
        messages = {name: part() for name, part in MAP.items() if topic in MAP}
        messages[topic] = fill(kind(), parsed(values, {}))
        publishers = [
            (self.node.create_publisher(type(message), name, qos.with_lease(qos.LATCHED)), message)
            for name, message in messages.items()
        ]
        words = (topic, values.partition(":")[0])
        self._log.clear()
        deadline, said = time.monotonic() + PATIENCE_S, ""
        while not said and time.monotonic() < deadline:
            for publisher, message in publishers:
                publisher.publish(message)
            time.sleep(0.05)
            lines = (line.msg for line in self._log if line.name == node)
            said = next((line for line in lines if any(word in line for word in words)), "")
        return Answer(topic, values, None, said)

    def _publish(self, name: str, message: Any) -> Any:
        topic, _ = ANSWERED_ON[name]
        publisher = self._publishers[name]
        self.wait(lambda: publisher.get_subscription_count() > 0)
        self.wait(lambda: topic in self.messages and not getattr(self.messages[topic], "moving", False), 3.0)
        before = self.messages.pop(topic, None)

        def answers() -> bool:
            now = self.messages.get(topic)
            return now is not None and (
                before is None or (now.error_code, now.message) != (before.error_code, before.message)
            )

        publisher.publish(message)
        time.sleep(0.2)
        self.wait(answers, 1.0)  # the first may be from before; one that keeps saying the same is the answer
        self.wait(lambda: topic in self.messages, 5.0)
        return self.messages.get(topic, before)

    def _goal(self, client: Any, goal: Any) -> Any:
        self.wait(client.server_is_ready)
        accepted = client.send_goal_async(goal)
        self.wait(accepted.done)
        finished = accepted.result().get_result_async()
        if getattr(goal, "track", False):  # tracking ends in no other way
            self.wait(finished.done, TRACK_S)
            accepted.result().cancel_goal_async()
        self.wait(finished.done, PATIENCE_S)
        return finished.result().result


def run() -> Iterator[Answer]:
    """Try every case on a bench of this run's own."""
    from dm_client import DeformableMirrorClient
    from dm_common.ros.domains import own_domain
    from dm_tools.demo.demo_bench import bench_config, running_bench
    from studies.quick_trigger import quick_trigger

    with tempfile.TemporaryDirectory() as temporary, own_domain() as domain:
        folder = Path(temporary)
        config = bench_config(folder, "off", 0.0, 3, 5.0)
        config["virtual_bench"] |= {"interferometer.pixels": 236, "clock.period": 0.05}
        config["virtual_bench"] |= {"camera.rate": 5.0, "camera.width": 64, "camera.height": 48}
        config["interferometer"]["trigger_command"] = quick_trigger(config["virtual_bench"]["trigger.port"])
        config["autofocus"] = {"optics.rest_distance": 10.0, "use_sim_time": True}
        config["calibration"] |= {"write_report": False, "settle_time": 0.1}
        with running_bench(config, folder, domain, DeformableMirrorClient) as client:
            done = client.calibrate(
                Calibrate.Goal(plan=Calibrate.Goal.PLAN_FULL, activate=True), lambda _feedback: None
            )
            last = max((folder / "maps").iterdir(), key=lambda path: path.stat().st_mtime)
            names = {"LONG": "x" * 5000, "IN_USE": done.id, "LAST_MAP": str(last)}
            caller = InterfaceCaller(domain)
            try:
                for name, (_, cases) in CASES.items():
                    yield from (caller.try_case(name, values, names) for values in cases)
                    time.sleep(0.2)  # for a move that the last case began
                yield caller.try_case("hold_mirror", HOLD, names)
                for name, cases in HELD.items():
                    caller.try_case("hold_mirror", HOLD, names)  # the last case took the mirror over
                    yield from (caller.try_case(name, values, names) for values in cases)
                nodes = Nodes(caller)
                nodes.check_every_parameter()
                yield from (
                    Answer(f"/{node} {name}", str(value), None, nodes.put(node, name, value) or "set")
                    for node, name, value in SHOWN
                )
                yield from (Answer(*answer) for answer in nodes.at_rest())
                yield from map(caller.try_topic, TOPICS)
                yield from (
                    caller.try_case(name, values, names) for name, (_, cases) in BENCH.items() for values in cases
                )
            finally:
                caller.close()


def section(answers: Iterator[Answer]) -> str:
    """The section, in Markdown."""
    lines = [
        TITLE,
        "Asked of a calibrated mirror on the virtual bench; `./dm exec python -m studies.documentation.answers` writes",
        "this section. `[37 x 0.0]` stands for so many values, LONG for a text of 5000 characters. `ros2 param set`",
        "knows no codes; every parameter of every node refuses, by its name, a value of another type, twice the",
        "largest and NaN. Of topics that carry data, the sentence is that in the log of the node that hears them.",
        "",
        "| interface | values | code | sentence |",
        "|---|---|---|---|",
    ]
    for answer in answers:
        code = f"{answer.code} {ErrorCode(answer.code).name}" if answer.code is not None else "-"
        sentence = answer.sentence().replace("|", r"\|")
        lines.append(f"| `{answer.name}` | `{answer.values}` | {code} | {sentence} |")
    return "\n".join(lines) + "\n"


def committed(page: str) -> str:
    """The section that a page holds; "" = none."""
    found = re.search(rf"(?ms)^{TITLE}.*?(?=^## )", page)
    return found[0] if found else ""


if __name__ == "__main__":
    before = PAGE.read_text()
    new = section(run()) + "\n"
    old = committed(before)
    PAGE.write_text(before.replace(old, new) if old else before.replace("## Commands\n", new + "## Commands\n", 1))
