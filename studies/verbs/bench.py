"""`dm bench`: speed and memory, beside the usual alternatives, in one run."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from dm_tools.output import JsonOption, console, output_file, progress_bar, write_json


def show(lines: list[dict[str, Any]], figures: dict[str, Any]) -> None:
    """Print the table of targets and the slopes of growth."""
    from rich.table import Table

    table = Table(title="measured in this run; × = how many times as long, or as much, as the suite")
    for heading, side in (
        ("job", "left"),
        ("measured", "right"),
        ("to reach", "right"),
        ("", "left"),
        ("beside it", "left"),
    ):
        table.add_column(heading, justify=side)  # type: ignore[arg-type]
    for line in lines:
        beside = [
            f"{name} {_number(value)} ({value / line['value']:.3g} ×)"
            for name, value in line["beside"].items()
            if value is not None
        ]
        table.add_row(
            line["job"],
            f"{_number(line['value'])} {line['unit']}",
            f"≤ {_number(line['limit'])} {line['unit']}",
            "[green]met[/]" if line["met"] else "[red]not met[/]",
            ", ".join(beside),
        )
    console.print(table)
    if "slopes" in figures:
        slopes = ", ".join(f"{name} {value:.2f}" for name, value in figures["slopes"].items())
        console.print(f"growth (exponents): {slopes}")
    facts = figures["machine"]
    console.print(
        f"{facts['processor']}, {facts['cores']} cores, load {facts['load_average']}; Python {facts['python']}, "
        f"NumPy {facts['numpy']}, SciPy {facts['scipy']}, BLAS threads: {facts['blas_threads']}"
    )


def _number(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def bench(
    quick: Annotated[bool, typer.Option("--quick", help="Fewer turns and small sizes: some three minutes.")] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this job (fit, read, influence, solve, inverse, scaling, focus, files, idle, calibration, "
            "hosts); repeatable."
        ),
    ] = None,
    rivals: Annotated[
        bool, typer.Option(help="Install prysm, hcipy and zernike apart from the suite, to compare with.")
    ] = True,
    plot: Annotated[
        Path | None,
        typer.Option(help="Draw the growth with size to this PNG file.", metavar="FILE", callback=output_file),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Measure speed and memory, side by side with what one would take instead.

    Figures of time are those of this machine at this moment; what is measured takes turns, so its ratios hold.
    """
    from studies.benchmarks import rivals as others
    from studies.benchmarks.suite import chosen, run
    from studies.benchmarks.targets import rows
    from studies.benchmarks.timing import Effort

    names = [name for name, _job in chosen(only or [])]
    if plot is not None and "scaling" not in names:
        raise typer.BadParameter("draws what the job scaling measures: give --only scaling too", param_hint="--plot")
    started = time.monotonic()
    root = Path(os.environ.get("DM_ROOT", Path.cwd()))
    effort = Effort(rounds=12, quick=True) if quick else Effort()
    found = others.load(root, rivals and not quick, console.print)
    with progress_bar(steady=False) as bar:  # a thread that draws would take time from the jobs
        task = bar.add_task("bench", total=len(names))
        done = -1

        def step(name: str) -> None:
            nonlocal done
            done += 1
            bar.update(task, completed=done, description=f"bench: {name}", refresh=True)

        figures = run(names, effort, found, step)
        bar.update(task, completed=len(names), description="bench: done", refresh=True)
    lines = rows(figures)
    show(lines, figures)
    if plot is not None:
        from studies.benchmarks.figure import save_scaling

        console.print(f"plot: {save_scaling(figures, plot)}")
    figures["targets"] = lines
    write_json(json, figures | {"seconds": time.monotonic() - started})
    console.print(f"done in {time.monotonic() - started:.0f} s")
