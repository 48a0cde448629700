"""The population of `dm compare --mirrors`: a table of mirrors drawn at random, and the figures over all of them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from dm_common.figures import with_wavelengths
from dm_tools.output import WAVELENGTH, as_wavelengths, console, progress_bar

#: Largest number of processes: a mirror takes a core and some 300 MB.
WORKERS_MAX = 2
#: Columns that the table needs.
TABLE_WIDTH = 140
#: Kinds of requests by their names in JSON.
GROUPS = ("any_order", "recipes", "restarted", "checked", "power_cut")


def run(seeds: Sequence[int], quick: bool) -> list[Any]:
    """Judge the mirrors of `seeds`, printing a line of each when it is done."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # for the processes to come: one core each
    from studies.comparison.population import ANY_ORDER, PopulationOptions, judge_population

    options = PopulationOptions(requests=10, maps=150, recipes=0, pixels=120) if quick else PopulationOptions()
    workers = min(WORKERS_MAX, os.cpu_count() or 1, len(seeds))
    outcomes = []
    with progress_bar() as bar:
        task = bar.add_task("mirrors", total=len(seeds))
        for outcome in judge_population(seeds, options, workers):
            outcomes.append(outcome)
            seed, order = outcome.mirror.simulation.seed, outcome.groups.get(ANY_ORDER)
            found = f"p90 {1e9 * order.quantile(0.9):.2f} nm, {order.coverage:.0%} inside" if order else "failed"
            bar.update(task, advance=1, description=f"mirrors: seed {seed}")
            bar.console.print(f"seed {seed}: {outcome.mirror.description()}: {found}", highlight=False)
    return outcomes


def row_of(outcome: Any) -> dict[str, Any]:
    """A mirror's figures for JSON; lengths in nm, null where there were no requests."""
    mirror = outcome.mirror
    row = {
        "seed": mirror.simulation.seed,
        "mirror": mirror.description(),
        "plant": mirror.simulation.law,
        "changes": mirror.changes,
        "law": outcome.law,
        "held_out_max_zernike_nm": _number(1e9 * outcome.held_out),
        "curvature_range": [_number(curvature) for curvature in outcome.curvatures],
        "failure": outcome.failure,
        "calibration_s": outcome.seconds[0],
        "seconds": outcome.seconds[1],
    }
    for name, requests in outcome.groups.items():
        row[name.replace(" ", "_")] = {
            "requests": len(requests.error),
            "p50_nm": _number(1e9 * requests.quantile(0.5)),
            "p90_nm": _number(1e9 * requests.quantile(0.9)),
            "max_nm": _number(1e9 * requests.quantile(1.0)),
            "bound_p50_nm": _number(1e9 * float(np.median(requests.upper))) if len(requests.upper) else None,
            "bound_coverage": _number(requests.coverage),
            "refusals": list(requests.refusals),
        }
    return row


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def figures_of(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures over all mirrors that do not change after calibration; `worst_in_ten` = 90 % quantile over mirrors.

    `without_errors`: mirrors that were not calibrated or refused every request, and are in none of these quantiles.
    """
    same = [row for row in rows if not row["changes"]]
    kept = [row for row in same if "any_order" in row]
    if not kept:
        return {}

    def over(group: str, name: str, share: float) -> float | None:
        values = [row[group][name] for row in kept if group in row and row[group][name] is not None]
        return float(np.quantile(values, share)) if values else None

    def inside(group: str) -> float | None:
        values = [row[group]["bound_coverage"] for row in kept if row.get(group, {}).get("bound_coverage") is not None]
        return min(values) if values else None

    worst = max(kept, key=lambda row: row["any_order"]["p90_nm"] or 0.0)
    return {
        "mirrors": len(kept),
        "without_errors": sum(not row.get("any_order", {}).get("requests") for row in same),
        "median_mirror": {name: over("any_order", name, 0.5) for name in ("p50_nm", "p90_nm", "max_nm")},
        "worst_in_ten": {name: over("any_order", name, 0.9) for name in ("p50_nm", "p90_nm", "max_nm")},
        "recipes_p90_nm": {
            "median_mirror": over("recipes", "p90_nm", 0.5),
            "worst_in_ten": over("recipes", "p90_nm", 0.9),
        },
        "lowest_coverage": {group: inside(group) for group in GROUPS},
        "covered_90_to_100": float(np.mean([(row["any_order"]["bound_coverage"] or 0.0) >= 0.9 for row in kept])),
        "refused": sum(len(row["any_order"]["refusals"]) for row in kept),
        "worst_seed": worst["seed"],
        "seconds_per_mirror": float(np.median([row["seconds"] for row in kept])),
    }


def show(rows: Sequence[dict[str, Any]]) -> None:
    """Print the table and the figures over all."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    title = "largest coefficient error of the true surface, nm; random order, dwell 0.1 s to 10 min"
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), width=max(console.width, TABLE_WIDTH))
    figures = ("p50", "", "p90", "", "max", "bound", "inside", "refused", "recipes", "restart", "checked", "cut", "s")
    for heading in ("seed", "mirror", *figures):
        table.add_column(heading, justify="left" if heading == "mirror" else "right", no_wrap=True)
    for row in rows:
        what = row["plant"].removeprefix("drawn_") + (" *" if row["changes"] else "")
        cells = [""] * (len(figures) - 1) if row["failure"] else _cells(row)
        table.add_row(str(row["seed"]), what, *cells, f"{row['seconds']:.0f}")
    console.print(table, crop=False)
    console.print(
        "bound: median of those told; recipes: p90; restart: largest error of the first requests after a day's hold "
        "and 10 min without power; checked: the same after three maps more; cut: after a power cut in a move; each "
        "with the share inside the bound that was told; s: of one core"
    )
    for row in rows:
        if row["failure"]:
            console.print(f"seed {row['seed']}: {row['failure']}")
    if any(row["changes"] for row in rows):
        console.print("* changes after its calibration, and does not count below")
    _show_population(figures_of(rows))


