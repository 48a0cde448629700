"""`dm instrument`: find from files what the interferometer itself adds to every map."""

import csv
import math
from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from dm_common.atomic_write import write_whole
from dm_common.optics.zernike import MAX_ORDER
from dm_tools.output import JsonOption, console, next_step, output_file, write_json
from dm_tools.parameter_changes import keep_before

#: Columns of tables that hold no numbers.
_TEXTS = ("file", "reference", "part")
#: Key of the values of a row that have no heading.
_SURPLUS = "..."


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
            "retrace: the errors that grow with tilt, from maps of one shape under different tilts. grid: lateral "
            "scale and distortion, from a table of marks (column, row, x, y; m) and a map with the same zoom."
        ),
    ],
    files: Annotated[list[Path], typer.Argument(help="Tables (CSV with these headings), map files.")],
    write: Annotated[
        Path | None, typer.Option(metavar="FILE.fits", help="Where the reference surface goes.", callback=output_file)
    ] = None,
    xyz_unit: Annotated[str, typer.Option(help="Unit of .xyz files, and of FITS files without one.")] = "",
    json: JsonOption = None,
) -> None:
    """Find the errors of the interferometer itself from files, as parameters to paste. Needs no nodes."""
    from dm_calibration.influence.poke_cure import parameter_text
    from dm_calibration.map_files import read_map
    from dm_calibration.optics.aperture import MapRejectedError
    from dm_calibration.optics.phase_steps import mend_phase_steps

    def read(path: Path) -> Any:
        surface = read_map(path, xyz_unit=xyz_unit or None)
        if not surface.wavelength:  # it is not in the file
            return surface
        try:
            return replace(surface, sag=mend_phase_steps(surface.sag, 0.5 * surface.wavelength)[0])
        except MapRejectedError as error:
            raise MapRejectedError(f"{path}: {error}") from error

    if (write is not None) != (procedure is Procedure.FLATS):
        raise typer.BadParameter("--write FILE.fits: required for flats; the others write no file")
    wanted = {Procedure.FLATS: (1, "one table of maps"), Procedure.GRID: (2, "the table of marks and one map")}
    if procedure in wanted and len(files) != wanted[procedure][0]:
        raise typer.BadParameter(f"{len(files)} files: must be {wanted[procedure][1]}")
    if write is not None:
        found = _flats(files[0], write, read)
    elif procedure is Procedure.RETRACE:
        found = _retrace([read(file).sag for file in files])
    else:
        found = _grid(files[0], read(files[1]))
    console.print(parameter_text({"interferometer": found}), markup=False)
    write_json(json, {"instrument": found})
    next_step("put the parameters into the parameter file; `instrument_error` is the bound on what is left")


def _flats(table: Path, target: Path, read: Callable[[Path], Any]) -> dict[str, Any]:
    """Write the error of the flat that is the first reference in `table`."""
    from dm_calibration.map_files.fits import fits_bytes
    from dm_calibration.map_files.surface_map import SAME_LENGTH
    from dm_calibration.optics.flats import FlatTest, reference_from_flats

    rows = _table(table, "file", "reference", "part", "degrees")
    sources = [table.parent / row[0] for row in rows]
    if target.resolve() in [source.resolve() for source in (table, *sources)]:
        raise ValueError(f"--write {target}: is one of the files to read; give another")
    surfaces = [read(source) for source in sources]
    tolerance = SAME_LENGTH * surfaces[0].wavelength
    for source, surface in zip(sources, surfaces, strict=True):
        if different := surface.difference(surfaces[0], 0.0, tolerance, str(sources[0])):
            raise ValueError(f"{source}: {different}")
    tests = [
        FlatTest(surface.sag, reference, part, math.radians(float(degrees)))
        for surface, (_, reference, part, degrees) in zip(surfaces, rows, strict=True)
    ]
    found = reference_from_flats(tests)
    keep_before(target)
    write_whole(target, fits_bytes(replace(surfaces[0], sag=found.sag), "dm instrument flats"))
    console.print(
        f"{target}: the flat {tests[0].reference}, from {len(tests)} maps, which disagree by "
        f"{1e9 * found.left:.2f} nm rms"
    )
    if found.open_orders:
        orders = ", ".join(map(str, found.open_orders))
        console.print(
            f"not determined by these maps, and left out: angular orders {orders} (0 = rotationally symmetric); "
            "exchange the flats, or turn one by an angle that is no simple fraction of a turn"
        )
    # The bound is on coefficients up to this angular order, to which higher orders contribute nothing.
    known = not any(order <= MAX_ORDER for order in found.open_orders) and math.isfinite(found.bound)
    return {"reference_surface": str(target.absolute())} | ({"instrument_error": found.bound} if known else {})


