"""Start and stop the nodes of the suite as processes, where `ros2 launch` is not available."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, Self

import yaml

from dm_bringup.nodes import MODULES, NAMES, nodes_of, remapping
from dm_bringup.sections import EVERY, ConfigError, belongs, flat, node_of, read_yaml, values_in
from dm_common.ros import SUPERVISOR

Config = dict[str, dict[str, Any]]

#: Pause before a node that ended is started again, s; it doubles each time that the node soon ends again, up to
#: RESTART_MAX_S, and is reset once the node has run for SETTLED_S.
RESTART_S, RESTART_MAX_S, SETTLED_S = 0.5, 30.0, 60.0
#: Exit status of a node that could not be created because of a wrong configuration, see `dm_common.ros.executor`.
NOT_MADE = 1
#: Name of the parameter file with which the nodes are started; no file of the user in that folder may have this name.
AS_STARTED = "as_started.yaml"


def load_config(path: Path, namespace: str = "") -> Config:
    """{node: {parameter: value}} of a ROS 2 parameter file. Raises ConfigError if it is not one, or cannot be read.

    Args:
        namespace: of the nodes, without slashes around it; sections of other namespaces are ignored. "" = any.
    """
    try:
        content = read_yaml(path.read_text())
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except (yaml.YAMLError, ValueError, KeyError) as error:  # the latter two from tags such as !!int and !!bool
        raise ConfigError(f"{path}: not a YAML file in UTF-8: {error}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: a parameter file is a mapping of nodes, this is a {type(content).__name__}")
    sections: Config = {}
    for key, section in ((str(key), section) for key, section in content.items()):
        name = node_of(key)
        if not belongs(key, namespace):
            continue
        if name not in NAMES and name != EVERY:
            raise ConfigError(f"{path}: {key}: no node of that name; known: {', '.join(NAMES)}")
        if not isinstance(section, dict) or not isinstance(section.get("ros__parameters"), dict):
            raise ConfigError(f"{path}: {key}: must hold a mapping `ros__parameters`")
        if any("*" not in other + key and node_of(other) == name for other in sections):
            raise ConfigError(f"{path}: {key}: a second section of {name}; must be one, or chosen by --namespace")
        sections[key] = flat(section["ros__parameters"])
        _check_readable(f"{path}: {key}", sections[key])
    named = {node_of(key) for key in sections}
    if EVERY in named:  # applies also to nodes that run without a section of their own
        named = {node.name for node in nodes_of(named)}
    try:
        return {name: values_in(sections, name, namespace) for name in NAMES if name in named}
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _check_readable(section: str, values: Mapping[str, Any]) -> None:
    """Raise ConfigError for values that ROS cannot read."""
    for name, value in values.items():
        if value is None:  # would be written as `null`, which is a text to ROS
            raise ConfigError(f"{section}: {name}: must have a value, or be left out")
        kinds = {type(item) for item in value} if isinstance(value, list) else set[type]()
        if len(kinds) > 1:
            text = 'must be of one type, as 0.0 and 2.5, or "--port" and "12"'
            raise ConfigError(f"{section}: {name} = {value}: {text}")


class _Dumper(yaml.SafeDumper):
    """Quotes every text: ROS reads some as numbers that are texts in YAML, such as the serials 0815 and 1e5."""


_Dumper.add_representer(str, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style='"'))


def save_config(config: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Write a ROS 2 parameter file that applies in any namespace."""
    content = {f"/**/{name}": {"ros__parameters": dict(values)} for name, values in config.items()}
    path.write_text(yaml.dump(content, Dumper=_Dumper, sort_keys=False))