def _cells(row: dict[str, Any]) -> list[str]:
    order = row["any_order"]

    def both(group: str, name: str) -> str:
        figures = row.get(group, {})
        return f"{_text(figures.get(name), '.1f')} {_text(figures.get('bound_coverage'), '4.0%')}"

    return [
        *_length(order["p50_nm"]),
        *_length(order["p90_nm"]),
        _text(order["max_nm"], ".1f"),
        _text(order["bound_p50_nm"], ".1f"),
        _text(order["bound_coverage"], ".0%"),
        str(len(order["refusals"])),
        both("recipes", "p90_nm"),
        both("restarted", "max_nm"),
        both("checked", "max_nm"),
        both("power_cut", "max_nm"),
    ]


def _show_population(figures: dict[str, Any]) -> None:
    if not figures:
        return
    for name, text in (("median_mirror", "median mirror"), ("worst_in_ten", "worst mirror in ten")):
        recipes = figures["recipes_p90_nm"][name]
        console.print(
            f"{text}: p50 {_both(figures[name]['p50_nm'])}, p90 {_both(figures[name]['p90_nm'])}, "
            f"recipes p90 {'-' if recipes is None else f'{recipes:.2f} nm'}"
        )
    lowest = ", ".join(
        f"{group.replace('_', ' ')} {_text(value, '.0%')}" for group, value in figures["lowest_coverage"].items()
    )
    if lost := figures["without_errors"]:
        console.print(f"not calibrated, or every request refused: {lost}, not in these quantiles")
    console.print(
        f"{figures['mirrors']} mirrors; bound holds for 90 % or more of the requests on "
        f"{figures['covered_90_to_100']:.0%} of them; lowest coverage: {lowest}; refused inside the published range: "
        f"{figures['refused']}; worst mirror: seed {figures['worst_seed']}; "
        f"{figures['seconds_per_mirror']:.0f} s a mirror"
    )


def _length(value: float | None) -> tuple[str, str]:
    return (_text(value, ".2f"), as_wavelengths(1e-9 * value)) if value is not None else ("", "")


def _both(value: float | None) -> str:
    """A length in nm, and in wavelengths; "-" where there were no requests."""
    return "-" if value is None else with_wavelengths(f"{value:.2f} nm", 1e-9 * value, WAVELENGTH)


def _text(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
