"""`dm demo`: the whole chain on the virtual bench, from the first poke to re-measured spheres."""

import os
import shutil
import time
from pathlib import Path
from shlex import quote
from typing import Annotated, Any

import typer
from rich.table import Table

from dm_bringup.suite import Suite
from dm_common.figures import with_wavelengths
from dm_tools.demo.demo_bench import (
    Hysteresis,
    bench_config,
    identify_hysteresis,
    make_empty,
    running_bench,
    usable_folder,
    wait_for_calibration,
)
from dm_tools.output import WAVELENGTH, JsonOption, as_wavelengths, console, next_step, progress_bar, write_json
from dm_tools.running_suite import usual_spheres
from dm_tools.verbs.calibrate import figures_of, run_calibration, show_result

#: Default number of maps for the identification of hysteresis and creep.
MAPS = 200


def ingest_real_map(path: Path, folder: Path, domain: int) -> dict[str, Any]:
    """Read a real map through an interferometer node of its own; returns the figures for JSON."""
    from dm_client import STARTING_S, DeformableMirrorClient

    nodes = ("interferometer",)
    with (
        Suite({"interferometer": {}}, folder / "ingest", domain, namespace="ingest", nodes=nodes),
        DeformableMirrorClient("ingest", domain, STARTING_S) as client,
    ):
        answer = client.ingest(str(path.resolve()))
    console.print(
        f"real map [bold]{path.name}[/]: {answer.info.width} x {answer.info.height}, "
        f"PV {1e9 * answer.info.pv:.1f} nm, rms {1e9 * answer.info.rms:.1f} nm, "
        f"21-term residual {1e9 * answer.zernike.residual_rms:.1f} nm"
    )
    return {
        "file": path.name,
        "pv_nm": 1e9 * answer.info.pv,
        "rms_nm": 1e9 * answer.info.rms,
        "valid_fraction": answer.info.valid_fraction,
    }


def best_possible(calibration: Any, mirror: Any, ends: tuple[float, float]) -> float:
    """Rms sag [m] that the best command inside the limits leaves at the ends of the sweep, according to the model."""
    from dm_controller.planning.active_calibration import active_calibration
    from dm_controller.planning.target import FocusTarget

    calibrated = active_calibration(calibration, mirror).mirror
    return max(calibrated.plan(FocusTarget(curvature)).rms for curvature in ends)


def sweep(client: Any, settle: float) -> list[dict[str, Any]]:
    """Request each curvature, measure the surface, and compare."""
    from dm_controller.planning.target import FocusTarget
    from dm_tools.verify import map_of, surface_error

    rows, curvatures = [], usual_spheres(client.capabilities)
    with progress_bar() as progress:
        for curvature in progress.track(curvatures, description="focus"):
            prediction = client.focus(curvature, dry_run=True)
            client.move_focus(curvature, settle_time=settle)
            measurement, image = client.measure_map(f"focus {curvature:+.3f}")
            sag, info = map_of(image), measurement.info
            error = surface_error(sag, info, FocusTarget(curvature))
            rows.append({"curvature": curvature, "prediction": prediction, "sag": sag, "info": info, "error": error})
    return rows


def show_sweep(rows: list[dict[str, Any]], fitting_limit: float, how: str) -> None:
    """Print the table: predicted and re-measured errors, and the fitting limit."""
    table = Table(title=f"open-loop focus, {how}: predicted before the move, re-measured after it")
    errors = ("predicted rms nm", "measured rms nm", "largest coeff. nm", "λ/n")
    for heading in ("curvature 1/m", "dioptre", *errors, "saturated"):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            f"{row['curvature']:+.3f}",
            f"{2 * row['curvature']:+.3f}",
            f"{1e9 * row['prediction'].predicted_rms:.1f}",
            f"{1e9 * row['error'].rms:.1f}",
            f"{1e9 * row['error'].max_zernike:.2f}",
            as_wavelengths(row["error"].max_zernike),
            "yes" if row["prediction"].saturated else "no",
        )
    console.print(table)
    worst = max(row["error"].max_zernike for row in rows)
    console.print(
        f"fitting limit of this mirror at the ends of the sweep: {1e9 * fitting_limit:.1f} nm rms; "
        f"largest coefficient error of the sweep: {with_wavelengths(f'{1e9 * worst:.2f} nm', worst, WAVELENGTH)}"
    )


