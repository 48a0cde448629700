"""`dm test`: lint, types and tests."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

import typer

from dm_tools.output import JsonOption, console, write_json

#: Marker expression of `--fast`: it leaves out tests that start nodes as processes or take half a second and more.
FAST = "not processes and not slow"
_CORES = os.cpu_count() or 1
#: The tests of nodes mostly wait, so three run at once for each core, but not more nodes than fit into the memory of a
#: small machine. conftest.py puts the longest ones first, and names the modules that stay whole.
WORKERS = min(3 * _CORES, 12)
#: The other tests hardly wait; each worker imports the modules of all tests, which takes some ten seconds.
FAST_WORKERS = _CORES + (_CORES + 1) // 2
#: Takes a minute and more of one core in a fresh checkout, so it gets only the time that the tests leave.
_TYPES = ["nice", "-n", "19", sys.executable, "-m", "mypy"]
SCHEDULE = ("--dist", "loadfile", "--no-loadscope-reorder")


def test(
    context: typer.Context,
    fast: Annotated[bool, typer.Option("--fast", help="Only tests that start no process and take no time.")] = False,
    lint: Annotated[bool | None, typer.Option(help="Run ruff and mypy too; by default in a run of all tests.")] = None,
    json: JsonOption = None,
) -> None:
    """Run all checks of the project: ruff, mypy, pytest.

    Further arguments go to pytest: `./dm test PATH ...` runs these tests alone.
    """
    root = Path(os.environ.get("DM_ROOT", Path.cwd()))
    chosen = any(not argument.startswith("-") for argument in context.args)
    lint = not fast and not chosen if lint is None else lint
    steps = {"ruff check": ["ruff", "check", "."], "ruff format": ["ruff", "format", "--check", "."]} if lint else {}
    workers = FAST_WORKERS if fast else 0 if chosen else WORKERS
    steps["pytest"] = ["pytest", "-n", str(workers), *SCHEDULE, *(["-m", FAST] if fast else []), *context.args]
    environment = _environment(root)
    results: dict[str, dict[str, float]] = {}
    found = ""
    with ThreadPoolExecutor() as beside:
        types = beside.submit(_run, _TYPES, root, environment, stdout=subprocess.PIPE, text=True) if lint else None
        compiling = _compile(root, environment) if lint else None
        for name, command in steps.items():
            if name == "pytest" and compiling is not None:
                compiling.wait()
                console.print("mypy goes on beside the tests; what it finds is shown after them")
            console.rule(name)
            _, results[name] = _run([sys.executable, "-m", *command], root, environment)
        if types is not None:
            found, results["mypy"] = types.result()
    # pytest's own summary must stay the last thing on the screen when all is well.
    failed = [name for name, result in results.items() if result["status"] != 0]
    if "mypy" in failed:
        console.rule("mypy")
        console.print(found, markup=False)
    write_json(json, {"checks": results})
    if failed:
        console.print(f"[bold red]failed:[/] {', '.join(failed)}")
        raise typer.Exit(1)


def _run(command: list[str], root: Path, environment: dict[str, str], **output: Any) -> tuple[str, dict[str, float]]:
    """Run a check; returns its output, where `output` captures it, and its figures."""
    started = time.monotonic()
    done = subprocess.run(command, cwd=root, env=environment, check=False, **output)
    return done.stdout, {"status": done.returncode, "seconds": round(time.monotonic() - started, 1)}


def _compile(root: Path, environment: dict[str, str]) -> subprocess.Popen[bytes]:
    """Collect all tests beside the lint: in a fresh checkout every worker would else compile them and their imports."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q"]
    return subprocess.Popen(command, cwd=root, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _environment(root: Path) -> dict[str, str]:
    """This process's environment; bytecode goes elsewhere if it must not be beside the sources: many nodes start."""
    environment = dict(os.environ)
    if environment.pop("PYTHONDONTWRITEBYTECODE", ""):
        environment["PYTHONPYCACHEPREFIX"] = str(root / "build" / "bytecode")
    return environment
