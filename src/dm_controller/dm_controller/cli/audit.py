"""`dm audit`: which packages the environment holds and why, and what is known against them."""

from __future__ import annotations

import os
import sysconfig
from pathlib import Path
from typing import Annotated

import typer

from dm_controller.cli.output import JsonOption, console, fail, write_json


def requirement_files(root: Path) -> list[Path]:
    """The files that the environment was made of: with a sourced ROS 2 the wheels of ROS are left out."""
    sourced = os.environ.get("ROS_DISTRO") == "jazzy"
    return [root / "requirements" / name for name in ("python.txt", *(() if sourced else ("ros.txt",)))]


def audit(
    offline: Annotated[bool, typer.Option("--offline", help="Look at the environment only, ask nobody.")] = False,
    report_only: Annotated[
        bool, typer.Option("--report-only", help="Known vulnerabilities are told, and do not change the exit status.")
    ] = False,
    lock: Annotated[Path | None, typer.Option(help="Write all versions to this file, for `pip install -c`.")] = None,
    json: JsonOption = None,
) -> None:
    """Audit the dependencies: all pinned, nothing beyond them, and no known vulnerabilities where the network tells."""
    from dm_controller.audit import audit as look
    from dm_controller.vulnerabilities import NotAskedError, Vulnerability, install, known_vulnerabilities

    root = Path(os.environ.get("DM_ROOT", Path.cwd()))
    found = look(requirement_files(root), [sysconfig.get_path("purelib")])
    console.print(f"{len(found.pinned)} packages are pinned; {len(found.brought)} come with them, at no fixed version")
    for line in found.findings:
        fail(line)
    if lock is not None:
        lock.write_text(found.lock())
    reason = "--offline" if offline else ""
    known: list[Vulnerability] = []
    unknown: list[str] = []
    if not offline:
        try:
            known, unknown = known_vulnerabilities(found.lock(), install(root))
        except NotAskedError as error:
            reason = str(error)
    if reason:
        console.print(f"[yellow]known vulnerabilities: skipped:[/] {reason}")
    else:
        asked = len(found.pinned) + len(found.brought) - len(unknown)
        console.print(
            f"known vulnerabilities: {len(known)} in {asked} packages; nothing is known of {len(unknown)} more"
        )
    for one in known:
        mended = f"mended in {', '.join(one.mended_in)}" if one.mended_in else "not mended yet"
        fail(f"{one.package} {one.version}: {one.advisory}, {mended}")
    figures = {
        "pinned": len(found.pinned),
        "brought": len(found.brought),
        "findings": list(found.findings),
        "vulnerabilities": None if reason else [vars(one) for one in known],
        "unknown": unknown,
        "skipped": reason,
    }
    write_json(json, {"audit": figures})
    if found.findings or (known and not report_only):
        raise typer.Exit(1)