def rows_for_json(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The figures of a sweep."""
    return [
        {
            "curvature": row["curvature"],
            "predicted_rms_nm": 1e9 * row["prediction"].predicted_rms,
            "measured_rms_nm": 1e9 * row["error"].rms,
            "max_zernike_nm": 1e9 * row["error"].max_zernike,
            "saturated": row["prediction"].saturated,
        }
        for row in rows
    ]


def demo(
    hysteresis: Annotated[
        Hysteresis,
        typer.Option(
            help="Hysteresis of the simulated actuators: each its own, drawn by the seed, or one law for all; `off` = "
            "ideal ones, without creep too."
        ),
    ] = Hysteresis.drawn_preisach,
    creep: Annotated[
        float | None, typer.Option(min=0.0, max=0.1, help="Creep per decade of time; default 0.01.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31, help="Seed of the simulation.")] = 1,
    speed: Annotated[
        float, typer.Option(min=0.0, max=3600.0, help="How much faster than real time; 0 = real time.")
    ] = 20.0,
    hysteresis_maps: Annotated[
        int, typer.Option(min=0, help="Maps to identify hysteresis and creep from; 0 = leave that out.")
    ] = MAPS,
    map_file: Annotated[Path | None, typer.Option("--map", help="A real ZYGO file to ingest first.")] = None,
    config_file: Annotated[
        Path | None, typer.Option("--config", help="Parameter file of another virtual bench, such as mirror_19.yaml.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for logs, calibration and picture.")] = Path("runs/demo"),
    keep_maps: Annotated[bool, typer.Option(help="Keep the map files (about 4 MB each).")] = False,
    camera: Annotated[
        bool, typer.Option("--camera", help="Autofocus a virtual camera behind the mirror on three objects instead.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Calibrate a virtual mirror (a PDM30-37) through the real nodes, wire protocol and file formats, then focus it."""
    from dm_calibration.hysteresis.excitation import MAPS_MAX, MAPS_MIN

    if creep is None:
        creep = 0.0 if hysteresis is Hysteresis.off else 0.01
    if hysteresis_maps and not MAPS_MIN <= hysteresis_maps <= MAPS_MAX:
        raise typer.BadParameter(f"--hysteresis-maps {hysteresis_maps}: must be 0, or {MAPS_MIN} to {MAPS_MAX}")
    if camera:
        from dm_tools.demo.demo_camera import demo_camera

        if config_file or map_file or keep_maps or hysteresis_maps != MAPS:
            options = "--config, --map, --hysteresis-maps or --keep-maps"
            raise typer.BadParameter(f"--camera and {options}: the camera has a bench of its own")
        demo_camera(hysteresis.value, creep, seed, speed, out, json)
        return
    from dm_msgs.action import Calibrate

    from dm_client import DeformableMirrorClient
    from dm_common.ros.domains import own_domain
    from dm_tools.demo.figures import save_sweep_figure
    from dm_tools.doctor.bench import effective

    started = time.monotonic()
    folder = usable_folder(out)
    if map_file is not None and (not map_file.is_file() or map_file.resolve().is_relative_to(folder)):
        raise ValueError(f"--map {map_file}: must be a file outside of the folder {out}, which is emptied")
    config = bench_config(folder, hysteresis.value, creep, seed, speed, config_file)  # first: the file may be in `out`
    make_empty(folder)
    name = config["pdm_driver"].get("mirror.name", "PDM30-37")
    figures: dict[str, Any] = {"plant": hysteresis.value, "creep_per_decade": creep, "seed": seed}
    with own_domain() as domain:
        if map_file is not None:
            figures["real_map"] = ingest_real_map(map_file, folder, domain)
        console.print(
            f"virtual bench: {name}, hysteresis {hysteresis.value}, creep {creep:.0%} per decade, "
            f"seed {seed}; its time runs {f'{speed:g} times as fast as' if speed else 'as'} real time; logs in "
            f"{os.path.relpath(folder)}"
        )
        with running_bench(config, folder, domain, DeformableMirrorClient) as client:
            begun = time.monotonic()
            result = run_calibration(client, Calibrate.Goal(activate=True, note="demo"))
            wall_time = time.monotonic() - begun
            show_result(result)
            wait_for_calibration(client, result.id)
            console.print(f"reachable: {client.capabilities.message}")
            mirror = client.mirror_info
            settle = effective(config, "calibration")["settle_time"]
            rows, without_hysteresis = sweep(client, settle), []
            ends = rows[0]["curvature"], rows[-1]["curvature"]
            fitting_limit = best_possible(client.latest("calibration"), mirror, ends)
            if hysteresis_maps and (hysteresis is not Hysteresis.off or creep):
                show_sweep(rows, fitting_limit, "influence function alone")
                console.print("an influence function contains no hysteresis and creep; they are identified now")
                identified = identify_hysteresis(client, hysteresis_maps, "demo, hysteresis")
                wait_for_calibration(client, identified.id)
                client.degauss()
                without_hysteresis, rows = rows, sweep(client, settle)
                figures["hysteresis"] = figures_of(identified)
                figures["focus_without_hysteresis"] = rows_for_json(without_hysteresis)
    show_sweep(
        rows, fitting_limit, "hysteresis and creep inverted" if without_hysteresis else "influence function alone"
    )
    title = f"simulated {name}, hysteresis: {hysteresis.value}"
    picture = save_sweep_figure(rows, folder / "demo.png", title, mirror, without_hysteresis)
    console.print(f"picture: {os.path.relpath(picture)}")
    if not keep_maps:
        shutil.rmtree(folder / "maps")
    figures |= {
        "calibration": figures_of(result) | {"seconds": wall_time, "bench_seconds": result.duration},
        "focus": rows_for_json(rows),
        "fitting_limit_nm": 1e9 * fitting_limit,
        "seconds": time.monotonic() - started,
    }
    write_json(json, figures)
    console.print(f"done in {time.monotonic() - started:.0f} s")
    option = f" --config {quote(str(config_file))}" if config_file else ""
    next_step(f"./dm up{option} starts such nodes for you to play with; ./dm demo --camera focuses a camera")
