"""`dm report`: the report of a stored calibration as one HTML and one PDF file."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from dm_tools.output import JsonOption, console, nanometres, write_json

#: Where the node `calibration` keeps its files unless told otherwise.
DEFAULT_STORE = "~/.ros/dm_calibrations"


def find_calibration(name: str, store: Any) -> tuple[Any, Path]:
    """The calibration of that id or file, "" = the newest that can be read, and its file.

    Raises:
        ValueError: there is none, with the reason.
    """
    from dm_calibration.store.calibration_store import SUFFIX, CalibrationStore

    if name:
        path = Path(name).expanduser()
        if path.suffix == SUFFIX and path.is_file():  # a file anywhere
            store, name = CalibrationStore(path.parent), path.name
        return store.load(name), store.find(name)
    entries = store.entries()
    for entry in entries:
        if entry.calibration is not None:
            return entry.calibration, entry.file
    damaged = "; ".join(entry.remark for entry in entries)
    raise ValueError(
        f"no calibration in {store.folder}{f' can be read: {damaged}' if damaged else ''}: "
        "calibrate first (./dm calibrate), or name the folder with --store"
    )


def report(
    calibration: Annotated[
        str, typer.Argument(help="Id in the store, or a calibration file; empty = the newest.", metavar="[ID|FILE]")
    ] = "",
    out: Annotated[Path, typer.Option(help="Folder for the two files.")] = Path("runs/report"),
    store: Annotated[Path, typer.Option(help="Folder of the calibration files.")] = Path(DEFAULT_STORE),
    json: JsonOption = None,
) -> None:
    """Write the report of a calibration: what was measured with what, how good it is, and what limits it.

    Reads the stored file; needs no running nodes.
    """
    from dm_calibration.report.page import figures_of, write_report
    from dm_calibration.store.calibration_store import CalibrationStore

    started = time.monotonic()
    folder = out.resolve()
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--out {out}: is a file; name a folder, which need not exist yet")
    found, file = find_calibration(calibration, CalibrationStore(store))
    written = write_report(found, folder, file)
    console.print(
        f"calibration [bold]{found.id}[/]: residual {nanometres(found.fit.in_sample_rms):.2f} nm in-sample, "
        f"{nanometres(found.fit.held_out_rms):.2f} nm held out, {len(found.limitations)} sentences of caution"
    )
    console.print(f"page: {os.path.relpath(written.html)}\nPDF: {os.path.relpath(written.pdf)}")
    files = {"html": str(written.html), "pdf": str(written.pdf)}
    write_json(json, figures_of(found) | {"files": files, "seconds": time.monotonic() - started})
