"""`dm measure`: take one map. `dm check`: compare one with the calibration in use, and let it improve it.
`dm instrument`: find from files what the interferometer itself adds to every map.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from dm_common.figures import two_fold
from dm_tools.output import JsonOption, NamespaceOption, TakeOverOption, console, nanometres, next_step, write_json
from dm_tools.running_suite import REPORT_S, hear_health, kept, naming_holder, running_suite, settled_shape, verdict


def measure(
    label: Annotated[str, typer.Option(help="Goes into the log.")] = "",
    reference_sphere: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="In place of the mirror stands a sphere of this radius of curvature (negative = convex): find the "
            "lateral scale from it.",
        ),
    ] = None,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Take one map of the mirror as it stands, and say what it shows. Nothing moves."""
    from dm_common.optics.zernike import PISTON_TILT, SPOKEN, curvature_of, rms_beyond_tilt

    with running_suite(namespace) as client:
        answer = client.measure(label)
    info, coefficients = answer.info, list(answer.zernike.coefficients)
    figures: dict[str, Any] = {
        "curvature": curvature_of(coefficients, info.aperture_radius) if info.aperture_radius > 0 else None,
        "rms_beyond_tilt_nm": nanometres(rms_beyond_tilt(coefficients, answer.zernike.residual_rms)),
        "rms_nm": nanometres(info.rms),
        "pv_nm": nanometres(info.pv),
        "valid_fraction": info.valid_fraction,
        "zernike_nm": {name: nanometres(value) for name, value in zip(SPOKEN, coefficients, strict=True)},
        "file": info.file,
    }
    terms = list(figures["zernike_nm"].items())[PISTON_TILT:]
    largest = sorted(terms, key=lambda term: -abs(term[1]))[:3]
    console.print(
        f"{figures['rms_beyond_tilt_nm']:.1f} nm rms beyond tilt, of the whole map {figures['rms_nm']:.1f} nm rms and "
        f"{figures['pv_nm']:.1f} nm peak to valley; {info.valid_fraction:.0%} of the aperture valid"
    )
    console.print(
        f"largest coefficients beyond tilt: {', '.join(f'{name} {value:+.1f} nm' for name, value in largest)}"
    )
    if figures["curvature"] is not None:
        console.print(f"defocus: as of a surface of {round(figures['curvature'], 4) + 0.0:+.4f} 1/m")
    console.print(f"file: {info.file}", soft_wrap=True)
    if reference_sphere is not None:
        figures["pitch"] = _scale(info, coefficients, reference_sphere)
        write_json(json, {"measure": figures})
        next_step("put the parameters into the parameter file; then take the sphere out")
        return
    write_json(json, {"measure": figures})
    next_step("./dm check compares a map with the calibration in use")


def _scale(info: Any, coefficients: list[float], radius_of_curvature: float) -> float:
    """Say what lateral resolution (m per pixel) a map of a known sphere shows, as parameters, and what limits it."""
    from dm_common.optics.conic import pitch_of_sphere

    try:
        pitch, share = pitch_of_sphere(coefficients, info.aperture_radius_px, info.pitch, radius_of_curvature)
    except ValueError as error:
        raise typer.BadParameter(f"--reference-sphere: {error}") from error
    differs = f", {pitch / info.pitch - 1.0:+.3%} against what is in use" if info.pitch > 0.0 else ""
    console.print(
        f"pitch: {pitch * 1e6:.5f} um{differs}; each nm of the instrument's own error in defocus is {share:.3%} of it, "
        "and the sphere's radius counts by half",
        soft_wrap=True,
    )
    console.print(f"/**/interferometer:\n  ros__parameters:\n    pitch: {pitch:.12f}")
    if info.instrument_error > 0.0:
        console.print(f"    scale_error: {1e9 * info.instrument_error * share:.6f}")
    return pitch


class Procedure(StrEnum):
    """What `dm instrument` finds."""

    FLATS = "flats"
    RETRACE = "retrace"
    GRID = "grid"


