"""`dm replay`: a recording published again, or the calibration in it made again."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from dm_bringup.suite import load_config
from dm_tools.output import JsonOption, NamespaceOption, console, figures, progress_bar, write_json


def replay(
    recording: Annotated[Path, typer.Argument(help="Folder of a recording, or its MCAP file.")],
    rate: Annotated[float, typer.Option(help="Times faster than recorded.")] = 1.0,
    topics: Annotated[str, typer.Option(help="Only these, comma separated.")] = "",
    commands: Annotated[
        bool, typer.Option("--commands", help="Publish commands and requests too: a driver that runs will obey them.")
    ] = False,
    recalibrate: Annotated[
        bool, typer.Option("--recalibrate", help="Publish nothing; make the recorded calibration again and compare.")
    ] = False,
    run: Annotated[int, typer.Option(min=0, help="Which calibration of the recording, from 1; 0 = the last.")] = 0,
    store: Annotated[
        Path | None, typer.Option(help="With --recalibrate: folder to store the calibration made again in.")
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="With --recalibrate: parameter file of the nodes, for a recording that does not hold them."),
    ] = None,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Publish the topics of a recording with their timing, or repeat its calibration, to the last bit."""
    from dm_tools.recording.bag import BagReader
    from dm_tools.recording.player import play, replayed

    if not rate > 0.0:  # before the recording is read, which takes a minute where it was not finished
        raise typer.BadParameter(f"--rate {rate:g}: must be above 0")
    bag = BagReader(recording)
    for name in bag.unfinished:
        console.print(f"[yellow]remark[/] {name} is incomplete: its complete part is read")
    if recalibrate:
        if rate != 1.0 or topics or commands:
            raise typer.BadParameter("--rate, --topics and --commands are for publishing, not for --recalibrate")
        result = _recalibrated(bag, run, namespace, store, config)
        write_json(json, result)
        if result["identical"] is False:
            raise RuntimeError("the calibration made again is not the one that was recorded")
        return
    if run or store or config:
        raise typer.BadParameter("--run, --store and --config are for --recalibrate")
    wanted = [name.strip() for name in topics.split(",") if name.strip()]
    names = replayed(list(bag.topics), wanted, commands, namespace)
    console.print(f"{bag.messages} messages of {bag.duration_s:.1f} s; publishing {', '.join(sorted(names))}")
    with progress_bar() as bar:
        task = bar.add_task("replay, s", total=round(bag.duration_s))
        counts = play(
            bag,
            names,
            rate,
            progress=lambda seconds: bar.update(task, completed=round(seconds)),
            remark=lambda text: console.print(f"[yellow]remark[/] {text}"),
        )
    count, left_out = sum(counts.values()), sorted(set(names) - counts.keys())
    console.print(f"{count} messages published")
    published = {"recording": str(bag.path), "messages": count, "topics": sorted(counts), "left_out": left_out}
    write_json(json, published)


def _recalibrated(bag: Any, run: int, namespace: str, store: Path | None, config: Path | None) -> dict[str, Any]:
    """Make the calibration again; returns its figures."""
    from dm_calibration.store.calibration_store import CalibrationStore
    from dm_tools.doctor.bench import parameters
    from dm_tools.recording.session import COMPARED, differences, read_session, recalibrate

    session = read_session(bag, run, namespace)
    if config is not None:
        given = load_config(config, namespace.strip("/")).get("calibration", {})
        if wrong := parameters({"calibration": given}):
            raise ValueError(f"{config}: {wrong.problem}")
        session.parameters.update(given)
    now, mirror = time.time_ns(), session.run.mirror
    folder = CalibrationStore(store if store is not None else Path("runs/replayed"))
    calibration = recalibrate(session, folder.new_id(mirror.name, mirror.serial, now), now)
    for remark in session.remarks:
        console.print(f"[yellow]remark[/] {remark}")
    fit = calibration.fit
    maps = int(calibration.maps.has_map.sum())
    console.print(
        f"{int(fit.used.sum())} of {maps} maps, residual {1e9 * fit.in_sample_rms:.2f} nm "
        f"in-sample, {1e9 * fit.held_out_rms:.2f} nm held out"
    )
    published = session.published
    differing = differences(calibration, published) if published is not None else None
    if differing is None:
        console.print("the recording holds no calibration to compare with: it was not activated")
    elif differing:
        console.print(f"[red]differs[/] from {published.id} in {', '.join(differing)}")
    else:
        console.print(f"the same as {published.id} to the last bit, in all {len(COMPARED)} fields compared")
    file = ""
    if store is not None:
        file = str(folder.save(calibration))
        console.print(f"stored: {file}")
    return {
        "maps": maps,
        **figures(fit, "in_sample_rms_nm", "held_out_rms_nm"),
        "compared_with": published.id if published is not None else None,
        "identical": None if differing is None else not differing,
        "file": file,
    }
