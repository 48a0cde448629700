"""`dm compare`: every method on the same simulations, open loop and closed loop."""

from __future__ import annotations

import time
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from dm_tools.output import JsonOption, as_wavelengths, console, progress_bar, write_json

#: Options by the option that selects their table, "" = no such option; `seed` and `json` go with all.
TABLES = {
    "hysteresis": ("plant", "creep", "pixels", "quick"),
    "mirrors": ("maps", "quick"),
    "autofocus": (),
    "": ("plant", "method", "creep", "max_maps", "pixels"),
}


class Plant(StrEnum):
    """Hysteresis laws of the simulation; `all` = all with hysteresis, for the ablation."""

    none = "none"
    prandtl_ishlinskii = "prandtl_ishlinskii"
    preisach = "preisach"
    bouc_wen = "bouc_wen"
    mixed = "mixed"
    all = "all"


def figures_of(comparison: Any) -> dict[str, Any]:
    """A comparison's figures for JSON."""
    return {
        "methods": {
            name: {
                "p50_nm": 1e9 * row.p50,
                "p90_nm": 1e9 * row.p90,
                "rms_pct_pv": 100.0 * row.rms_share,
                "maps": row.maps,
                "seconds": row.seconds,
            }
            for name, row in comparison.rows().items()
        },
        "fitting_limit_nm": 1e9 * comparison.fitting_limit,
        "fitting_limit_pct_pv": 100.0 * comparison.fitting_limit_share,
    }


def show(comparison: Any) -> None:
    """Print the table."""
    from rich.table import Table

    from studies.comparison.compare import CLOSED

    table = Table(title="largest coefficient error of the true surface, over all spheres and seeds")
    for heading, side in (
        ("method", "left"),
        ("p50 nm", "right"),
        ("", "right"),
        ("p90 nm", "right"),
        ("", "right"),
        ("rms, % of PV", "right"),
        ("maps", "right"),
        ("s per focus", "right"),
    ):
        table.add_column(heading, justify=side)  # type: ignore[arg-type]
    loops = False
    for name, row in comparison.rows().items():
        if name.endswith(CLOSED) and not loops:
            loops = True
            table.add_section()
        table.add_row(
            name.removesuffix(CLOSED) + (", closed loop" if name.endswith(CLOSED) else ""),
            f"{1e9 * row.p50:.2f}",
            as_wavelengths(row.p50),
            f"{1e9 * row.p90:.2f}",
            as_wavelengths(row.p90),
            f"{100 * row.rms_share:.2f}",
            f"{row.maps:g}",
            f"{row.seconds:.2f}",
        )
    console.print(table)
    console.print(
        f"fitting limit of this mirror, best possible command: {1e9 * comparison.fitting_limit:.1f} nm rms for "
        f"the hardest sphere, {100 * comparison.fitting_limit_share:.2f} % of PV in the median"
    )