def stop_processes(processes: Collection[subprocess.Popen[bytes]], timeout_s: float = 15.0) -> None:
    """Interrupt `processes` together and wait for all of them; one that does not end in time is killed."""
    for process in processes:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
    deadline = time.monotonic() + timeout_s
    for process in processes:
        try:
            process.wait(max(deadline - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@dataclass
class _Restarts:
    """Restarts of one node: last start and next one due (steady, s), next pause (s), and whether it never ended."""

    started: float
    due: float | None = None
    pause: float = RESTART_S
    first: bool = True


class Suite:
    """The nodes named in a configuration, each in a process of its own. Use as a context manager.

    The virtual bench and the autofocus run only when the configuration has a section for them.

    Args:
        config: {node: {parameter: value}}.
        folder: for the parameter file and the logs of the nodes.
        domain: ROS domain; None = the environment's.
        namespace: one per mirror.
        echo: True shows the nodes' output on this terminal instead of writing logs.
        nodes: names of the nodes to start; None = all.
        remap: rules `from:=to` for the names of all of them.
    """

    def __init__(
        self,
        config: Config,
        folder: Path,
        domain: int | None = None,
        namespace: str = "",
        echo: bool = False,
        nodes: Sequence[str] | None = None,
        remap: Sequence[str] = (),
    ) -> None:
        self.folder = folder
        self._config = config
        self._namespace = f"{namespace.strip('/')}/" if namespace.strip("/") else ""
        self._echo = echo
        self._nodes = NAMES if nodes is None else nodes
        self._remap = [word for rule in remap for word in ("-r", ":=".join(remapping(rule)))]
        self._environment = dict(os.environ)
        if domain is not None:
            self._environment["ROS_DOMAIN_ID"] = str(domain)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._restarts: dict[str, _Restarts] = {}

    def __enter__(self) -> Self:
        self.folder.mkdir(parents=True, exist_ok=True)
        save_config(self._config, self.folder / AS_STARTED)
        for node in nodes_of(self._config):
            if node.name in self._nodes:
                self._start(node.name)
        return self

    def _start(self, name: str) -> None:
        arguments = ["--ros-args", "--params-file", str(self.folder / AS_STARTED), *self._remap]
        if self._namespace:
            arguments += ["-r", f"__ns:=/{self._namespace.rstrip('/')}"]
        self._processes[name] = self._process(name, arguments)
        self._restarts.setdefault(name, _Restarts(time.monotonic())).started = time.monotonic()

    def _process(self, name: str, arguments: list[str]) -> subprocess.Popen[bytes]:
        """Start a node with these command-line arguments; it ends by itself if this process is killed."""
        with contextlib.ExitStack() as stack:
            mode = "ab" if name in self._restarts else "wb"
            output = None if self._echo else stack.enter_context(self.log(name).open(mode))
            # Signals reach a node once it can end in order (`run_node`), not while it is still importing.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
            stack.callback(signal.pthread_sigmask, signal.SIG_SETMASK, before)
            # In a session of their own: Ctrl-C in the terminal reaches them through this process, in order.
            return subprocess.Popen(
                [sys.executable, "-m", MODULES[name], *arguments],
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**self._environment, SUPERVISOR: str(os.getpid())},
                start_new_session=True,
            )

    def revive(self, say: Callable[[str], None]) -> None:
        """Restart nodes that have ended, after a pause that grows while they end again; to be called often.

        Args:
            say: called with a sentence for every node that ended, and for every one that is started again.

        Raises:
            RuntimeError: a node could not be created with this configuration; another try would fail in the same way.
        """
        now = time.monotonic()
        for name in self.ended():
            restart = self._restarts[name]
            if restart.due is None:
                status = self._processes[name].returncode
                if now - restart.started > SETTLED_S:
                    restart.pause = RESTART_S
                elif status == NOT_MADE and restart.first:
                    self._raise_ended(name)
                restart.due, restart.first = now + restart.pause, False
                reason = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
                say(f"the node {self._namespace}{name} {reason}; it is started again in {restart.pause:g} s")
                restart.pause = min(2.0 * restart.pause, RESTART_MAX_S)
            elif now >= restart.due:
                restart.due = None
                self._start(name)
                say(f"the node {self._namespace}{name} is started again")

    def log(self, name: str) -> Path:
        """The log file of a node."""
        return self.folder / f"{name}.log"

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by the names of the nodes."""
        return {name: process.pid for name, process in self._processes.items()}

    def ended(self) -> list[str]:
        """Names of the nodes that are no longer running."""
        return [name for name, process in self._processes.items() if process.poll() is not None]

    def check(self) -> None:
        """Raise RuntimeError with the end of the log of a node if one has ended."""
        for name in self.ended():
            self._raise_ended(name)

    def _raise_ended(self, name: str) -> NoReturn:
        status = self._processes[name].returncode
        lines = [] if self._echo else self.log(name).read_text(errors="replace").splitlines()[-8:]
        tail = "; its output above says why" if self._echo else "".join(f"\n{line}" for line in lines)
        raise RuntimeError(f"the node {name} ended with status {status}{tail}")

    def stop(self, timeout_s: float = 15.0) -> None:
        """Stop all nodes, the emulated hardware last; a node that does not end in time is killed."""
        hardware = [process for name, process in self._processes.items() if name == "virtual_bench"]
        nodes = [process for process in self._processes.values() if process not in hardware]
        for group in (nodes, hardware):
            stop_processes(group, timeout_s)

    def __exit__(self, *_error: object) -> None:
        self.stop()
