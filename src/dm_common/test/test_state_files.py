"""Where nodes keep their state."""

import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from dm_common.atomic_write import write_whole
from dm_common.state_files import ros_home, state_file


def test_ros_home_takes_the_place_of_the_usual_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_HOME", raising=False)
    assert ros_home() == Path.home() / ".ros"
    assert state_file("~/.ros/dm_driver", ".shape", "a") == Path.home() / ".ros/dm_driver/a.shape"
    monkeypatch.setenv("ROS_HOME", "/var/ros")
    assert ros_home() == Path("/var/ros")
    assert state_file("~/.ros/dm_driver", ".shape", "a") == Path("/var/ros/dm_driver/a.shape")
    assert state_file("~/.ros_bench", ".shape", "a") == Path.home() / ".ros_bench/a.shape"


def test_names_cannot_lead_out_of_the_folder() -> None:
    path = state_file("/srv", ".shape", "usb_dac40", "../../etc/tty", "..", "S 7/é")
    assert path is not None and path.parent == Path("/srv")
    for names, stem in (
        (("PDM 30/1",), "PDM-30-1"),
        (("..",), "mirror"),
        (("usb_dac40", "/dev/tty"), "usb_dac40_dev-tty"),
    ):
        path = state_file("/srv", ".creep.npz", *names)
        assert path is not None and path.match(f"/srv/{stem}-????????.creep.npz")


def test_names_that_look_alike_as_files_are_told_apart() -> None:
    names = ("A-1", "A/1", "A 1", "Ä", "Ж", "", "a_b")
    assert len({state_file("/srv", ".creep.npz", name) for name in names}) == len(names)
    assert state_file("/srv", ".creep.npz", "A-1") == Path("/srv/A-1.creep.npz")


def test_no_folder_is_no_file() -> None:
    assert state_file("", ".shape", "a") is None


def test_a_link_to_a_file_stays_and_the_file_is_replaced(tmp_path: Path) -> None:
    file, link = tmp_path / "share" / "figures.json", tmp_path / "figures.json"
    link.symlink_to(file)
    for content in (b"first", b"second"):
        write_whole(link, content)
        assert link.is_symlink() and file.read_bytes() == content
        file.chmod(0o660)
    assert sorted(tmp_path.rglob("*")) == [link, file.parent, file]
    write_whole(file, b"third")
    assert stat.S_IMODE(file.stat().st_mode) == 0o660


def test_what_two_write_at_once_is_whole_at_any_moment(tmp_path: Path) -> None:
    file, contents = tmp_path / "figures.json", (b"a" * 100_000, b"b" * 100_000)
    write_whole(file, contents[0])
    with ThreadPoolExecutor(2) as writers:
        written = [writers.submit(write_whole, file, content) for content in 25 * contents]
        while not all(each.done() for each in written):
            assert file.read_bytes() in contents
    assert not any(each.exception() for each in written) and list(tmp_path.iterdir()) == [file]


def test_a_pipe_is_written_to_and_not_replaced_by_a_file(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_whole(pipe, b"figures")
    assert pipe.is_fifo() and os.read(reader, 100) == b"figures"
    os.close(reader)


def test_what_others_have_open_is_written_to(tmp_path: Path) -> None:
    """As /dev/stdout is, where it leads to a file: what was printed before stays."""
    with (tmp_path / "log").open("wb", buffering=0) as log:
        log.write(b"printed\n")
        write_whole(Path(f"/dev/fd/{log.fileno()}"), b"figures\n")
    assert (tmp_path / "log").read_bytes() == b"printed\nfigures\n"
