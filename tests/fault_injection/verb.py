"""`dm faults`: faults, damaged files and a long run against real nodes and readers, and what they cost."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from dm_tools.output import JsonOption, console, fail, progress_bar, write_json

#: Damaged files per format: of a short run, and at most.
FILES_LEAST, FILES_MOST = 1_000, 100_000
#: Length of the long run where no time is given, s; and its share of the time that is.
SOAK_LEAST_S, SOAK_SHARE = 30.0, 0.2


def show_faults(records: Any, words: dict[str, str]) -> None:
    """Print the table of faults."""
    from rich.table import Table

    table = Table(title="faults; harm = frames beyond a limit at the electronics")
    for heading in ("fault", "injected", "harm", "lost", "recovery p50, s", "max, s", ""):
        table.add_column(heading, justify="left" if heading in ("fault", "") else "right")
    for record in records:
        figures = record.figures()
        middle, longest = figures["recovery_s_p50"], figures["recovery_s_max"]
        table.add_row(
            record.name,
            str(record.injected),
            str(record.limit_violations),
            str(record.lost),
            "" if middle is None else f"{middle:.2f}",
            "" if longest is None else f"{longest:.2f}",
            f"left out: {record.skipped}" if record.skipped else words[record.name],
        )
        for remark in record.remarks[:3]:
            table.add_row("", "", "", "", "", "", f"[yellow]{remark[:200]}[/]")
    console.print(table)


def show_fuzz(results: dict[str, Any]) -> None:
    """Print the table of damaged files."""
    from rich.table import Table

    table = Table(title="damaged files, by what the reader made of them")
    columns = ("files", "crashes", "hangs", "wrong_maps", "refused", "intact", "other_samples", "other_header")
    table.add_column("format")
    for column in columns:
        table.add_column(column.replace("_", " "), justify="right")
    for name, result in results.items():
        table.add_row(name, *(str(getattr(result, column)) for column in columns))
    console.print(table)
    console.print(
        "other samples, other header: formats without a checksum, where a changed value is a legal other one; "
        "see docs/safety.md"
    )


def show_soak(figures: dict[str, Any]) -> None:
    """Print what a long run came to."""
    console.print(
        f"{figures['minutes']:.1f} min at {figures['rate']:.0f} requests/s, {figures['answered']} of "
        f"{figures['requests']} answered (a newer one overtakes an older); largest growth of a node: "
        f"{figures['rss_growth_mb']:+.1f} MB, {figures['handles_growth']:+.0f} handles, "
        f"{figures['threads_growth']:+.0f} threads; request to command p99 {figures['p99_start_us'] / 1e3:.1f} ms at "
        f"the start, {figures['p99_ratio_end_to_start']:.2f} x that at the end (a bare relay beside it: "
        f"{figures['relay_p99_ratio_end_to_start']:.2f} x)"
    )


def faults(
    minutes: Annotated[
        float, typer.Option(min=0.0, help="Go on for so long, shared by faults, files and the long run; 0 = once.")
    ] = 0.0,
    only: Annotated[
        str,
        typer.Option(
            "--faults",
            help="Only these, separated by commas: single faults or groups (driver, wire, controller, processes, "
            "calibration, network; fuzz: the readers; soak: a long run).",
        ),
    ] = "",
    seed: Annotated[int, typer.Option(min=0, help="Of the damage and of the moments at which faults come.")] = 1,
    json: JsonOption = None,
) -> None:
    """Inject faults into real processes, damage files, run for long; exit status 1 when anything was harmed or lost."""
    from dm_common.ros.domains import own_domain
    from fault_injection.fault import run_faults
    from fault_injection.faults.registry import OTHERS, select
    from fault_injection.fuzz.fuzz import fuzz_all
    from fault_injection.fuzz.reference_files import FORMATS
    from fault_injection.soak import soak
    from fault_injection.soak_result import SoakResult

    names = [name.strip() for name in only.split(",") if name.strip()]
    single = [name for name in names if name not in OTHERS]
    chosen = select(single) if single or not names else []
    fuzzing, soaking = (not names or name in names for name in OTHERS)
    started = time.monotonic()
    whole_s = 60.0 * minutes
    # What is asked for alone has all the time; the long run beside others a fixed share of it.
    soak_s = max(whole_s * (SOAK_SHARE if chosen or fuzzing else 1.0), SOAK_LEAST_S) if soaking else 0.0
    rest_s = max(whole_s - soak_s, 0.0)
    records: list[Any] = []
    results: dict[str, Any] = {}
    long_run: SoakResult | None = None
    with tempfile.TemporaryDirectory(prefix="dm-faults-") as name, own_domain() as domain, progress_bar() as bar:
        folder = Path(name)
        os.environ["ROS_HOME"] = name  # what nodes keep of these mirrors goes with them
        if chosen:
            task = bar.add_task("faults", total=len(chosen))
            records = run_faults(
                chosen,
                folder,
                domain,
                seed,
                started + (rest_s / 2 if fuzzing else rest_s),
                lambda fault: bar.update(task, advance=1, description=fault),
            )
            bar.update(task, completed=len(chosen), description="faults: done")
        if fuzzing:
            files = FILES_MOST if minutes else FILES_LEAST
            # Every fault comes once, however short the time; the readers get their half in any case.
            end = max(started + rest_s, time.monotonic() + rest_s / 2) if minutes else float("inf")
            tasks = {form: bar.add_task(f"damaged {form}", total=files) for form in FORMATS}
            results = fuzz_all(
                dict.fromkeys(FORMATS, files),
                folder,
                seed,
                end,
                lambda form, count: bar.update(tasks[form], advance=count),
                workers=len(FORMATS) if minutes else 2,  # all of them share the time there is
            )
        if soaking:
            soak_task = bar.add_task("long run", total=1.0)
            long_run = soak(soak_s, folder / "soak", domain, seed, lambda share: bar.update(soak_task, completed=share))
    if records:
        show_faults(records, {fault.name: fault.words for fault in chosen})
    if results:
        show_fuzz(results)
    if long_run is not None:
        show_soak(long_run.figures())
    figures = {
        "faults": [record.figures() for record in records],
        "fuzz": {form: result.figures() for form, result in results.items()},
        "soak": None if long_run is None else long_run.figures(),
        "seed": seed,
        "seconds": time.monotonic() - started,
    }
    write_json(json, figures)
    harmed = [record.name for record in records if not record.harmless]
    harmed += [f"reader of {form}" for form, result in results.items() if result.harm]
    harmed += [f"long run: {words}" for words in (long_run.complaints() if long_run is not None else [])]
    if harmed:
        fail(f"harmed or lost: {', '.join(harmed)}")
        raise typer.Exit(1)
    console.print(f"no harm, nothing lost, in {time.monotonic() - started:.0f} s")
