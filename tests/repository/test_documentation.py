"""Every command in the documentation is tried: run on a virtual bench, watched, or checked against what it names.

How each is tried stands in `documentation`; a new block that nobody has classified fails here.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

import documentation as docs
from dm_bringup.nodes import LAUNCH_ARGUMENTS
from dm_bringup.suite import load_config, save_config
from dm_client import DeformableMirrorClient
from dm_common.ros.domains import own_domain
from dm_tools.cli import make_app
from dm_tools.demo.demo_bench import bench_config
from dm_tools.doctor.bench import parameters
from documentation import Block, blocks
from studies.documentation.parameters import TABLES
from studies.quick_trigger import quick_trigger
from support import wait_until

pytestmark = pytest.mark.processes

ROOT = docs.ROOT
BLOCKS = blocks()
SHELL = [(str(block), command) for block in BLOCKS if block.kind == "shell" for command in block.commands]
ROS = sorted({command for _, command in SHELL if command.startswith("ros2 ")})
INTERFACES = (ROOT / "docs" / "interfaces.md").read_text()
#: The longest that a command of the scene may take on a busy machine.
PATIENCE_S = 900.0
WAVELENGTH = 632.8e-9
#: Exit status of a command that Ctrl-C ended before it could prepare for it.
INTERRUPTED = 130


def numbered(kind: str) -> dict[tuple[str, int], Block]:
    """Blocks of one kind by page and number on it, from 1."""
    result: dict[tuple[str, int], Block] = {}
    for block in BLOCKS:
        if block.kind == kind:
            result[block.page, 1 + sum(page == block.page for page, _ in result)] = block
    return result


@pytest.mark.parametrize(("where", "command"), SHELL)
def test_every_command_is_classified(where: str, command: str) -> None:
    assert docs.classified(command), f"{where}: say in tests/documentation.py how {command!r} is to be tried"


def test_nothing_is_classified_that_the_documentation_does_not_say() -> None:
    said = {command for _, command in SHELL}
    known = {*docs.RUN, *docs.WATCHED, docs.SCENE, *docs.REPLAYED, *docs.PARSED, *docs.ELSEWHERE}
    assert known <= said
    assert {*docs.PRELUDES, *docs.PYTHON_ELSEWHERE} == numbered("python").keys()
    assert docs.TEXTS.keys() == {block.text.split("\n", 1)[0] for block in BLOCKS if block.kind == "text"}


def test_references_are_those_that_the_code_cites() -> None:
    listed = set(re.findall(r"(?m)^\[(\d+)\]", (ROOT / "docs" / "references.md").read_text()))
    cited = set()
    for path in (path for folder in ("src", "studies", "tests") for path in (ROOT / folder).rglob("*.py")):
        for text in (*docstrings(path), *re.findall(r"(?m)#:? .*$", path.read_text())):
            for numbers in re.findall(r"(?<![\w\]`])\[([1-9]\d*(?:, \d+)?)\]", text):
                cited |= set(numbers.split(", "))
    assert cited == listed


@pytest.mark.parametrize("package", sorted(path.parent.name for path in (ROOT / "src").glob("*/setup.py")))
def test_each_package_says_what_it_holds(package: str) -> None:
    rows = re.findall(r"(?m)^\| `(\w+)/?` \| \S", (ROOT / "src" / package / "README.md").read_text())
    modules = {path.stem for path in (ROOT / "src" / package / package).glob("[a-z]*")}
    assert set(rows) == modules, "the README's table and the modules differ"


@pytest.mark.parametrize(
    "page", [*docs.PAGES, *(ROOT / "src").glob("*/README.md")], ids=lambda path: f"{path.parent.name}/{path.name}"
)
def test_modules_and_files_that_are_named_exist(page: Path) -> None:
    text = page.read_text()
    for name in re.findall(r"`(src/[\w./-]+|tests/[\w./-]+|studies/[\w./-]+|examples/[\w./-]+)`", text):
        assert "PACKAGE" in name or (ROOT / name).exists(), f"{page.name} names {name}"
    for name in re.findall(r"\b(?:dm_[a-z]+|studies)(?:\.[A-Za-z_]\w*)+", text):
        package, *parts = name.split(".")
        top = ROOT / "src" / package / package if package.startswith("dm_") else ROOT / package
        if parts[0] not in ("msg", "srv", "action") and top.is_dir() and page.name != "CHANGELOG.md":
            assert is_there(top, parts), f"{page.name} names {name}"


def is_there(folder: Path, parts: list[str]) -> bool:
    """Whether these lead to a module, or to a name in one."""
    for number, part in enumerate(parts):
        if (folder / part).is_dir():
            folder /= part
        else:
            module = folder / f"{part}.py"
            names = parts[number + 1 :] if module.is_file() else parts[number:]
            return all(name in (module if module.is_file() else folder / "__init__.py").read_text() for name in names)
    return True


def docstrings(path: Path) -> Iterator[str]:
    """Of the module, its classes and functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
            yield ast.get_docstring(node) or ""


