"""`dm doctor`: what is wrong on this machine or bench, in words, and how to cure it."""

from pathlib import Path
from shlex import quote
from typing import Annotated

import typer
from rich.text import Text

from dm_tools.doctor.machine import LINK_LOST, Finding, machine_checks
from dm_tools.output import JsonOption, NamespaceOption, console, next_step, write_json

#: Names of checks of exclusive resources, which the nodes hold while they run: ports, and the drive unit.
PORTS, UNIT = ("ports of the virtual bench",), ("electronics", "serial port")


def doctor(
    config: Annotated[Path | None, typer.Option(help="Check this bench configuration too.")] = None,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Say what is wrong on this machine or bench, and how to cure it.

    A note is for information; only what is WRONG makes the exit status 1. Nothing is changed or sent to outputs.
    """
    from dm_tools.doctor.bench import bench_checks

    checks = machine_checks(namespace)
    if config is not None:
        checks += bench_checks(config, namespace)
    findings: dict[str, Finding | None] = {}
    for name, run in checks:
        try:
            found = run()
        except (OSError, RuntimeError) as error:  # a folder in one that this user may not search; of ROS: no home
            cure = "give this user the right to it, or choose another place"
            if "security libraries" in str(error):  # of Fast DDS, which the wheels lack
                cure = "start the nodes with ROS 2 from apt, or unset ROS_SECURITY_ENABLE (docs/security.md)"
            found = Finding(f"cannot be checked: {error}", cure)
        findings[name] = finding = held_by_the_nodes(name, found, findings.get("nodes that are running"))
        if finding is None or not finding.cure:
            console.print("[green]ok[/]   ", Text(f"{name}: {finding.problem}" if finding else name))
        else:
            mark = "[yellow]note[/] " if finding.note else "[red]WRONG[/]"
            console.print(mark, Text(f"{name}: {finding.problem}\n      cure: {finding.cure}"))
    write_json(json, {"doctor": {name: found and found._asdict() for name, found in findings.items()}})
    file = f" --config {quote(str(config))}" if config else ""
    if wrong := sum(bool(finding and finding.cure and not finding.note) for finding in findings.values()):
        next_step(f"the cure{'s' if wrong > 1 else ''} above, then ./dm doctor{file} again", namespace)
        raise typer.Exit(1)
    running = findings["nodes that are running"]
    next_step("./dm status" if running and not running.cure else f"./dm up{file}", namespace)


def held_by_the_nodes(check: str, finding: Finding | None, running: Finding | None) -> Finding | None:
    """The finding of a check; only a note if running nodes of the bench hold what was checked."""
    said = running.problem if running is not None else ""
    held = PORTS if LINK_LOST in said else (*PORTS, *UNIT)
    if finding is None or not check.startswith(held) or "pdm_driver" not in said.partition("; not running")[0]:
        return finding
    return finding._replace(cure="none, if the running nodes hold it; ./dm status shows their state", note=True)
