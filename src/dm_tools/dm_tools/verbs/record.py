"""`dm record`: the topics of a session in an MCAP file that `ros2 bag` and Foxglove read."""

import os
import shutil
import signal
import time
from pathlib import Path
from typing import Annotated

import typer

from dm_tools.output import JsonOption, NamespaceOption, NotRunningError, console, write_json

#: Period at which the count on the screen is updated, s.
SHOWN_EVERY_S = 0.5


def record(
    out: Annotated[
        Path | None, typer.Option(help="Folder of the recording; must not exist yet. Default: runs/recording-TIME.")
    ] = None,
    topics: Annotated[str, typer.Option(help="Only these, comma separated; empty = all of the suite.")] = "",
    maps: Annotated[bool, typer.Option(help="Record the maps themselves too, megabytes each.")] = True,
    duration: Annotated[float, typer.Option(min=0.0, help="Seconds to record; 0 = until Ctrl-C.")] = 0.0,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Record the running suite until Ctrl-C; start it before a calibration that is to be repeated from it.

    Writes a folder with one MCAP file and metadata.yaml, as `ros2 bag record -s mcap` does.
    """
    from dm_tools.recording.bag import PARAMETER_EVENTS
    from dm_tools.recording.recorder import COMMON, Recorder

    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells start background commands with SIGINT ignored
    folder = out if out is not None else Path("runs") / time.strftime("recording-%Y%m%dT%H%M%S")
    names = [name.strip() for name in topics.split(",") if name.strip()]
    started = time.monotonic()
    with Recorder(folder, namespace, names, maps) as recorder:
        try:
            console.print(f"recording into {folder}; Ctrl-C ends it")
            with console.status("") as status:
                while not duration or time.monotonic() - started < duration:
                    recorder.check()
                    counts = recorder.counts
                    status.update(f"{sum(counts.values())} messages on {len(counts)} topics")
                    time.sleep(min(SHOWN_EVERY_S, duration or SHOWN_EVERY_S))
        except KeyboardInterrupt:
            console.print("\nstopping")
    counts = recorder.counts
    for name, count in sorted(counts.items()):
        console.print(f"{count:8d}  {name}")
    for name, reason in recorder.refused.items():
        console.print(f"[yellow]not recorded[/] {name}: {reason}")
    for name in recorder.unseen:
        console.print(f"[yellow]not recorded[/] {name}: nobody published it")
    console.print(f"{sum(counts.values())} messages, recording: {os.path.relpath(folder)}")
    of_others = (PARAMETER_EVENTS,) if names else COMMON  # shared topics are recorded in an unused namespace too
    if not any(count for name, count in counts.items() if name not in of_others):
        shutil.rmtree(folder)
        if names and counts.get(PARAMETER_EVENTS):  # nodes of the suite have answered
            raise RuntimeError("nothing was recorded: no topic in --topics is published")
        raise NotRunningError(
            "nothing was recorded: are the nodes running (./dm up), in this ROS_DOMAIN_ID and namespace?"
        )
    seconds = time.monotonic() - started
    write_json(json, {"folder": str(folder), "messages": counts, "refused": recorder.refused, "seconds": seconds})
