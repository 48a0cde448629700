"""docs/interfaces.md from the code (`python -m studies.documentation.interfaces`).

Every node is made once, on a ROS domain of its own, and asked for its topics, services and actions; definitions come
from the installed dm_msgs, commands from the `dm` command itself.
"""

from __future__ import annotations

import re
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rclpy.action import ActionServer, get_action_server_names_and_types_by_node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from studies.documentation.answers import PAGE, committed

#: Packages and topics of the interfaces that rclpy gives every node, or every lifecycle node.
STANDARD = ("rcl_interfaces", "lifecycle_msgs", "type_description_interfaces")
STANDARD_TOPICS = ("rosout", "parameter_events")
GRAPH_S = 20.0
PART_TITLES = {"msg": ("",), "srv": ("request", "response"), "action": ("goal", "result", "feedback")}
HEAD = """# Interfaces

Written from the code by `./dm exec python -m studies.documentation.interfaces`; a test keeps it true. Parameters are
on [a page of their own](parameters.md). Names are relative: with a namespace they lie in it. Units are SI where a
comment names none; signals are normalised, −1 to +1; sag is that of the surface, positive curvature is concave.

A latched topic keeps its last message for those who come late. `ros2 topic echo /capabilities` shows it, as it does
with both of `--qos-durability transient_local --qos-reliability reliable`; durability alone leaves best effort, which
shows nothing before the next message.

Every field of a request or goal is checked before anything is done: NaN and infinity are answered with NOT_FINITE,
numbers out of range with OUT_OF_RANGE, arrays of another length and texts of over 1000 characters with
INVALID_LENGTH, unknown names and modes with UNKNOWN_NAME, texts with control characters other than tabs and
line ends with INVALID_ARGUMENT; the sentence names field, value and what is allowed.
Figures that were not computed are NaN, as in a request that was refused before planning or a run that ended early. A
request refused because of its planned result, such as a shape out of reach, returns the figures of that result.

A program asks by the topic `focus_request` or the service `set_focus` (`dry_run` predicts only), moves with the action
`move_focus`, and finds what the mirror can do on the latched topic `capabilities`. `actuator_command`, `set_signals`
and `degauss` go below the controller; `calibrate`, `converge` and `build_recipes` are actions with an interferometer,
`autofocus`, `focus_stack` and `set_focus_distance` with a camera. Every refusal carries an `error_code` and a sentence
with the value and the allowed range.

## Nodes

| node | package | what it does |
|---|---|---|
"""
#: Longest line of text outside tables.
LINE_MAX = 130
#: What each node does.
DUTIES = {
    "virtual_bench": "the simulation: mirror with hysteresis and creep, electronics, interferometer, camera",
    "pdm_driver": "signals in, frames of the drive unit out; a safety limiter in front of every write",
    "interferometer": "reads [map files](map-files.md) and a sensor; fits 21 Zernike terms over all pixels",
    "calibration": "measures influence function, hysteresis and creep, checks the wiring, follows later maps",
    "focus_controller": "curvature, conic constant and Zernike terms in, commands out: bounded least squares, then the "
    "inverse of hysteresis and creep",
    "autofocus": "camera images in, focus requests out: search, tracking, focus by distance, depth images",
}


@dataclass(frozen=True)
class Offer:
    """One end of an interface.

    Attributes:
        kind: publishes, subscribes, service or action.
        name: as the node gives it.
        type: package/Type.
        qos: in words; "" for services and actions.
    """

    kind: str
    name: str
    type: str
    qos: str = ""


def qos_text(profile: QoSProfile) -> str:
    """A quality of service in words."""
    reliable = profile.reliability == ReliabilityPolicy.RELIABLE
    latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return f"{'reliable' if reliable else 'best effort'}, {'latched, ' if latched else ''}depth {profile.depth}"


def type_name(cls: Any) -> str:
    """package/Type of a message, service or action class."""
    return f"{cls.__module__.split('.')[0]}/{cls.__name__}"


def offers_of(node: Any) -> list[Offer]:
    """What a node publishes, subscribes to and serves, without the interfaces that every node has."""
    prefix = node.get_fully_qualified_name() + "/"

    def short(name: str) -> str:
        name = name if name.startswith("/") else f"/{name}"
        if name.startswith(prefix):
            return "~/" + name.removeprefix(prefix)
        return name if name in ("/clock", "/diagnostics") else name.removeprefix("/")

    found = [
        Offer("publishes", short(item.topic_name), type_name(item.msg_type), qos_text(item.qos_profile))
        for item in node.publishers
    ]
    found += [
        Offer("subscribes", short(item.topic_name), type_name(item.msg_type), qos_text(item.qos_profile))
        for item in node.subscriptions
    ]
    found += [Offer("service", short(item.srv_name), type_name(item.srv_type)) for item in node.services]
    found += [Offer("action", short(name), kind.replace("/action/", "/")) for name, kind in _actions(node)]
    order = ("publishes", "subscribes", "service", "action")
    kept = {
        offer
        for offer in found
        if offer.type.split("/")[0] not in STANDARD and offer.name.strip("/") not in STANDARD_TOPICS
    }
    return sorted(kept, key=lambda offer: (order.index(offer.kind), offer.name))


def _actions(node: Any) -> list[tuple[str, str]]:
    """(name, package/action/Type) of a node's action servers; the graph takes a moment to show them."""
    count = sum(isinstance(item, ActionServer) for item in node.waitables)
    deadline = time.monotonic() + GRAPH_S
    while True:
        seen = get_action_server_names_and_types_by_node(node, node.get_name(), node.get_namespace())
        if len(seen) == count:
            return [(name, kind) for name, (kind, *_others) in seen]
        if time.monotonic() > deadline:
            raise RuntimeError(f"{node.get_name()} has {count} action servers, the ROS graph shows {len(seen)}")
        time.sleep(0.01)


