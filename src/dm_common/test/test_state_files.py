"""Where nodes keep their state."""

from pathlib import Path

import pytest

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
    assert state_file("/srv", ".creep.npz", "PDM 30/1") == Path("/srv/PDM-30-1.creep.npz")
    assert state_file("/srv", ".creep.npz", "..") == Path("/srv/mirror.creep.npz")


def test_no_folder_is_no_file() -> None:
    assert state_file("", ".shape", "a") is None