def instrument(
    procedure: Annotated[
        Procedure,
        typer.Argument(
            help="flats: the reference surface, from a table of maps of flats (file, reference, part, degrees). "
            "retrace: what goes with tilt, from maps of one shape under different tilts. grid: lateral scale and "
            "distortion, from a table of marks (column, row, x, y; m) and a map with the same zoom."
        ),
    ],
    files: Annotated[list[Path], typer.Argument(help="Tables (CSV with these headings), map files.")],
    write: Annotated[Path | None, typer.Option(metavar="FILE.fits", help="Where the reference surface goes.")] = None,
    xyz_unit: Annotated[str, typer.Option(help="Unit of .xyz files, and of FITS files without one.")] = "",
    json: JsonOption = None,
) -> None:
    """Find the errors of the interferometer itself from files, as parameters to paste. Needs no nodes."""
    from dm_calibration.influence.poke_cure import parameter_text
    from dm_calibration.map_files import MapFileError, read_map

    def read(path: Path) -> Any:
        return read_map(path, xyz_unit=xyz_unit or None)

    if (write is not None) != (procedure is Procedure.FLATS):
        raise typer.BadParameter("--write FILE.fits: flats need it, the others leave no file")
    wanted = {Procedure.FLATS: (1, "one table of maps"), Procedure.GRID: (2, "the table of marks and one map")}
    if procedure in wanted and len(files) != wanted[procedure][0]:
        raise typer.BadParameter(f"{len(files)} files: must be {wanted[procedure][1]}")
    try:
        if write is not None:
            found = _flats(files[0], write, read)
        elif procedure is Procedure.RETRACE:
            found = _retrace([read(file).sag for file in files])
        else:
            found = _grid(files[0], read(files[1]).sag.shape)
    except (MapFileError, ValueError, OSError) as error:
        raise typer.BadParameter(str(error)) from error
    console.print(parameter_text({"interferometer": found}), soft_wrap=True, markup=False, highlight=False)
    write_json(json, {"instrument": found})
    next_step("put the parameters into the parameter file; `instrument_error` is the bound on what is left")


def _flats(table: Path, target: Path, read: Callable[[Path], Any]) -> dict[str, Any]:
    """Write the error of the flat that is the first reference in `table`."""
    from dm_calibration.map_files.fits import fits_bytes
    from dm_calibration.optics.flats import FlatTest, reference_from_flats
    from dm_common.atomic_write import write_whole

    rows = _table(table, "file", "reference", "part", "degrees")
    surfaces = [read(table.parent / row[0]) for row in rows]
    tests = [
        FlatTest(surface.sag, reference, part, math.radians(float(degrees)))
        for surface, (_, reference, part, degrees) in zip(surfaces, rows, strict=True)
    ]
    found = reference_from_flats(tests)
    write_whole(target, fits_bytes(replace(surfaces[0], sag=found.sag), "dm instrument flats"))
    console.print(
        f"{target}: the flat {tests[0].reference}, from {len(tests)} maps, which disagree by "
        f"{nanometres(found.left):.2f} nm rms",
        soft_wrap=True,
    )
    if found.open_orders:
        orders = ", ".join(map(str, found.open_orders))
        console.print(
            f"not told by these maps, and left out: angular orders {orders} (0 = what is the same all round); exchange "
            "the flats, or turn one by an angle of no simple share of a turn",
            soft_wrap=True,
        )
    known = not found.open_orders and math.isfinite(found.bound)
    return {"reference_surface": str(target.absolute())} | ({"instrument_error": found.bound} if known else {})


def _retrace(maps: list[Any]) -> dict[str, Any]:
    from dm_calibration.optics.instrument import find_retrace

    found, before, left = find_retrace(maps)
    console.print(
        f"coefficients differ by up to {nanometres(before):.2f} nm between these maps, by {nanometres(left):.2f} nm "
        "without the retrace error"
    )
    return {"retrace": [round(float(value), 9) for value in found]}


def _grid(table: Path, shape: tuple[int, int]) -> dict[str, Any]:
    from dm_calibration.optics.instrument import lateral_scale

    marks = [[float(value) for value in row] for row in _table(table, "column", "row", "x", "y")]
    found = lateral_scale(marks, shape)
    console.print(
        f"distortion {found.distortion:+.3%} +- {found.distortion_error:.3%} at the edge; the marks are "
        f"{found.left * 1e6:.2f} um from where that puts them, rms",
        soft_wrap=True,
    )
    return {
        "pitch": round(found.pitch, 12),
        "distortion": round(found.distortion, 7),
        "scale_error": round(found.scale_error, 7),
    }