def nodes_and_offers() -> dict[str, list[Offer]]:
    """{node: its offers}; ROS stays initialised, so this is for a process of its own."""
    import rclpy

    from dm_bringup.nodes import NODES
    from dm_bringup.suite import save_config
    from dm_common.ros.domains import own_domain
    from dm_tools.demo.demo_bench import bench_config

    result: dict[str, list[Offer]] = {}
    with tempfile.TemporaryDirectory() as temporary, own_domain() as domain:
        folder = Path(temporary)
        config = bench_config(folder, "off", 0.0, 1, 0.0)
        config["virtual_bench"] |= {"camera.rate": 1.0, "clock.speed": 1.0, "interferometer.pixels": 64}
        save_config(config, folder / "config.yaml")
        rclpy.init(args=["--ros-args", "--params-file", str(folder / "config.yaml")], domain_id=domain)
        for entry in NODES:
            node = entry.load_class()()
            if entry.name in ("interferometer", "autofocus"):
                node.trigger_configure()  # this creates their topics
            result[entry.name] = offers_of(node)
            if hasattr(node, "make_safe"):
                node.make_safe()
        rclpy.try_shutdown()
    return result


def duties() -> Iterator[str]:
    """A row for each node: its package and what it does."""
    from dm_bringup.nodes import NODES

    for node in NODES:
        kinds = [kind for kind, said in (("lifecycle node", node.lifecycle), ("optional", node.optional)) if said]
        yield f"| [{node.name}](#node-{node.name}) | {node.package} | {'; '.join([DUTIES[node.name], *kinds])} |"
    yield ""


def node_tables(nodes: dict[str, list[Offer]]) -> Iterator[str]:
    """The interfaces of every node."""
    for name, offers in nodes.items():
        yield f"## Node {name}\n\n| | name | type | quality of service |\n|---|---|---|---|"
        for offer in offers:
            package, _, short = offer.type.partition("/")
            linked = f"[{short}](#{short.lower()})" if package == "dm_msgs" else f"{package}/{short}"
            yield f"| {offer.kind} | `{offer.name}` | {linked} | {offer.qos} |"
        yield ""


def definition(path: Path) -> Iterator[str]:
    """One message, service or action as tables: what it is, then field, type and meaning."""
    yield f"### {path.stem}\n"
    parts = re.split(r"(?m)^---[ \t]*\n?", path.read_text())
    for title, part in zip(PART_TITLES[path.suffix[1:]], parts, strict=True):
        lines = part.strip("\n").splitlines()
        if not title or title in ("request", "goal"):
            while lines and lines[0].startswith("#"):
                yield lines.pop(0).removeprefix("#").strip()
            yield ""
        rows = [row for row in map(_row, lines) if row]
        if not rows:
            continue
        yield f"| {title or 'field'} | type | meaning |\n|---|---|---|"
        yield from rows
        yield ""


def _row(line: str) -> str:
    declaration, _, comment = (text.strip() for text in line.partition("#"))
    comment = comment.replace("|", r"\|")
    if not declaration:
        return f"| | | *{comment}* |" if comment else ""
    kind, _, rest = declaration.partition(" ")
    name = " ".join(rest.split())
    if "=" not in name and " " in name:  # a default value
        name, _, default = name.partition(" ")
        comment = f"{comment} (default {default})"
    return f"| `{name}` | {kind} | {comment} |"


def commands() -> str:
    """Every command of `dm` with its arguments and options, as documented by Typer."""
    import typer
    from typer.cli import get_docs_for_click

    from dm_tools.cli import make_app

    group = typer.main.get_command(make_app())
    text = get_docs_for_click(obj=group, ctx=typer.Context(group), name="./dm")
    text = text[text.index("\n## ") :]  # the commands, without the list of them
    text = re.sub(r"(?ms)^\*\*Usage\*\*:\n+```console\n.*?```\n+", "", text)
    text = re.sub(r"(?m)^\* `--help`.*\n", "", text)
    # Nothing left under a heading: a command without options.
    text = re.sub(r"(?m)^\*\*Options\*\*:\n+(?=#|\Z)", "", text)
    note = "`./dm exec COMMAND ...` runs any command inside the environment. Every command has `--help`.\n"
    return f"## Commands\n\n{note}{re.sub(r'(?m)^#', '##', text)}"


def interfaces_page() -> str:
    """The page, in Markdown. For a process of its own: see `nodes_and_offers`."""
    from ament_index_python.packages import get_package_share_directory

    share = Path(get_package_share_directory("dm_msgs"))
    parts = [HEAD.rstrip(), *duties(), *node_tables(nodes_and_offers())]
    for folder, title in (("msg", "Messages"), ("srv", "Services"), ("action", "Actions")):
        parts.append(f"## {title}\n")
        for path in sorted((share / folder).glob(f"*.{folder}")):
            parts += definition(path)
    parts.append(committed(PAGE.read_text()))  # from a run, which takes a minute
    parts.append(commands())
    text = wrapped("\n".join(parts))
    return re.sub(r"\n{3,}", "\n\n", text).rstrip("\n") + "\n"


def wrapped(text: str) -> str:
    """Wrap long lines of text; rows of tables and blocks of code stay as they are."""
    return re.sub(r"(?ms)^```.*?^```$|^[^\n]+", lambda found: _wrapped(found[0]), text)


def _wrapped(line: str) -> str:
    if line.startswith(("|", "```")) or len(line) <= LINE_MAX:
        return line
    indent = "  " if line.startswith("* ") else ""
    return textwrap.fill(line, LINE_MAX, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


if __name__ == "__main__":
    page = interfaces_page()
    sys.stdout.write(page)
