"""`dm test`: lint, types and tests."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from dm_tools.output import JsonOption, console, write_json


def test(
    context: typer.Context,
    lint: Annotated[bool, typer.Option(help="Run ruff and mypy too.")] = True,
    json: JsonOption = None,
) -> None:
    """Run all checks of the project: ruff, mypy, pytest. Further arguments go to pytest."""
    root = Path(os.environ.get("DM_ROOT", Path.cwd()))
    steps = {}
    if lint:
        steps["ruff check"] = ["ruff", "check", "."]
        steps["ruff format"] = ["ruff", "format", "--check", "."]
        steps["mypy"] = ["mypy"]
    # Most of a node's test is waiting, so a few at once; modules stay whole for what their tests share.
    workers = str(max(3, os.cpu_count() or 1))
    steps["pytest"] = ["pytest", "-n", workers, "--dist", "loadfile", *context.args]
    results: dict[str, dict[str, float | int]] = {}
    for name, command in steps.items():
        console.rule(name)
        started = time.monotonic()
        status = subprocess.run([sys.executable, "-m", *command], cwd=root, check=False).returncode
        results[name] = {"status": status, "seconds": round(time.monotonic() - started, 1)}
    # pytest's own summary must stay the last thing on the screen when all is well.
    failed = [name for name, result in results.items() if result["status"] != 0]
    write_json(json, {"checks": results})
    if failed:
        console.print(f"[bold red]failed:[/] {', '.join(failed)}")
        raise typer.Exit(1)