def _table(path: Path, *names: str) -> list[list[str]]:
    """The rows of a CSV file with these headings, in any order; `degrees` may be missing and is 0 then.

    Raises:
        ValueError: naming the file, and the line that lacks a value.
    """
    with path.open(newline="", encoding="utf-8-sig") as file:  # spreadsheets put a mark before the first heading
        rows = list(csv.DictReader(file, restval="", skipinitialspace=True))
    missing = [name for name in names if name != "degrees" and (not rows or name not in rows[0])]
    if missing:
        raise ValueError(f"{path}: has no column {', '.join(missing)}; the first line must name {', '.join(names)}")
    default = {"degrees": "0"}
    table = [[row.get(name, "").strip() or default.get(name, "") for name in names] for row in rows]
    for number, values in enumerate(table, start=1):
        if "" in values:
            raise ValueError(f"{path}: row {number} below the headings has no {names[values.index('')]}")
    return table


def check(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Compare only; the calibration stays as it is.")] = False,
    forget: Annotated[bool, typer.Option("--forget", help="Drop all earlier updates; no map is taken.")] = False,
    without: Annotated[
        list[int] | None,
        typer.Option(
            metavar="NUMBER",
            help="Go on without this actuator, which does not move any more; repeatable. --forget takes it back.",
        ),
    ] = None,
    take_over: TakeOverOption = False,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Check the calibration against the mirror as it stands, and follow its drift.

    Needs the running suite (`dm up`) with an interferometer. Nothing moves. Exit status 1 when the map disagrees,
    or shows a larger error than is promised.
    """
    if forget and (dry_run or without):
        raise typer.BadParameter(f"--{'dry-run' if dry_run else 'without'} and --forget: only one of them")
    with running_suite(namespace) as client, naming_holder(client):
        health = hear_health(client)
        response = client.update_calibration(dry_run=dry_run, forget=forget, without=without or (), take_over=take_over)
        calibration = client.latest("calibration")
        # What the shape that stands was promised, and not what the calibration promises of any.
        client.wait(lambda: "focus_controller" in health, REPORT_S)
    shape, capabilities = settled_shape(health), client.messages.get("capabilities")
    if shape is not None:
        promised = shape.bound
    elif capabilities is not None:
        promised = capabilities.error_bound
    else:  # without a focus controller, what the calibration's own maps showed
        promised = calibration.hysteresis.held_out_max_zernike or calibration.held_out_max_zernike
    if forget:
        console.print(response.message)
    else:
        console.print(f"largest coefficient: {verdict(promised, response.max_zernike)}")
        console.print(two_fold(promised, calibration, shape.curvature if shape else 0.0), soft_wrap=True)
        if not response.accepted:
            console.print(f"[red]the map disagrees with the calibration[/]: {response.message}", soft_wrap=True)
        elif without:
            console.print(response.message, soft_wrap=True)
    console.print(
        f"since the calibration was made: {response.revision} maps taken in, gains changed by up to "
        f"{response.gain_drift:.2%}, the figure by {nanometres(response.offset_drift):.2f} nm rms"
    )
    write_json(json, {"check": figures_of(response) | {"promised_nm": nanometres(promised)}})
    if not (response.accepted or forget):
        cure = "as the message says, or ./dm calibrate" if "--without" in response.message else "./dm calibrate"
        next_step(f"./dm degauss and ./dm check again; if it still disagrees, {cure}")
        raise typer.Exit(1)
    if not (forget or without or kept(promised, response.max_zernike)):
        next_step("one map in twenty may be outside: ./dm check again with another shape; if it is too, ./dm calibrate")
        raise typer.Exit(1)
    if without and not dry_run:
        next_step("ask for the shape again: the command that stands counts on all actuators; ./dm status has the range")
        return
    next_step(
        "./dm report writes what the calibration holds"
        if calibration.hysteresis.play_radius
        else "./dm calibrate finds the hysteresis too, and promises far less than this"
    )


def figures_of(response: Any) -> dict[str, Any]:
    """A check's figures for JSON."""
    return {
        "accepted": response.accepted,
        "max_zernike_nm": nanometres(response.max_zernike),
        "rms_nm": nanometres(response.rms),
        "surprise": response.surprise,
        "revision": response.revision,
        "gain_drift": response.gain_drift,
        "offset_drift_nm": nanometres(response.offset_drift),
    }
