"""docs/parameters.md from the tables that declare the parameters (`python -m studies.documentation.parameters`)."""

from __future__ import annotations

from collections.abc import Sequence

from dm_bringup.nodes import NODES
from dm_common.ros.parameters import REQUIRED, Parameter

#: Table of parameters by the name of the node, the virtual bench last.
TABLES = {node.name: node.load_parameters() for node in (*NODES[1:], NODES[0])}


def as_markdown(table: Sequence[Parameter]) -> str:
    """A table of parameters in Markdown."""
    lines = ["| parameter | default | allowed | what it is |", "|---|---|---|---|"]
    for parameter in table:
        default = "**required**" if parameter.default is REQUIRED else f"`{parameter.default!r}`"
        allowed, unit = parameter.value.allowed(), parameter.value.unit
        if unit and not allowed.endswith(unit):
            allowed += f" ({unit})"
        live = " *live*" if parameter.live else ""
        lines.append(f"| `{parameter.name}` | {default} | {allowed} | {parameter.description}{live} |")
    return "\n".join(lines) + "\n"


def parameters_page() -> str:
    """The page, in Markdown."""
    parts = [
        "# Parameters",
        "",
        "Written from the code by `./dm exec python -m studies.documentation.parameters`; a test keeps it true.",
        "A whole number will do for a float (`300` for `300.0`). With a parameter that is wrong or missing a node",
        "stays unconfigured, says so, and takes it by `ros2 param set`; with one that is misspelt, until it is started",
        "anew without it. `virtual_bench`, which is no lifecycle node, ends. What is marked *live* changes any time.",
        "The rest changes of driver and interferometer until they are configured, and of calibration, focus controller",
        "and autofocus while they are inactive.",
        "",
    ]
    for node, table in TABLES.items():
        parts += [f"## {node}", "", as_markdown(table)]
    return "\n".join(parts)


if __name__ == "__main__":
    print(parameters_page(), end="")
