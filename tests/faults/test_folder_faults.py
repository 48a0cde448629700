"""The watched folder when things go wrong there: the real node, real files."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dm_msgs.msg import ErrorCode, ZernikeCoefficients
from dm_msgs.srv import IngestFile, Measure

from dm_calibration.acquisition.folder_watch import FolderWatch
from dm_common.ros import qos
from map_fixtures import dat_bytes, disc_counts
from support import NodeProcess, Observer, wait_until

Start = Callable[..., NodeProcess]
PITCH = 24e-6


def watched(start: Start, observer: Observer, folder: Path, **parameters: Any) -> tuple[NodeProcess, list[Any]]:
    """The node, watching `folder`, and the coefficients it publishes."""
    folder.mkdir(exist_ok=True)
    taken = observer.record(ZernikeCoefficients, "zernike", qos.STATE)
    values = {"watch_folder": str(folder), "stable_time": 0.2, "publish_map": False, **parameters}
    node = start("dm_calibration", "interferometer", values)
    wait_until(lambda: "active; maps from" in node.output, 60, "activation")
    # Maps come within milliseconds; what is published before the node has discovered this subscription is lost.
    known = folder.parent / "known.dat"
    known.write_bytes(map_bytes(0))

    def comes() -> bool:
        observer.call(IngestFile, "ingest_file", IngestFile.Request(path=str(known)))
        time.sleep(0.2)
        return bool(taken)

    wait_until(comes, 60, "a first map")
    taken.clear()
    return node, taken


def map_bytes(number: int) -> bytes:
    """A small map that differs from those of other numbers."""
    return dat_bytes(disc_counts(40, amplitude=1000 + number), pitch=PITCH)


def test_many_files_at_once_are_each_taken_once(observer: Observer, start: Start, tmp_path: Path) -> None:
    folder, store = tmp_path / "maps", tmp_path / "store"
    store.mkdir()
    node, _taken = watched(start, observer, folder)
    count = 400
    for number in range(count):
        (store / f"{number:04d}.dat").write_bytes(map_bytes(number))
    for path in store.iterdir():
        path.rename(folder / path.name)
    wait_until(lambda: node.output.count("new file: ") >= count, 120, "all files")
    time.sleep(1.0)
    lines = [line for line in node.output.splitlines() if "new file: " in line]
    assert sorted(line.split("new file: ")[1].split(":")[0] for line in lines) == sorted(map(str, folder.iterdir()))


def test_a_file_that_grows_is_renamed_and_copied_counts_by_its_content(
    observer: Observer, start: Start, tmp_path: Path
) -> None:
    folder = tmp_path / "maps"
    node, taken = watched(start, observer, folder)
    content = map_bytes(1)
    with (folder / "growing.dat.part").open("wb") as file:  # not a name that is watched
        for begin in range(0, len(content), 1000):
            file.write(content[begin : begin + 1000])
            file.flush()
            time.sleep(0.02)
    assert taken == []
    (folder / "growing.dat.part").rename(folder / "grown.dat")
    wait_until(lambda: len(taken) == 1, 60, "the map")
    (folder / "grown.dat").write_bytes(content)  # saved over itself: nothing new
    time.sleep(1.0)
    assert len(taken) == 1
    (folder / "grown.dat").write_bytes(map_bytes(2))
    wait_until(lambda: len(taken) == 2, 60, "the replaced map")
    assert "Traceback" not in node.output


def test_locked_files_links_out_and_pipes_are_told_and_the_next_map_is_taken(
    observer: Observer, start: Start, tmp_path: Path
) -> None:
    folder = tmp_path / "maps"
    node, taken = watched(start, observer, folder)
    (tmp_path / "secret.dat").write_bytes(map_bytes(1))
    (folder / "out.dat").symlink_to(tmp_path / "secret.dat")
    os.mkfifo(folder / "pipe.dat")
    (folder / "folder.dat").mkdir()
    locked = folder / "locked.dat"
    locked.write_bytes(map_bytes(2))
    locked.chmod(0)
    wait_until(
        lambda: all(f"{name}.dat: " in node.output for name in ("out", "pipe", "folder")), 20, "the three warnings"
    )
    assert "leads out of the watched folder" in node.output
    (folder / "good.dat").write_bytes(map_bytes(3))
    wait_until(lambda: f"new file: {folder / 'good.dat'}" in node.output, 60, "the good map")
    if os.geteuid() != 0:  # nothing is locked for root
        assert "locked.dat: Permission denied" in node.output
        locked.chmod(0o600)
        os.utime(locked)
        wait_until(lambda: f"new file: {locked}" in node.output, 60, "the unlocked map")
    assert not any("secret" in line for line in node.output.splitlines() if "new file" in line)
    assert taken


def test_a_trigger_that_hangs_blocks_no_map_from_the_folder(observer: Observer, start: Start, tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    command = [sys.executable, "-S", "-c", "import time; time.sleep(600)", "{path}"]
    _node, taken = watched(start, observer, folder, trigger_command=command, trigger_timeout=3.0)
    client = observer.node.create_client(Measure, "measure")
    wait_until(client.service_is_ready, 60, "service measure")
    future = client.call_async(Measure.Request())
    (folder / "by_hand.dat").write_bytes(map_bytes(1))
    wait_until(lambda: len(taken) == 1, 60, "the map taken by hand")
    wait_until(future.done, 60, "the answer")
    assert future.result().error_code == ErrorCode.TRIGGER_FAILED
    assert "did not end within 3 s" in future.result().message


def test_a_name_that_changes_between_two_files_is_never_taken_half(tmp_path: Path) -> None:
    """A file exchanged for another at every look is never still, and is not reported."""
    watch = FolderWatch(tmp_path, ["*.dat"], 1.0)
    watch.poll(0.0)
    for look in range(1, 20):
        (tmp_path / "new").write_bytes(bytes(look))
        (tmp_path / "new").replace(tmp_path / "a.dat")
        assert watch.poll(0.6 * look) == []
    assert [sighting.path.name for sighting in watch.poll(20.0)] == ["a.dat"]