@cache
def dm_commands() -> dict[str, Any]:
    """The commands of `dm` by name."""
    group: Any = typer.main.get_command(make_app())
    return dict(group.commands)


def check_dm(command: str) -> None:
    """The options and values of a `./dm` command, by the command's own parser; nothing runs."""
    _dm, name, *arguments = shlex.split(command, comments=True)
    if name == "exec":
        if arguments[:2] == ["python", "-m"]:
            assert importlib.util.find_spec(arguments[2]) is not None, f"no module {arguments[2]}"
        return
    commands = dm_commands()
    assert name in commands, f"./dm has no command {name}"
    commands[name].make_context(name, arguments)


@pytest.mark.parametrize("command", sorted({c for _, c in SHELL if c.startswith("./dm ")}))
def test_options_exist(command: str) -> None:
    check_dm(command)


@pytest.mark.parametrize(("page", "command"), sorted(set(docs.inline_commands())))
def test_options_exist_within_the_text(page: str, command: str) -> None:
    """Placeholders are replaced; a command that is only named need not be whole."""
    for word, instead in (("…", "x.yaml"), ("FILE", "x.yaml"), ("LAW", "preisach"), ("METRES", "-1.5")):
        command = command.replace(word, instead)
    if len(command.split()) > 2:
        check_dm(command)
    else:
        assert command.split()[1] in {*dm_commands(), "exec", "--install-completion", "--show-completion"}


