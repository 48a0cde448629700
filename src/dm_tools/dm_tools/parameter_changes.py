"""Apply parameters that a measurement has found: to running nodes, and to their parameter file."""

from collections.abc import Container
from itertools import chain, count
from pathlib import Path
from typing import Any

from dm_bringup.config_edit import edited, values_of
from dm_bringup.sections import ConfigError
from dm_bringup.suite import load_config
from dm_common.atomic_write import is_stream, write_whole
from dm_common.errors import ErrorCode
from dm_tools.output import console
from dm_tools.verbs.up import CAMERA, shared_config


def set_parameter(client: Any, node: str, name: str, value: Any) -> None:
    """Set a parameter of a running node. Raises DeformableMirrorError when it does not answer, or refuses."""
    from rclpy.parameter import Parameter

    answer = _answer(client, node, lambda parameters: parameters.set_parameters([Parameter(name, value=value)]))
    if not all(each.successful for each in answer.results):
        reasons = "; ".join(each.reason for each in answer.results)
        from dm_client import DeformableMirrorError

        raise DeformableMirrorError(ErrorCode.INVALID_ARGUMENT, f"the node `{node}` did not accept {name}: {reasons}")


def get_parameter(client: Any, node: str, name: str) -> Any:
    """The value of a parameter of a running node. Raises DeformableMirrorError when it does not answer."""
    from rclpy.parameter import parameter_value_to_python

    answer = _answer(client, node, lambda parameters: parameters.get_parameters([name]))
    return parameter_value_to_python(answer.values[0])


def _answer(client: Any, node: str, query: Any) -> Any:
    from rclpy.parameter_client import AsyncParameterClient

    from dm_client import DeformableMirrorError
    from dm_client.connection import UNAVAILABLE

    parameters = AsyncParameterClient(client.node, node)
    if client.wait(parameters.services_are_ready):
        answer = query(parameters)
        if client.wait(answer.done):
            return answer.result()
    code = UNAVAILABLE.get(node, ErrorCode.TIMEOUT)
    raise DeformableMirrorError(code, f"the node `{node}` does not answer: is it running (./dm up)?")


def source_of(target: Path, config: Path | None, serial: str, namespace: str = "") -> Path:
    """The parameter file from which :func:`write_parameters` makes `target`.

    Args:
        config: the file that the nodes run with; None = `target` where there is one, else that of the virtual bench.
        serial: of the running mirror.
        namespace: of its nodes; "" = none.

    Raises:
        ConfigError: the file cannot be used, or is of another mirror.
    """
    source = config or (target if target.is_file() and not is_stream(target) else shared_config("bench.yaml"))
    written = str(load_config(source, namespace.strip("/")).get("pdm_driver", {}).get("mirror.serial", ""))
    if written != serial:
        raise ConfigError(
            f"{source} is for the mirror {written!r}, the nodes run {serial!r}: give their file with --config"
        )
    return source


def write_parameters(
    parameters: str, target: Path, source: Path, namespace: str = "", nodes: Container[str] = ()
) -> None:
    """Write the parameter file `target`: `source` with the `parameters` found of a mirror; comments are kept.

    An existing file at `target` is kept beside it, and earlier copies are never overwritten.

    Args:
        nodes: names of the running nodes. With autofocus, the shipped virtual bench was started with a camera, which
            is not in its file: it is written too.

    Raises:
        ConfigError: `source` cannot be changed without losing its form.
        OSError: `source` cannot be read, or `target` cannot be written; an existing `target` is then unchanged.
    """
    if not parameters:
        console.print(f"no parameter of {source} found to change, so {target} is not written")
        return
    camera = CAMERA if source == shared_config("bench.yaml") and "autofocus" in nodes else {}
    text = edited(edited(source.read_text(), camera), values_of(parameters), namespace)
    keep_before(target)
    write_whole(target, text.encode())
    console.print(f"{target} is written from {source}: start the nodes with it, then check again")


def keep_before(target: Path) -> None:
    """Copy an existing file at `target` beside it under a free name. Raises OSError."""
    if target.is_file() and not is_stream(target):
        kept = (target.with_name(f"{target.name}.before{number}") for number in chain([""], count(2)))
        before = next(path for path in kept if not path.exists())
        write_whole(before, target.read_bytes())
        console.print(f"{target} as it was is kept as {before}")
