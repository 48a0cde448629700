"""docs/parameters.md from the tables that declare the parameters (`python -m dm_tools.documentation.parameters`)."""

from __future__ import annotations

from dm_bringup.nodes import NODES
from dm_common.ros.parameters import as_markdown

#: Table of parameters by the name of the node, the virtual bench last.
TABLES = {node.name: node.load_parameters() for node in (*NODES[1:], NODES[0])}


def parameters_page() -> str:
    """The page, in Markdown."""
    parts = [
        "# Parameters",
        "",
        "Written from the code by `./dm exec python -m dm_tools.documentation.parameters`; a test keeps it true.",
        "Numbers of type double need a point in YAML (`300.0`, not `300`): ROS 2 does not convert integers.",
        "",
    ]
    for node, table in TABLES.items():
        parts += [f"## {node}", "", as_markdown(table)]
    return "\n".join(parts)


if __name__ == "__main__":
    print(parameters_page(), end="")