@pytest.mark.parametrize("place", sorted(numbered("yaml")), ids=str)
def test_parameter_files_hold_what_nodes_take(place: tuple[str, int], tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(numbered("yaml")[place].text)
    assert parameters(load_config(file)) is None


def filled(cls: Any, values: dict[str, Any]) -> Any:
    """A message with these fields; AttributeError or AssertionError where one does not fit."""
    message = cls()
    for name, value in values.items():
        setattr(message, name, filled(type(getattr(message, name)), value) if isinstance(value, dict) else value)
    return message


def message_class(type_name: str) -> Any:
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


@dataclass(frozen=True)
class RosCommand:
    """A command of ros2cli, taken apart."""

    verb: str
    name: str
    type: str = ""
    content: str = "{}"

    @staticmethod
    def parse(command: str) -> RosCommand:
        words = [word for word in shlex.split(command)[1:] if not word.startswith("--")]
        return RosCommand(" ".join(words[:2]), *words[2:])

    @property
    def message(self) -> Any:
        cls = message_class(self.type)
        part = {"service call": "Request", "action send_goal": "Goal"}.get(self.verb)
        return filled(getattr(cls, part) if part else cls, yaml.safe_load(self.content))


@pytest.mark.parametrize("command", ROS)
def test_commands_of_ros_name_what_exists(command: str) -> None:
    words = shlex.split(command)
    if words[1] == "launch":
        file = ROOT / "src" / words[2] / "launch" / words[3]
        for argument in words[4:]:
            assert argument.split(":=")[0] in {name for name, _default, _text in LAUNCH_ARGUMENTS}
        assert file.is_file()
        return
    if words[1] == "run":
        build = (ROOT / "examples" / "cpp" / "CMakeLists.txt").read_text()
        assert f"project({words[2]})" in build and f"add_executable({words[3]} " in build
        return
    if words[1:3] == ["param", "set"]:
        table = {parameter.name: parameter for parameter in TABLES[words[3].lstrip("/")]}
        assert table[words[4]].live, f"{words[4]} cannot be set while the node runs"
        table[words[4]].check(yaml.safe_load(words[5]))
        return
    parsed = RosCommand.parse(command)
    row = rf"\| \w+ \| `{re.escape(parsed.name.lstrip('/'))}` \| \[(\w+)\]"
    offered = re.findall(row, INTERFACES)
    assert offered, f"nothing is named {parsed.name}"
    if parsed.type:
        assert parsed.type.split("/")[-1] in offered
        parsed.message  # noqa: B018


@dataclass
class Scene:
    """A running bench in fast time, and the place where commands are typed."""

    folder: Path
    environment: dict[str, str]
    client: DeformableMirrorClient
    said: list[str] = field(default_factory=list)  # by the commands of the first hour

    def start(self, command: list[str], log: Path, domain: int | None = None) -> subprocess.Popen[bytes]:
        environment = self.environment | ({"ROS_DOMAIN_ID": str(domain)} if domain is not None else {})
        with log.open("wb") as output:
            return subprocess.Popen(command, cwd=self.folder, env=environment, stdout=output, stderr=subprocess.STDOUT)

    def run(self, command: list[str], domain: int | None = None) -> str:
        log = self.folder / "command.log"
        process = self.start(command, log, domain)
        try:
            status = process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise
        said = log.read_text(errors="replace")
        assert status == 0, f"{said}\nThe nodes:\n{(self.folder / 'up.log').read_text(errors='replace')[-3000:]}"
        return said

    def watch(self, command: str, words: str, domain: int | None = None) -> None:
        """Start, wait for `words`, press Ctrl-C; it must end well, or as a command that was interrupted."""
        log = self.folder / "watched.log"
        process = self.start(shlex.split(command), log, domain)
        try:
            wait_until(
                lambda: words in log.read_text(errors="replace") or process.poll() is not None, 90.0, f"{words!r}"
            )
            assert process.poll() is None, log.read_text(errors="replace")
            if command.startswith("./dm record"):  # it fails when there was nothing to record
                heard = partial(self.client.node.get_subscriptions_info_by_topic, "/actuator_state")
                wait_until(lambda: any(each.node_name.startswith("dm_recorder_") for each in heard()), 150.0)
            time.sleep(2.0)  # a moment of work, not only of starting
            process.send_signal(signal.SIGINT)
            assert process.wait(60.0) in (0, INTERRUPTED), log.read_text(errors="replace")
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """The documented `./dm up --config my_bench.yaml`, in a folder that looks like the checkout, with its own home."""
    folder = tmp_path_factory.mktemp("checkout")
    for name in ("dm", "src", "docs", "examples"):
        (folder / name).symlink_to(ROOT / name)
    home = folder / "home"
    config = bench_config(folder / "bench", "drawn_preisach", 0.01, 1, 5.0)  # the shipped mirror in fast time
    config["virtual_bench"] |= {"interferometer.pixels": 236, "clock.period": 0.02}
    config["interferometer"]["trigger_command"] = quick_trigger(config["virtual_bench"]["trigger.port"])
    config["calibration"] |= {"calibration_folder": "~/.ros/dm_calibrations", "load_on_start": "newest"}
    # 200 of 37 actuators: from fewer, slow creep is off where a busy machine delays the commands of a bench in fast
    # time. `./dm report` writes the report.
    config["calibration"] |= {"hysteresis_maps": 200, "write_report": False}
    home.mkdir()
    save_config(config, folder / "my_bench.yaml")
    with own_domain() as domain:
        # What tells a program that a test runs it would make NiceGUI wait for a browser of the test's.
        outside = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
        environment = {**outside, "HOME": str(home), "ROS_DOMAIN_ID": str(domain)}
        log = folder / "up.log"
        with log.open("wb") as output:
            up = subprocess.Popen(
                shlex.split(docs.SCENE), cwd=folder, env=environment, stdout=output, stderr=subprocess.STDOUT
            )
        try:
            with DeformableMirrorClient(domain=domain, timeout_s=60.0) as client:
                try:
                    client.wait_until_active(90.0)
                    nodes = {"interferometer", "calibration", "focus_controller"}
                    wait_until(lambda: nodes <= set(client.node.get_node_names()), 90.0, "all nodes")
                except Exception as error:
                    heard = sorted(client.node.get_node_names())
                    said = log.read_text(errors="replace")
                    pytest.fail(f"{error}; domain {domain}, heard {heard}, status {up.poll()}, it said:\n{said}")
                yield Scene(folder, environment, client)
        finally:
            up.send_signal(signal.SIGINT)
            status = up.wait(60.0)
        assert status == 0, log.read_text(errors="replace")


@pytest.mark.parametrize("command", docs.RUN)
def test_it_runs(scene: Scene, command: str) -> None:
    said = scene.run(shlex.split(command))
    assert said.strip()
    scene.said.append(said)
    if command == "./dm calibrate":
        assert scene.client.wait(lambda: scene.client.capabilities.calibration_id, 30.0)
        assert 0.0 < scene.client.capabilities.error_bound < WAVELENGTH / 100
        assert "promise:" in said
    if command.startswith(("./dm calibrate", "./dm focus", "./dm check", "./dm status", "./dm degauss", "./dm report")):
        assert "next" in said.splitlines()[-1]


def test_the_first_hour_is_run_as_written() -> None:
    """The commands of the newcomer's page, in their order, are those that run here."""
    page = [command for where, command in SHELL if where.startswith("first-run.md") and command.startswith("./dm ")]
    start = page.index("./dm up --camera")
    hour = [command for command in page[start + 1 : page.index("./dm degauss") + 1] if command not in docs.PARSED]
    assert [command for command in docs.RUN if command in hour] == hour


def test_the_first_hour_warns_of_nothing(scene: Scene) -> None:
    log = (scene.folder / "up.log").read_text(errors="replace")
    assert "INFO" in log
    assert not [line for line in log.splitlines() if re.search(r"WARN|ERROR|FATAL", line)]


def test_the_glossary_has_the_words_of_the_first_hour(scene: Scene) -> None:
    log = re.sub(r"(?m)^\S+ \S+ (?=INFO)", "", (scene.folder / "up.log").read_text(errors="replace"))
    assert scene.said
    # Whatever is found is a plain word, or one for the glossary.
    assert sorted(docs.unexplained("\n".join([log, *scene.said]))) == []


@pytest.mark.parametrize("place", sorted(docs.PRELUDES), ids=str)
def test_python_runs(scene: Scene, place: tuple[str, int]) -> None:
    program = docs.PRELUDES[place] + numbered("python")[place].text
    scene.run([sys.executable, "-c", program])


@pytest.mark.parametrize("command", [c for c in ROS if c.split()[1] in ("service", "action", "topic") and " {" in c])
def test_calls_that_the_bench_answers(scene: Scene, command: str) -> None:
    """What `ros2` would send, sent: those that are dry, or quick, or a topic."""
    parsed = RosCommand.parse(command)
    node = scene.client.node
    if parsed.verb == "service call" and getattr(parsed.message, "dry_run", False):
        service = node.create_client(message_class(parsed.type), parsed.name)
        assert scene.client.wait(service.service_is_ready, 30.0)
        answer = service.call_async(parsed.message)
        assert scene.client.wait(answer.done, 60.0)
        assert answer.result().error_code == 0, answer.result().message


WITH_OWN_DOMAIN = [command for command in docs.WATCHED if command.startswith("./dm up")]


@pytest.mark.parametrize("command", [c for c in docs.WATCHED if c not in WITH_OWN_DOMAIN])
def test_it_starts_and_ends_on_ctrl_c(scene: Scene, command: str) -> None:
    if command.startswith("./dm console"):
        _skip_without_port(int(docs.WATCHED[command].rsplit(":", 1)[1]))
    scene.watch(command, docs.WATCHED[command])


@pytest.mark.parametrize("command", WITH_OWN_DOMAIN)
def test_the_shipped_bench_starts_and_ends_on_ctrl_c(scene: Scene, command: str) -> None:
    _skip_without_port(12340, 12341, 12342, 12343)
    with own_domain() as domain:
        scene.watch(command, docs.WATCHED[command], domain)


def _skip_without_port(*ports: int) -> None:
    for port, kind in product(ports, (socket.SOCK_STREAM, socket.SOCK_DGRAM)):
        with socket.socket(type=kind) as probe:
            if kind == socket.SOCK_STREAM:  # a connection that was closed a moment ago is in nobody's way
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                pytest.skip(f"port {port} is in use on this machine")


@pytest.mark.parametrize("command", docs.REPLAYED)
def test_a_recording_is_played_back(scene: Scene, command: str) -> None:
    with own_domain() as domain:
        if not (scene.folder / "runs" / "monday").exists():
            scene.watch("./dm record --out runs/monday", "recording")
        scene.run(shlex.split(command), domain)


def spoken(path: Path) -> str:
    """All texts of a program, one a line; what is filled in later as a gap."""
    lines = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.JoinedStr):
            lines.append("".join(p.value if isinstance(p, ast.Constant) else "\x00" for p in node.values))  # type: ignore[misc]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            lines.append(node.value)
    return "\n".join(lines)


#: Messages of others than ours.
FOREIGN = (
    "open_and_lock_file failed",
    "parameter type",
    "INTEGER",
    "DOUBLE",
    "Permission denied",
    "Connection refused",
    "Address already in use",
)


def test_messages_of_the_troubleshooting_page_exist() -> None:
    programs = [ROOT / "dm", *(ROOT / "src").glob("dm_*/dm_*/**/*.py")]
    texts = "\n".join(spoken(path) for path in programs)
    for row in re.findall(r"(?m)^\| (`.*?) \| ", (ROOT / "docs" / "troubleshooting.md").read_text()):
        for message in re.findall(r"`([^`]*)`", row):
            for part in (part.strip(" :=") for part in re.split(r"\.\.\.|;", message)):
                if part and not any(foreign in part for foreign in FOREIGN) and not part.startswith("/"):
                    assert part in texts, f"{message!r}: nothing in the code says {part!r}"
