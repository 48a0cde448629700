"""Several mirrors from one `dm up`, each in a namespace of its own."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dm_bringup.suite import save_config
from dm_client import DeformableMirrorClient, DeformableMirrorError
from dm_tools.demo.demo_bench import bench_config
from dm_tools.doctor.bench import parameters
from dm_tools.verbs.up import configurations, shared_config

pytestmark = pytest.mark.processes


def test_virtual_mirrors_share_neither_ports_nor_folders() -> None:
    left, right = configurations([], ["left", "/right/"]).values()
    for node, names in {
        "virtual_bench": ("electronics.tcp_port", "electronics.udp_port", "trigger.port", "output_folder", "seed"),
        "pdm_driver": ("electronics.port", "mirror.serial"),
        "interferometer": ("watch_folder", "trigger_command"),
        "calibration": ("calibration_folder",),
    }.items():
        for name in names:
            assert left[node][name] != right[node][name], (node, name)
    for config in (left, right):
        assert config["virtual_bench"]["electronics.tcp_port"] == config["pdm_driver"]["electronics.port"]
        assert str(config["virtual_bench"]["trigger.port"]) in config["interferometer"]["trigger_command"]


def test_a_virtual_mirror_of_another_seed_is_no_mirror_that_was_calibrated() -> None:
    first, second = (configurations([], names)["left"] for names in (["left", "right"], ["right", "left"]))
    assert first["virtual_bench"]["seed"] != second["virtual_bench"]["seed"]
    assert first["pdm_driver"]["mirror.serial"] != second["pdm_driver"]["mirror.serial"]


def test_one_mirror_is_as_shipped() -> None:
    assert list(configurations([], [""]).values()) == list(configurations([], ["a"]).values())


def test_a_camera_comes_with_an_autofocus_that_knows_its_optics(tmp_path: Path) -> None:
    (config,) = configurations([], [""], camera=True).values()
    assert parameters(config) is None
    assert config["virtual_bench"]["camera.rate"] > 0
    assert config["virtual_bench"]["camera.rest_distance"] == config["autofocus"]["optics.rest_distance"]
    with pytest.raises(ValueError, match="--camera is for the shipped virtual bench only"):
        configurations([tmp_path / "config.yaml"], [""], camera=True)


@pytest.mark.parametrize(
    ("files", "names", "words"), [(1, ["a", "b"], "1 files for 2"), (0, ["a", "/a"], "one of its own")]
)
def test_what_does_not_fit_is_refused(tmp_path: Path, files: int, names: list[str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        configurations([tmp_path / "config.yaml"] * files, names)


@pytest.mark.parametrize(
    ("node", "values", "words"),
    [
        ("calibration", {"calibration_folder": "/data"}, "mirror.serial, calibration_folder = A, /data"),
        ("pdm_driver", {"electronics.address": "10.0.0.7"}, "electronics.address = 10.0.0.7:12340"),
        (
            "pdm_driver",
            {"electronics.kind": "usb_dac40", "electronics.serial_port": "/dev/ttyUSB0"},
            "electronics.serial_port = /dev/ttyUSB0",
        ),
        ("interferometer", {"watch_folder": "/data/maps"}, "watch_folder = /data/maps"),
        ("virtual_bench", {"trigger.port": 4321}, "TCP port of virtual_bench = 4321"),
    ],
)
def test_mirrors_do_not_share_what_each_needs(
    tmp_path: Path, node: str, values: dict[str, str | int], words: str
) -> None:
    mirrors = configurations([], ["left", "right"])
    for config in mirrors.values():
        config["pdm_driver"]["mirror.serial"] = "A"  # two of one serial can be told apart by their folders
    files = [tmp_path / f"{name}.yaml" for name in mirrors]
    for file, config in zip(files, mirrors.values(), strict=True):
        save_config(config, file)
    assert configurations(files, ["left", "right"]) == mirrors
    for file, config in zip(files, mirrors.values(), strict=True):
        config[node] |= values
        if "electronics.address" in values:
            config[node]["electronics.port"] = 12340
        save_config(config, file)
    with pytest.raises(ValueError, match=f"^{words} in the parameter files of left and right: each mirror needs one"):
        configurations(files, ["left", "right"])


def test_a_template_that_nobody_has_filled_in_is_refused() -> None:
    with pytest.raises(ValueError, match=r"hardware\.yaml: still CHANGE: pdm_driver\.mirror\.serial, .*watch_folder"):
        configurations([shared_config("hardware.yaml")], [""])


def test_a_second_bench_on_the_same_ports_is_refused(tmp_path: Path, domain: int) -> None:
    config = bench_config(tmp_path, "off", 0.0, 1, 0.0)
    port = config["virtual_bench"]["electronics.tcp_port"]
    save_config(config, tmp_path / "config.yaml")
    command = [sys.executable, "-m", "dm_tools", "up", "--config", str(tmp_path / "config.yaml")]
    environment = os.environ | {"ROS_HOME": str(tmp_path), "ROS_DOMAIN_ID": str(domain)}
    with socket.create_server(("127.0.0.1", port)):
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 1 and "starting" not in done.stdout, done.stdout + done.stderr
    assert f"electronics.tcp_port = {port}: Address already in use" in done.stderr
    assert "stop the ./dm up that is running" in done.stderr


def test_two_mirrors_move_apart(tmp_path: Path, domain: int) -> None:
    arguments: list[str] = []
    for name in ("left", "right"):
        save_config(bench_config(tmp_path / name, "preisach", 0.01, 1, 0.0), tmp_path / f"{name}.yaml")
        arguments += ["--config", str(tmp_path / f"{name}.yaml"), "--namespace", name]
    process = subprocess.Popen(
        [sys.executable, "-m", "dm_tools", "up", *arguments, "--logs", str(tmp_path / "logs")],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stdout=subprocess.DEVNULL,
    )
    try:
        with (
            DeformableMirrorClient("left", domain, 60.0) as left,
            DeformableMirrorClient("right", domain, 60.0) as right,
        ):
            left.wait_until_active(60.0)
            right.wait_until_active(60.0)
            before = np.array(right.latest("actuator_state").applied)
            left.set_signals([0.3] * 37)
            assert left.wait(lambda: np.allclose(left.latest("actuator_state").applied, 0.3, atol=1e-3), 20.0)
            np.testing.assert_array_equal(right.latest("actuator_state").applied, before)
            for name, client in (("left", left), ("right", right)):
                with pytest.raises(DeformableMirrorError, match="calibrat") as refused:
                    client.focus(0.01)
                headers = client.latest("capabilities").header, refused.value.response.state.header
                assert {header.frame_id for header in headers} == {f"{name}/mirror"}
    finally:
        process.send_signal(signal.SIGTERM)  # as systemd stops a service
        assert process.wait(40.0) == 0
