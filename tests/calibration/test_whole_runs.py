"""Runs that need a suite of their own: a miswired mirror, `dm up` against other electronics, the demo."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dm_msgs.action import Calibrate
from dm_msgs.msg import ErrorCode, ZernikeCoefficients

from dm_bringup.suite import load_config, save_config
from dm_calibration.map_files import read_map
from dm_client import DeformableMirrorClient
from dm_common.ros.domains import own_domain
from dm_simulation.parameters import PARAMETERS
from dm_tools.demo.demo_bench import bench_config
from dm_tools.verbs.up import shared_config
from fault_injection.rigs.forked_node import ForkedSuite
from support import fast_bench, wait_until

pytestmark = pytest.mark.processes

SEED = 20_11


def test_poke_check_finds_how_the_mirror_stands_and_writes_it(tmp_path: Path) -> None:
    """Turned by 35 degrees, mirrored, numbered from another actuator, two channels exchanged; then as configured."""
    config = fast_bench(tmp_path, SEED)
    config["virtual_bench"] |= {
        "interferometer.mount_angle": 0.611,
        "interferometer.mount_mirrored": True,
        "interferometer.mount_x": 0.001,
        "interferometer.field_diameter": 0.026,  # the aperture can follow the mirror
        "plate.start_angle": 1.0472,
    }
    wiring = list(next(parameter for parameter in PARAMETERS if parameter.name == "wiring").default)
    wiring[2], wiring[6] = wiring[6], wiring[2]
    config["virtual_bench"]["wiring"] = wiring
    config["virtual_bench"]["interferometer.pixels"] = 256  # bumps of actuators are large
    first, second = tmp_path / "first.yaml", tmp_path / "second.yaml"
    save_config(config, first)
    options = ["calibrate", "--plan", "poke-check"]
    with own_domain() as domain, ForkedSuite(config, tmp_path, domain):
        with DeformableMirrorClient(domain=domain, timeout_s=60.0) as client:
            client.wait_until_active()
        done = subprocess.run(
            [sys.executable, "-m", "dm_tools", *options, "--config", str(first), "--write", str(second)],
            env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
            capture_output=True,
            text=True,
            timeout=300,
        )
    text = " ".join((done.stdout + done.stderr).split())
    assert done.returncode == 1, text
    assert "actuators 3 and 7 are exchanged" in text and "mirrored left to right, then turned by " in text
    assert text.count("are exchanged") == 1 and "permuted" not in text, text
    with (
        own_domain() as domain,
        ForkedSuite(load_config(second), tmp_path, domain),
        DeformableMirrorClient(domain=domain, timeout_s=60.0) as client,
    ):
        client.wait_until_active()
        result = client.calibrate(Calibrate.Goal(plan=Calibrate.Goal.PLAN_POKE_CHECK))
    assert result.error_code == ErrorCode.OK and result.poke_check_passed and not result.parameters


def test_up_runs_the_nodes_against_other_electronics_and_a_watched_folder(tmp_path: Path) -> None:
    """`dm up --config FILE` without a virtual bench in it; emulated electronics and instrument are the hardware."""
    config = bench_config(tmp_path, "off", 0.0, SEED, speed=0.0)
    bench = {"virtual_bench": config.pop("virtual_bench")}
    for name in config:
        config[name].pop("use_sim_time", None)
    config["interferometer"].pop("trigger_command")
    config["interferometer"]["stable_time"] = 0.1
    save_config(config, tmp_path / "my_bench.yaml")
    trigger = Path(sys.modules["dm_simulation"].__path__[0]) / "interferometer" / "trigger.py"
    with (
        own_domain() as elsewhere,
        ForkedSuite(bench, tmp_path / "bench", elsewhere, nodes=("virtual_bench",)),
        own_domain() as domain,
    ):
        log = (tmp_path / "up.log").open("w+")
        process = subprocess.Popen(
            [sys.executable, "-m", "dm_tools", "up", "--config", str(tmp_path / "my_bench.yaml")],
            env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        try:
            with DeformableMirrorClient(domain=domain, timeout_s=60.0) as client:
                client.wait_until_active(30.0)
                assert client.mirror_info.electronics == "edac40_tcp"
                client.set_signals([0.1] * 37)
                port = str(bench["virtual_bench"]["trigger.port"])
                seen: list[Any] = []
                client.node.create_subscription(ZernikeCoefficients, "zernike", seen.append, 10)
                wait_until(lambda: client.node.count_publishers("zernike"), 60, what="the interferometer node")
                time.sleep(1.0)  # it must have discovered this subscription too
                saved = tmp_path / "maps" / "from_instrument.datx"
                subprocess.run([sys.executable, str(trigger), "--port", port, "--output", str(saved)], check=True)
                zernike = wait_until(lambda: seen and seen[-1], 60, what="the watched folder's map")
                assert zernike.radius == pytest.approx(0.011)
                assert zernike.wavelength == pytest.approx(read_map(saved).wavelength)
        finally:
            process.send_signal(signal.SIGINT)
            status = process.wait(30)
            log.seek(0)
            output = log.read()
            log.close()
    assert status == 0, output
    assert "safe shape" in output
    assert not re.findall(r".*\b(?:ERROR|FATAL)\b.*", output)


def test_a_bench_whose_processes_are_all_interrupted_at_once_ends_in_order(tmp_path: Path) -> None:
    """As by Ctrl-C on `ros2 launch`, which reaches the emulated hardware too."""
    config = fast_bench(tmp_path, SEED)
    config["autofocus"] = {}
    config["pdm_driver"]["limits.slew_rate"] = 1.0  # so that the way to the safe shape takes longer than to end
    with own_domain() as domain, ForkedSuite(config, tmp_path, domain) as suite:
        with DeformableMirrorClient(domain=domain, timeout_s=60.0) as client:
            client.wait_until_active()
            client.set_signals([0.3] * 37)
        for pid in suite.pids.values():
            os.kill(pid, signal.SIGINT)
        wait_until(lambda: len(suite.ended()) == len(suite.pids), 30.0, "the end of all nodes")
        logs = {name: suite.log(name).read_text() for name in suite.pids}
    assert "end of the process: the mirror stands in the safe shape" in logs["pdm_driver"]
    assert re.findall(r".*\b(?:WARN|ERROR|FATAL|Traceback)\b.*", "\n".join(logs.values())) == []


def test_demo_figures_have_the_agreed_fields(tmp_path: Path) -> None:
    """The demo as a user runs it, with a folder, figures and a smaller camera of the test's; reports: elsewhere."""
    config = load_config(shared_config("bench.yaml"))
    config["virtual_bench"]["interferometer.pixels"] = 354
    config["calibration"]["write_report"] = False
    bench = tmp_path / "bench.yaml"
    save_config(config, bench)
    figures = tmp_path / "demo.json"
    command = [sys.executable, "-m", "dm_tools", "demo", "--config", str(bench), "--hysteresis", "off"]
    done = subprocess.run(
        [*command, "--seed", "2012", "--out", str(tmp_path / "run"), "--json", str(figures)],
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    content = json.loads(figures.read_text())
    assert content["calibration"].keys() >= {
        "maps",
        "seconds",
        "in_sample_rms_nm",
        "held_out_rms_nm",
        "condition_number",
    }
    assert [row["curvature"] for row in content["focus"]] == pytest.approx(np.linspace(-0.05, 0.05, 11))
    for row in content["focus"]:
        assert row.keys() == {"curvature", "predicted_rms_nm", "measured_rms_nm", "max_zernike_nm", "saturated"}
        assert row["max_zernike_nm"] <= 632.8 / 500
    assert content["fitting_limit_nm"] > 0
    assert (tmp_path / "run" / "demo.png").stat().st_size > 50_000
    logs = [path.read_text(errors="replace") for path in (tmp_path / "run").rglob("*.log")]
    assert len(logs) >= 5 and re.findall(r".*\b(?:WARN|ERROR|FATAL)\b.*", "\n".join(logs)) == []
