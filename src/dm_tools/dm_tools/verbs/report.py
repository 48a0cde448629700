"""`dm report`: the report of a stored calibration as one HTML and one PDF file."""

import math
import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from dm_tools.output import JsonOption, NamespaceOption, console, next_step, write_json
from dm_tools.parameter_changes import get_parameter
from dm_tools.running_suite import BUSY_S, FIND_S, latest_message, nodes_of_suite

#: Folder of the shipped virtual bench, and the default store of the node `calibration`.
VIRTUAL, HARDWARE = Path("~/.ros/dm_bench"), Path("~/.ros/dm_calibrations")


def running_calibration(namespace: str) -> tuple[Path | None, dict[str, Any], str]:
    """Calibration file of the running suite, the parameters by which it judges a report, and its mirror's serial.

    The file is None when there is none or the suite runs elsewhere; parameters are the defaults when nothing runs.
    """
    from dm_calibration.calibration_parameters import CRITERIA
    from dm_client import DeformableMirrorClient, DeformableMirrorError

    with DeformableMirrorClient(namespace) as client:
        runs = client.wait(lambda: nodes_of_suite(client), FIND_S)
        if not runs or (message := latest_message(client, "calibration", BUSY_S)) is None:
            return None, CRITERIA, ""
        values = CRITERIA
        with suppress(DeformableMirrorError):  # it may not be allowed to read them (docs/security.md)
            values = {name: get_parameter(client, "calibration", name) for name in CRITERIA}
        file = Path(message.file)
        return file if message.file and file.is_file() else None, values, message.mirror_serial


def folder_with(name: str, folders: Sequence[Path]) -> Path:
    """The first folder with a calibration of that id, else that of the youngest file, else the first."""

    def rank(folder: Path) -> float:
        files = {file.stem: file.stat().st_mtime for file in folder.expanduser().glob("*.h5")}
        return math.inf if name.removesuffix(".h5") in files else max(files.values(), default=0.0)

    return max(folders, key=rank)


def find_calibration(name: str, store: Any) -> tuple[Any, Path]:
    """The calibration of that id or file, "" = the newest that can be read, and its file.

    Raises ValueError with the reason when there is none.
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
        str,
        typer.Argument(
            help="Id in the store, or a calibration file; empty = the one in use, else the newest.",
            metavar="[ID|FILE]",
        ),
    ] = "",
    out: Annotated[Path, typer.Option(help="Folder for the two files.")] = Path("runs/report"),
    store: Annotated[Path | None, typer.Option(help="Folder of the calibration files; none = the usual ones.")] = None,
    operator: Annotated[
        str, typer.Option(help="Who is responsible for the calibration; for the first page, kept for later.")
    ] = "",
    instrument: Annotated[str, typer.Option(help="The measuring instrument; for the first page, kept for later.")] = "",
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Write the report of a calibration: what was measured with what, how good it is, and what limits it.

    Reads the stored file; needs no running nodes, but uses the parameters of those that run for that mirror.
    """
    from dm_calibration.calibration_parameters import CRITERIA
    from dm_calibration.report.certificate import keep_people, people
    from dm_calibration.report.page import figures_of, write_report
    from dm_calibration.store.calibration_store import CalibrationStore

    started = time.monotonic()
    folder = out.resolve()
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--out {out}: is a file; name a folder, which need not exist yet")
    file_in_use, values, serial = running_calibration(namespace)
    if store is None:
        calibration = calibration or str(file_in_use or "")
        # A mirror of several on the virtual bench has a folder of its own (`virtual_mirror` in verbs/up.py).
        usual = [VIRTUAL / namespace.strip("/") / "calibrations", HARDWARE]
        store = folder_with(calibration, usual if file_in_use is None else [file_in_use.parent, *usual])
        if not (calibration or any(store.expanduser().glob("*.h5"))):
            folders = " or ".join(map(str, usual))
            raise ValueError(f"no calibration in {folders}: calibrate first (./dm calibrate), or name its --store")
    found, file = find_calibration(calibration, CalibrationStore(store))
    if found.mirror_serial != serial:
        values = CRITERIA  # the parameters of the running suite are another mirror's
    names = {name: value for name, value in (("operator", operator), ("instrument", instrument)) if value}
    if console.is_terminal and sys.stdin.isatty():
        for name in sorted({"operator", "instrument"} - people().keys() - names.keys()):
            names[name] = typer.prompt(f"{name}, for the first page (Enter = none)", default="", show_default=False)
    keep_people(names)
    page, pdf = write_report(found, folder, file, values)
    console.print(
        f"calibration [bold]{found.id}[/]: residual {1e9 * found.fit.held_out_rms:.2f} nm rms on maps held out, "
        f"{len(found.limitations)} known limitations"
    )
    console.print(f"page: {os.path.relpath(page)}\nPDF: {os.path.relpath(pdf)}")
    files = {"html": str(page), "pdf": str(pdf)}
    write_json(json, figures_of(found) | {"files": files, "seconds": time.monotonic() - started})
    next_step(f"open {os.path.relpath(pdf)}")
