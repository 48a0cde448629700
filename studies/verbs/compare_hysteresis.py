"""The ablation of `dm compare --hysteresis`: its table and its figures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dm_tools.output import as_wavelengths, console, progress_bar


def run(plants: Sequence[str], seeds: Sequence[int], simulation: Any, quick: bool) -> Any:
    """Run the ablation with a progress bar."""
    from studies.comparison.ablation import AblationOptions, ablate, total_steps

    defaults = AblationOptions()
    options = AblationOptions(
        simulation, plants, seeds, requests=10 if quick else defaults.requests, maps=150 if quick else defaults.maps
    )
    with progress_bar() as bar:
        task = bar.add_task("ablation", total=total_steps(options))
        result = ablate(options, lambda step: bar.update(task, advance=1, description=step))
        bar.update(task, description="ablation: done", completed=total_steps(options))
    return result


def rows_of(ablation: Any) -> list[dict[str, Any]]:
    """A row for each series and dwell time, and one over all dwell times (`dwell_s` null, with the hold of an hour)."""
    from studies.comparison.ablation_figures import figures_of
    from studies.comparison.random_requests import DWELLS

    rows = []
    for series in ablation.series:
        for dwell in (None, *DWELLS):
            requests = series.requests if dwell is None else series.requests.held(dwell)
            figures = figures_of(requests, ablation.radius)
            row = {
                "plant": series.plant,
                "model": series.model,
                "history": series.history,
                "dwell_s": dwell,
                "requests": figures.requests,
                "p50_nm": 1e9 * figures.p50,
                "p90_nm": 1e9 * figures.p90,
                "rms_pct_pv": 100.0 * figures.rms_share,
                "rms_pct_pv_beyond_fitting_limit": 100.0 * figures.excess_share,
                "bound_coverage": figures.bound_coverage,
            }
            if dwell is None:
                row["hold_1h_nm"] = 1e9 * float(series.hold_1h.max())
            rows.append(row)
    return rows


def identified_of(ablation: Any) -> list[dict[str, Any]]:
    """Result of the identification on each simulation."""
    return [
        {
            "plant": found.plant,
            "seed": found.seed,
            "law": found.law,
            "held_out_max_zernike_nm": 1e9 * found.held_out_max_zernike,
        }
        for found in ablation.identified
    ]


def show(ablation: Any) -> None:
    """Print the rows over all dwell times."""
    from rich.table import Table

    table = Table(title="open loop, random order, dwell 0.1 s to 10 min: largest coefficient error of the true surface")
    for heading in ("plant", "model", "history"):
        table.add_column(heading)
    for heading in ("p50 nm", "", "p90 nm", "", "rms, % of PV", "beyond limit", "in bound", "1 h drift nm"):
        table.add_column(heading, justify="right")
    plant = ""
    for row in rows_of(ablation):
        if row["dwell_s"] is not None:
            continue
        if plant not in ("", row["plant"]):
            table.add_section()
        plant = row["plant"]
        table.add_row(
            plant,
            row["model"],
            row["history"],
            f"{row['p50_nm']:.2f}",
            as_wavelengths(1e-9 * row["p50_nm"]),
            f"{row['p90_nm']:.2f}",
            as_wavelengths(1e-9 * row["p90_nm"]),
            f"{row['rms_pct_pv']:.2f}",
            f"{row['rms_pct_pv_beyond_fitting_limit']:.2f}",
            f"{row['bound_coverage']:.0%}",
            f"{row['hold_1h_nm']:.2f}",
        )
    console.print(table)
    for found in ablation.identified:
        console.print(
            f"{found.plant}, seed {found.seed}: {found.law}, "
            f"{1e9 * found.held_out_max_zernike:.2f} nm expected of held-out moves (95 %)"
        )
