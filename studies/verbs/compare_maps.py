"""The table of `dm compare --maps`: accuracy in open loop against the number of maps, by method."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np

from dm_tools.output import as_wavelengths, console, progress_bar
from studies.verbs.compare_mirrors import WORKERS_MAX


def run(seeds: Sequence[int], maps: Sequence[int], pixels: int = 236) -> list[dict[str, Any]]:
    """Judge the mirrors of `seeds`; a row for each method and number of maps, lengths in nm."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # for the processes to come: one core each
    from studies.comparison.few_maps import METHODS, judge_all

    found = []
    with progress_bar() as bar:
        task = bar.add_task("maps", total=len(seeds) * len(maps) * len(METHODS))
        for one in judge_all(seeds, maps, pixels, min(WORKERS_MAX, os.cpu_count() or 1)):
            found.append(one)
            bar.update(task, advance=1)
            end = one.failure or f"95 % within {1e9 * one.requests.quantile(0.95):.2f} nm"
            bar.console.print(f"seed {one.seed}, {one.method}, {one.maps} maps: {end}", highlight=False)
    of = {key: [one for one in found if (one.method, one.maps) == key] for key in product(METHODS, maps)}
    return [row_of(of[method, count], method, count) for count in maps for method in METHODS]


def row_of(judged: Sequence[Any], method: str, maps: int) -> dict[str, Any]:
    """Figures over the mirrors that were calibrated by one method with `maps` maps; `judged` holds one per mirror."""
    from studies.comparison.few_maps import GOAL

    served = sorted((one for one in judged if len(one.requests.error)), key=lambda one: one.seed)
    reached = [1e9 * one.requests.quantile(0.95) for one in served]
    return {
        "method": method,
        "maps": maps,
        "taken": max(one.taken for one in judged),
        "seconds": float(np.median([one.seconds for one in judged])),
        "p95_nm": {one.seed: value for one, value in zip(served, reached, strict=True)},
        "median_nm": float(np.median(reached)) if reached else None,
        "worst_nm": max(reached, default=None),
        "good": sum(value <= 1e9 * GOAL for value in reached),
        "inside": min((one.requests.coverage for one in served), default=None),
        "refused": sum(len(one.requests.refusals) for one in served),
        "failures": {one.seed: one.failure or one.requests.refusals[0] for one in judged if one not in served},
    }


def show(rows: Sequence[dict[str, Any]]) -> None:
    """Print the table."""
    from rich.table import Table

    table = Table(title="largest coefficient error of 95 % of the moves, 1 s each, on the true surface")
    figures = ("s", "median mirror", "", "worst", "within λ/200", "lowest inside", "refused", "none")
    for heading in ("maps", "method", *figures):
        table.add_column(heading, justify="left" if heading == "method" else "right")
    for row in rows:
        reached, judged = row["median_nm"], len(row["p95_nm"])
        table.add_row(
            str(row["maps"]),
            row["method"],
            f"{row['seconds']:.0f}",
            *((f"{reached:.1f} nm", as_wavelengths(1e-9 * reached)) if judged else ("", "")),
            f"{row['worst_nm']:.1f} nm" if judged else "",
            f"{row['good']} of {judged + len(row['failures'])}",
            f"{row['inside']:.0%}" if judged else "",
            str(row["refused"]) if judged else "",
            str(len(row["failures"]) or ""),
        )
    console.print(table)
    for reason in sorted({reason for row in rows for reason in row["failures"].values()}):
        console.print(f"none: {reason}")
