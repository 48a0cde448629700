"""`dm compare --autofocus N`: images, time and error of searches for the sharpest focus, on scenes drawn at random."""

from __future__ import annotations

import os
from dataclasses import asdict
from typing import Any

from dm_tools.output import console, progress_bar

#: Scenes without texture for each scene with texture: false finds are rare, so counting them takes many.
BLANK_SCENES = 20


def run(first: int, count: int, workers: int = 2) -> tuple[dict[str, Any], dict[str, Any]]:
    """Figures of each method on `count` scenes, and share of false finds on scenes without texture."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # for the processes to come: one core each
    from studies.autofocus.trials import Trial, figures_of, run_scenes

    blanks = BLANK_SCENES * count
    trials: dict[str, list[Trial]] = {}
    finds: dict[str, list[bool]] = {}
    with progress_bar() as bar:
        task = bar.add_task("scenes", total=count)
        for scene in run_scenes(range(first, first + count), True, workers):
            for trial in scene:
                trials.setdefault(trial.method, []).append(trial)
            bar.update(task, advance=1)
        task = bar.add_task("scenes without texture", total=blanks)
        for scene in run_scenes(range(first, first + blanks), False, workers):
            for trial in scene:
                finds.setdefault(trial.method, []).append(trial.error is not None)
            bar.update(task, advance=1)
    figures = {method: asdict(figures_of(those)) for method, those in trials.items()}
    false = {method: {"scenes": len(those), "false_finds": sum(those)} for method, those in finds.items()}
    return figures, false


def show(figures: dict[str, Any], false: dict[str, Any]) -> None:
    """Print the table."""
    from rich.table import Table

    table = Table(title="searches of the sharpest focus; errors in depths of focus, time at 30 images a second")
    table.add_column("search")
    headings = ("images p50", "p90", "s p50", "p90", "within 1/2", "within 1", "found", "found, but > 3 off", "false")
    for heading in headings:
        table.add_column(heading, justify="right")
    for method, row in figures.items():
        blank = false.get(method)
        share = f"{blank['false_finds']} of {blank['scenes']}" if blank else "-"
        numbers = [f"{row['images'][0]:.0f}", f"{row['images'][1]:.0f}"]
        numbers += [f"{row['seconds'][0]:.2f}", f"{row['seconds'][1]:.2f}"]
        numbers += [f"{row[name]:.1%}" for name in ("within_half", "within_one", "found", "gross")]
        table.add_row(method, *numbers, share)
    console.print(table)
    swept = next(iter(figures.values()))["swept"]
    console.print(f"few images: the range was swept after all in {swept:.1%} of the scenes; false: on blank scenes")
