"""`dm paper`: the paper's tables and figures on the virtual bench, beside the paper's own values."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from dm_tools.output import JsonOption, console, progress_bar, write_json


def show(results: Any) -> None:
    """Print the main figures."""
    import numpy as np
    from rich.table import Table

    from studies.paper import reported
    from studies.paper.regressions import TAKEN, relative_errors

    table = Table(title=f"regression of the surface control error, reading {TAKEN.value!r}, beside the paper's")
    for heading in ("model", "adj. R²", "paper", "held-out rms nm", "worst RelErr %", "paper"):
        table.add_column(heading, justify="left" if heading == "model" else "right")
    for model, regression in results.standard.regressions.taken.items():
        table.add_row(
            model,
            f"{regression.table2.adjusted_r2:.3f}",
            f"{reported.TABLE_2[model].adj_r2:.3f}",
            f"{1e9 * regression.table2.leave_one_out_rms:.2f}",
            f"{100 * np.nanmax(relative_errors(regression)):.2f}",
            f"{max(pair[model].rel_err_pct for pair in reported.TABLE_3.values()):.2f}",
        )
    console.print(table)
    _show_control(results)
    _show_sampling(results)
    console.print(
        f"row weights cancel: G changes by {results.standard.samples.weights_cancel:.1e} m per unit signal at most"
    )


def _show_control(results: Any) -> None:
    import numpy as np
    from rich.table import Table

    from studies.paper.page.content_coefficients import BY_ORDER, MARKS

    table = Table(title=f"largest coefficient error of the true surface over the spheres, {BY_ORDER}")
    table.add_column("bench and reading")
    for heading in ("median nm", *(f"λ/{mark}" for mark in MARKS), "maps"):
        table.add_column(heading, justify="right")
    for name, bench in results.benches.items():
        for (method, reading), series in bench.spheres.items():
            if method == BY_ORDER:
                table.add_row(
                    f"{name}, {reading}",
                    f"{1e9 * float(np.median(series.true_max_zernike)):.2f}",
                    *(f"{series.share_within(mark):.0%}" for mark in MARKS),
                    f"{np.mean([shot.maps for shot in series.shots]):.1f}",
                )
    console.print(table)


def _show_sampling(results: Any) -> None:
    from rich.table import Table

    table = Table(title="ways to sample a map: errors of the 21 terms, rms sag")
    table.add_column("way")
    for heading in ("samples", "bias nm", "noise nm", "ringing at the rim nm"):
        table.add_column(heading, justify="right")
    for name, way in results.sampling.results.items():
        lengths = (way.bias_rms, way.noise_rms, way.rim_ringing_rms)
        table.add_row(name, f"{way.samples}", *(f"{1e9 * length:.3f}" for length in lengths))
    console.print(table)


def paper(
    out: Annotated[Path, typer.Option(help="Folder for the page, its pictures and the PDF.")] = Path("runs/paper"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulation.")] = 1,
    quick: Annotated[
        bool, typer.Option(help="A small camera, few spheres and one further simulation: under half a minute.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Reproduce the paper: Tables 1-3 and Figs. 4-9 as an HTML page with PNGs and a PDF, beside the paper's values.

    Runs on the virtual bench in process, without nodes: 10 % hysteresis and 1 % creep, and ideal actuators beside it.
    """
    from studies.paper.page.page import write_page
    from studies.paper.results import PaperOptions, measure
    from studies.paper.summary import figures_of

    started = time.monotonic()
    folder = out.resolve()
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--out {out}: is a file; name a folder, which need not exist yet")
    folder.mkdir(parents=True, exist_ok=True)
    options = PaperOptions.quick(seed) if quick else PaperOptions.full(seed)
    with progress_bar() as bar:
        task = bar.add_task("paper", total=options.steps + 1)
        begun = False

        def step(what: str) -> None:
            # A step is announced before it begins, so the bar advances by the one before.
            nonlocal begun
            bar.update(task, advance=1 if begun else 0, description=what)
            begun = True

        results = measure(options, step)
        step("page, pictures and PDF")
        written = write_page(results, folder)
        bar.update(task, description="paper: done", completed=options.steps + 1)
    show(results)
    console.print(f"page: {os.path.relpath(written.html)}\nPDF: {os.path.relpath(written.pdf)}")
    figures = {"quick": quick} | figures_of(results)
    files = {
        "html": str(written.html),
        "pdf": str(written.pdf),
        "pictures": [path.name for path in written.pictures],
    }
    write_json(json, figures | {"files": files, "seconds": time.monotonic() - started})
    console.print(f"done in {time.monotonic() - started:.0f} s")