def _retrace(maps: list[Any]) -> dict[str, Any]:
    from dm_calibration.optics.instrument import find_retrace

    found, before, left = find_retrace(maps)
    console.print(
        f"coefficients differ by up to {1e9 * before:.2f} nm between these maps, by {1e9 * left:.2f} nm "
        "without the retrace error"
    )
    return {"retrace": [round(float(value), 9) for value in found]}


def _grid(table: Path, surface: Any) -> dict[str, Any]:
    from dm_calibration.acquisition.ingest import ZOOM_SHARE
    from dm_calibration.map_files.surface_map import PITCH_MAX, PITCH_MIN
    from dm_calibration.optics.instrument import lateral_scale

    marks = [[float(value) for value in row] for row in _table(table, "column", "row", "x", "y")]
    found = lateral_scale(marks, surface.sag.shape)
    if not PITCH_MIN <= found.pitch <= PITCH_MAX:
        raise ValueError(f"{table}: the marks give {found.pitch:g} m per pixel: x and y must be in m")
    if surface.pitch and abs(surface.pitch - found.pitch) > ZOOM_SHARE * found.pitch:  # the node would refuse every map
        raise ValueError(
            f"{table}: the marks give {found.pitch * 1e6:.3f} um per pixel, the map states {surface.pitch * 1e6:.3f}: "
            "x and y must be in m, and the zoom the same"
        )
    console.print(
        f"distortion {found.distortion:+.3%} +- {found.distortion_error:.3%} at the edge; the marks deviate from it "
        f"by {found.left * 1e6:.2f} um rms"
    )
    return {
        "pitch": round(found.pitch, 12),
        "distortion": round(found.distortion, 7),
        "scale_error": round(found.scale_error, 7),
    }


def _table(path: Path, *names: str) -> list[list[str]]:
    """The rows of a CSV file with these headings, in any order; a missing column `degrees` means 0.

    Raises:
        ValueError: naming the file, and the row that lacks a value or holds something other than a number.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # spreadsheets put a mark before the first heading
            rows = [
                {(name or "").strip(): value for name, value in row.items()}
                for row in csv.DictReader(file, restval="", restkey=_SURPLUS, skipinitialspace=True)
            ]
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: must be a table, CSV in UTF-8: {error}") from error
    missing = [name for name in names if name != "degrees" and (not rows or name not in rows[0])]
    if missing:
        raise ValueError(f"{path}: has no column {', '.join(missing)}; the first line must name {', '.join(names)}")
    default = {"degrees": "0"}
    table = [[row.get(name, "").strip() or default.get(name, "") for name in names] for row in rows]
    for number, values in enumerate(table, start=1):
        if any(value.strip() for value in rows[number - 1].get(_SURPLUS, ())):
            raise ValueError(
                f"{path}: row {number} below the headings has more values than headings: numbers have a point, no comma"
            )
        if "" in values:
            raise ValueError(f"{path}: row {number} below the headings has no {names[values.index('')]}")
        for name, value in zip(names, values, strict=True):
            if name not in _TEXTS and not _is_number(value):
                raise ValueError(f"{path}: row {number} below the headings: {name} = {value!r}: must be a number")
    return table


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