def compare(
    context: typer.Context,
    plant: Annotated[Plant, typer.Option(help="Hysteresis law of the simulation.")] = Plant.prandtl_ishlinskii,
    seed: Annotated[
        list[int] | None, typer.Option(min=0, help="Seed of a simulation; repeat it for several. Default: 1.")
    ] = None,
    method: Annotated[list[str] | None, typer.Option(help="Only these methods; repeat it for several.")] = None,
    creep: Annotated[float, typer.Option(min=0.0, max=0.2, help="Creep of the simulation per decade of time.")] = 0.01,
    max_maps: Annotated[
        int, typer.Option(min=1, help="Maps that a closed loop may take, each followed by a correction.")
    ] = 3,
    pixels: Annotated[int, typer.Option(min=64, max=2048, help="Camera of the simulation, pixels x pixels.")] = 236,
    hysteresis: Annotated[
        bool,
        typer.Option("--hysteresis", help="What each part of the model brings: hysteresis, creep, recipes."),
    ] = False,
    mirrors: Annotated[
        int,
        typer.Option(
            min=0,
            help="Judge so many mirrors drawn at random, one a seed from --seed on: errors and bounds in open loop.",
        ),
    ] = 0,
    maps: Annotated[
        list[int] | None,
        typer.Option(min=1, help="With --mirrors: what so many maps reach, beside pokes; repeat it for several."),
    ] = None,
    autofocus: Annotated[
        int, typer.Option(min=0, help="So many scenes drawn at random, from --seed on: searches of the sharpest focus.")
    ] = 0,
    quick: Annotated[
        bool, typer.Option("--quick", help="With --hysteresis or --mirrors: fewer maps and requests.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Compare all methods on the virtual bench: spheres from -0.05 to +0.05 1/m in random order.

    Runs in process, without nodes. Errors are those of the true surface, which only a simulation knows.
    With --hysteresis it is models that are compared, in open loop: any order, dwell times from 0.1 s to 10 min, tracked
    from the calibration on, after a degauss and after a power cycle.
    With --mirrors it is mirrors: each of another law and other parameters, at the shipped limits, with restarts.
    With --maps too it is numbers of maps: the hysteresis plan beside Hadamard patterns and push-pull pokes.
    With --autofocus it is searches of the sharpest focus: images and time that each takes, and how far off it ends.
    """
    if maps and (quick or not mirrors):
        raise typer.BadParameter("only with --mirrors, and without --quick", param_hint="--maps")
    table = next(name for name in TABLES if not name or context.params[name])
    for name in context.params.keys() - {table, *TABLES[table], "seed", "json"}:
        given = context.params[name] if name in TABLES else True  # 0 asks for no table
        source = context.get_parameter_source(name)
        if given and source is not None and source.name == "COMMANDLINE":
            hint = f"--{name.replace('_', '-')}"
            raise typer.BadParameter(f"without effect {f'with --{table}' if table else 'alone'}", param_hint=hint)
    if mirrors or autofocus:
        if seed and len(seed) > 1:
            raise typer.BadParameter("here it is the first of the seeds: give one", param_hint="--seed")
        first = seed[0] if seed else 1
        if mirrors and maps:
            _compare_maps(first, mirrors, maps, json)
        elif mirrors:
            _compare_mirrors(first, mirrors, quick, json)
        else:
            _compare_autofocus(first, autofocus, json)
        return
    if hysteresis:
        _compare_hysteresis(plant, tuple(seed or (1,)), creep, pixels, quick, json)
        return
    if plant is Plant.all:
        raise typer.BadParameter("all: only with --hysteresis", param_hint="--plant")
    from studies.comparison.compare import CompareOptions, total_steps
    from studies.comparison.compare import compare as run
    from studies.comparison.simulated_bench import SimulationConfig

    started = time.monotonic()
    options = CompareOptions(
        simulation=SimulationConfig(law=plant.value, creep=creep, pixels=pixels),
        seeds=tuple(seed or (1,)),
        methods=tuple(method or ()),
        loop=replace(CompareOptions().loop, max_maps=max_maps),
    )
    with progress_bar() as bar:
        task = bar.add_task("compare", total=total_steps(options))

        def step(description: str) -> None:
            bar.update(task, advance=1, description=description)

        comparison = run(options, step)
        bar.update(task, description="compare: done", completed=total_steps(options))
    show(comparison)
    figures = {
        "plant": plant.value,
        "seeds": list(options.seeds),
        "creep_per_decade": creep,
        "creep_foreseen": list(comparison.creep_rates),
        "max_maps": max_maps,
        "tolerance_nm": 1e9 * options.loop.tolerance,
    } | figures_of(comparison)
    write_json(json, figures | {"seconds": time.monotonic() - started})
    console.print(f"done in {time.monotonic() - started:.0f} s")


def _compare_hysteresis(
    plant: Plant, seeds: tuple[int, ...], creep: float, pixels: int, quick: bool, json: Path | None
) -> None:
    from studies.comparison.ablation import PLANTS
    from studies.comparison.simulated_bench import SimulationConfig
    from studies.verbs import compare_hysteresis

    if plant is Plant.none:
        raise typer.BadParameter("none: a simulation without hysteresis has nothing to compare", param_hint="--plant")
    started = time.monotonic()
    plants = PLANTS if plant is Plant.all else (plant.value,)
    result = compare_hysteresis.run(plants, seeds, SimulationConfig(creep=creep, pixels=pixels), quick)
    compare_hysteresis.show(result)
    figures = {
        "plant": plant.value,
        "seeds": list(seeds),
        "creep_per_decade": creep,
        "ablation": compare_hysteresis.rows_of(result),
        "identified": compare_hysteresis.identified_of(result),
    }
    write_json(json, figures | {"seconds": time.monotonic() - started})
    console.print(f"done in {time.monotonic() - started:.0f} s")


def _compare_mirrors(first: int, count: int, quick: bool, json: Path | None) -> None:
    from studies.verbs import compare_mirrors

    started = time.monotonic()
    rows = [compare_mirrors.row_of(outcome) for outcome in compare_mirrors.run(range(first, first + count), quick)]
    compare_mirrors.show(rows)
    figures = {"seeds": [row["seed"] for row in rows], "population": compare_mirrors.figures_of(rows), "mirrors": rows}
    write_json(json, figures | {"seconds": time.monotonic() - started})
    console.print(f"done in {time.monotonic() - started:.0f} s")


def _compare_maps(first: int, count: int, maps: list[int], json: Path | None) -> None:
    from studies.verbs import compare_maps

    started = time.monotonic()
    rows = compare_maps.run(range(first, first + count), maps)
    compare_maps.show(rows)
    write_json(json, {"seeds": list(range(first, first + count)), "rows": rows})
    console.print(f"done in {time.monotonic() - started:.0f} s")


def _compare_autofocus(first: int, count: int, json: Path | None) -> None:
    from studies.verbs import compare_autofocus

    started = time.monotonic()
    figures, false = compare_autofocus.run(first, count)
    compare_autofocus.show(figures, false)
    write_json(json, {"first_seed": first, "scenes": count, "searches": figures, "without_texture": false})
    console.print(f"done in {time.monotonic() - started:.0f} s")
