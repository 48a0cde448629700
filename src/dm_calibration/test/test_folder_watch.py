"""Which files of a watched folder are taken, and when; time is given, so the machine's speed does not matter."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import pytest

from dm_calibration.acquisition.folder_watch import FolderWatch
from dm_calibration.acquisition.inotify import ClosedFiles
from map_fixtures import dat_bytes, disc_counts

STABLE = 1.0
WHOLE = dat_bytes(disc_counts(20), pitch=1e-5)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "maps"
    path.mkdir()
    return path


def names(watch: FolderWatch, now: float) -> list[str]:
    return [event.path.name for event in watch.poll(now) if not event.refused]


def test_existing_files_are_not_new_until_written_again(folder: Path) -> None:
    (folder / "old.dat").write_bytes(b"1")
    watch = FolderWatch(folder, ["*.dat"], STABLE)
    assert names(watch, 0) == names(watch, 10) == []
    (folder / "old.dat").write_bytes(b"22")
    assert names(watch, 11) == []
    assert names(watch, 12.5) == ["old.dat"]


def test_file_is_taken_once_when_it_has_stood_still(folder: Path) -> None:
    watch = FolderWatch(folder, ["*.dat"], STABLE)
    watch.poll(0)
    (folder / "new.dat").write_bytes(b"1")
    assert names(watch, 1) == []
    with (folder / "new.dat").open("ab") as file:
        file.write(b"2")
    assert names(watch, 2.5) == []  # it grew in between
    assert names(watch, 3.4) == []
    assert names(watch, 3.6) == ["new.dat"]
    assert names(watch, 9) == []


def test_same_size_but_another_time_is_not_still(folder: Path) -> None:
    watch = FolderWatch(folder, ["*.dat"], STABLE)
    watch.poll(0)
    (folder / "new.dat").write_bytes(b"1")
    watch.poll(1)
    os.utime(folder / "new.dat", ns=(0, 10**18))
    assert names(watch, 2.5) == []
    assert names(watch, 4) == ["new.dat"]


def test_oldest_first_and_only_matching_names(folder: Path) -> None:
    watch = FolderWatch(folder, ["*.dat", "*.DATX"], STABLE)
    watch.poll(0)
    for number, name in enumerate(["b.dat", "A.DAT", "c.datx", "notes.txt", ".hidden.dat", "d.dat.part"]):
        (folder / name).write_bytes(b"1")
        os.utime(folder / name, ns=(0, 10**18 - number * 10**9))
    watch.poll(1)
    assert names(watch, 3) == ["c.datx", "A.DAT", "b.dat"]


def test_replaced_file_is_new(folder: Path) -> None:
    watch = FolderWatch(folder, ["*.dat"], STABLE)
    watch.poll(0)
    (folder / "a.dat").write_bytes(b"1")
    watch.poll(1)
    assert names(watch, 3) == ["a.dat"]
    (folder / "b.tmp").write_bytes(b"2")
    (folder / "b.tmp").replace(folder / "a.dat")
    watch.poll(4)
    assert names(watch, 6) == ["a.dat"]


def test_what_leads_elsewhere_or_is_no_file_is_refused_once(folder: Path, tmp_path: Path) -> None:
    watch = FolderWatch(folder, ["*.dat"], STABLE)
    watch.poll(0)
    (tmp_path / "secret.dat").write_bytes(b"1")
    (folder / "out.dat").symlink_to(tmp_path / "secret.dat")
    (folder / "nowhere.dat").symlink_to(tmp_path / "absent.dat")
    os.mkfifo(folder / "pipe.dat")
    (folder / "folder.dat").mkdir()
    (folder / "real.dat").write_bytes(b"1")
    (folder / "alias.dat").symlink_to("real.dat")
    watch.poll(1)
    found = {event.path.name: event.refused for event in watch.poll(3)}
    assert found.pop("real.dat") == ""
    assert "out of the watched folder" in found.pop("out.dat")
    assert "not a regular file" in found.pop("pipe.dat")
    assert "not a regular file" in found.pop("folder.dat")
    assert "under its own name" in found.pop("alias.dat")
    assert found == {}
    assert watch.poll(9) == []


def test_ignored_file_is_never_reported(folder: Path) -> None:
    watch = FolderWatch(folder, ["*.dat"], STABLE)
    watch.poll(0)
    watch.ignore(folder / "mine.dat")
    (folder / "mine.dat").write_bytes(b"1")
    watch.poll(1)
    assert watch.poll(3) == []


def test_folder_that_vanishes_and_returns_loses_nothing(folder: Path) -> None:
    watch = FolderWatch(folder, ["*.dat"], STABLE)
    (folder / "old.dat").write_bytes(b"1")
    watch.poll(0)
    folder.rename(folder.with_name("away"))
    with pytest.raises(FileNotFoundError):
        watch.poll(1)
    folder.with_name("away").rename(folder)
    (folder / "new.dat").write_bytes(b"1")
    watch.poll(2)
    assert names(watch, 4) == ["new.dat"]


@pytest.mark.skipif(not os.access("/dev/shm", os.W_OK), reason="there is no second disk")
def test_a_disk_that_is_mounted_later_or_again_brings_no_new_files(folder: Path) -> None:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as disk:
        (Path(disk) / "old.dat").write_bytes(b"1")
        place = folder.with_name("mount")

        def mount(what: str | Path) -> None:
            place.unlink(missing_ok=True)
            place.symlink_to(what)

        mount(folder)
        watch = FolderWatch(place, ["*.dat"], STABLE)
        assert watch.poll(0) == []
        for now in (10, 20):
            mount(disk)
            assert names(watch, now) == names(watch, now + 2) == []
            mount(folder)  # it is lost again
            assert watch.poll(now + 4) == []
        mount(disk)
        (Path(disk) / "written_meanwhile.dat").write_bytes(b"1")
        watch.poll(30)
        assert names(watch, 32) == ["written_meanwhile.dat"]


def test_closed_file_of_the_length_it_tells_is_taken_at_once(folder: Path) -> None:
    watch = FolderWatch(folder, ["*.dat"], STABLE)
    watch.poll(0)
    (folder / "whole.dat").write_bytes(WHOLE)
    (folder / "half.dat").write_bytes(WHOLE[:-1])
    (folder / "other.txt").write_bytes(WHOLE)
    taken = watch.closed(["whole.dat", "half.dat", "other.txt", "gone.dat"], 1)
    assert [event.path.name for event in taken] == ["whole.dat"]
    assert watch.closed(["whole.dat"], 1.1) == []  # closed again, nothing new
    assert names(watch, 3) == ["half.dat"]  # still as it was: it will not become longer


def test_closed_file_before_the_first_look_is_not_new(folder: Path) -> None:
    watch = FolderWatch(folder, ["*.dat"], STABLE)
    (folder / "old.dat").write_bytes(WHOLE)
    assert watch.closed(["old.dat"], 0) == []


def test_closed_link_that_leads_out_is_left_to_be_refused(folder: Path, tmp_path: Path) -> None:
    watch = FolderWatch(folder, ["*.dat"], STABLE)
    watch.poll(0)
    (tmp_path / "outside.dat").write_bytes(WHOLE)
    (folder / "link.dat").symlink_to(tmp_path / "outside.dat")
    assert watch.closed(["link.dat"], 1) == []
    assert [bool(event.refused) for event in watch.poll(3)] == [True]


def test_the_kernel_tells_of_closed_and_moved_files(folder: Path, tmp_path: Path) -> None:
    closed = ClosedFiles(folder)
    try:
        assert closed.wait(0) == []
        (folder / "a.dat").write_bytes(b"1")
        assert "a.dat" in closed.wait(5)
        (tmp_path / "b.dat").write_bytes(b"1")
        (tmp_path / "b.dat").rename(folder / "b.dat")
        assert "b.dat" in closed.wait(5)
        with (folder / "open.dat").open("wb") as file:
            file.write(b"1")
            file.flush()
            assert closed.wait(0.05) == []
    finally:
        closed.close()


def test_a_folder_that_comes_later_is_watched_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dm_calibration.acquisition.inotify.RETRY_S", 0.01)
    closed = ClosedFiles(tmp_path / "later")
    try:
        assert closed.wait(0) == []
        (tmp_path / "later").mkdir()
        time.sleep(0.02)
        assert closed.wait(0) == []
        (tmp_path / "later" / "a.dat").write_bytes(b"1")
        assert "a.dat" in closed.wait(5)
    finally:
        closed.close()
