"""The whole virtual bench without ROS: frames in, map files out."""

from __future__ import annotations

import ast
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import dm_simulation
from dm_simulation.bench import BenchConfig, FilesConfig, VirtualBench
from dm_simulation.electronics.drive_unit import TRIHEX, DriveConfig
from dm_simulation.electronics.monitor import MonitorConfig
from dm_simulation.electronics.server import PortsConfig
from dm_simulation.interferometer import trigger
from dm_simulation.interferometer.interferometer import InterferometerConfig
from dm_simulation.mirror.piezo import PiezoConfig
from dm_simulation.parameters import PARAMETERS, bench_config
from waiting import wait_until

FOLDER = Path(dm_simulation.__file__).parent


class Clock:
    """Time by hand."""

    def __init__(self) -> None:
        self.seconds = 1_700_000_000.0

    def __call__(self) -> float:
        return self.seconds


Make = Callable[..., VirtualBench]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    made: list[VirtualBench] = []

    def build(now: Callable[[], float] | None = None, **changes: object) -> VirtualBench:
        config = BenchConfig(
            interferometer=InterferometerConfig(pixels=96),
            ports=PortsConfig(0, -1, -1),
            monitor=MonitorConfig(jump=0.0),
            files=FilesConfig(folder=tmp_path / "maps", format="dat"),
            trigger_port=0,
        )
        made.append(VirtualBench(replace(config, **changes), now or Clock()))  # type: ignore[arg-type]
        return made[-1]

    yield build
    for bench in made:
        bench.close()


def send(bench: VirtualBench, signals: NDArray[np.float64]) -> None:
    """One EDAC40 value frame on all channels, put together here."""
    physical = (
        "6 7 4 5 2 3 0 1 22 23 20 21 18 19 16 17 14 15 12 13 10 11 8 9 38 39 36 37 34 35 32 33 30 31 28 29 26 27 24 25"
    )
    codes = np.zeros(40, "<u2")
    on_connector = np.zeros(40)
    on_connector[list(TRIHEX)] = (signals + 1) / 2 * 300 / 400 * 65535
    codes[[int(word) for word in physical.split()]] = np.rint(on_connector)
    with socket.create_connection(("127.0.0.1", int(bench.endpoints["tcp_port"])), timeout=5) as client:
        frames = bench.monitor.record.frames
        client.sendall(b"\xff" * 5 + b"\0" + codes.tobytes())
        for _ in range(2000):
            if bench.electronics.run(lambda: bench.monitor.record.frames) > frames:
                return
    raise AssertionError("the frame did not arrive")


def read_dat(path: Path) -> NDArray[np.float64]:
    """Heights in m of a phase-only file of 96 x 96 pixels at phase resolution 131072."""
    counts = np.frombuffer(path.read_bytes(), ">i4", offset=834).reshape(96, 96)
    return np.where(counts >= 2147483640, np.nan, counts * (0.5 * 632.8e-9 / 131072))


def test_a_frame_moves_the_mirror_and_the_map_shows_it(make: Make) -> None:
    quiet = InterferometerConfig(pixels=96, pixel_noise=0, low_order_noise=0, piston_spread=0, tilt_spread=0)
    bench = make(interferometer=quiet, piezo=PiezoConfig(law="none", creep=0.0, gain_spread=0.0))
    send(bench, np.zeros(37))
    before = read_dat(bench.measure())
    signals = np.zeros(37)
    signals[9] = 0.5
    send(bench, signals)
    after = read_dat(bench.measure())
    expected = bench.interferometer.true_sag(2e-6 * np.eye(37)[9]) - bench.interferometer.true_sag(np.zeros(37))
    both = np.isfinite(after - before)
    assert both.sum() > 6000
    np.testing.assert_allclose((after - before)[both], expected[both], atol=0.5e-9)  # DAC steps
    assert bench.monitor.record.violations == 0
    assert np.isnan(before).sum() != np.isnan(expected).sum()  # dropouts


def test_a_frame_that_cannot_be_carried_out_is_severe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[tuple[bool, str]] = []
    config = BenchConfig(ports=PortsConfig(-1, 0, -1), files=FilesConfig(folder=tmp_path), trigger_port=-1)
    bench = VirtualBench(config, Clock(), lambda severe, text: events.append((severe, text)))
    monkeypatch.setattr(bench.monitor, "watch", lambda _signals: 1 / 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.sendto(b"\xff" * 5 + bytes(81), ("127.0.0.1", int(bench.endpoints["udp_port"])))
    wait_until(lambda: events, 10.0)
    bench.close()
    assert events == [(True, "failed, ZeroDivisionError: division by zero")]


def test_true_wiring_decides_which_actuator_moves(make: Make) -> None:
    swapped = (TRIHEX[1], TRIHEX[0], *TRIHEX[2:])
    bench = make(drive=DriveConfig(wiring=swapped), piezo=PiezoConfig(law="none", creep=0.0, gain_spread=0.0))
    signals = np.full(37, -1.0)
    signals[0] = 0.0
    send(bench, signals)
    assert np.argmax(bench.displacement()) == 1


def test_creep_goes_by_the_clock_that_is_given(make: Make) -> None:
    clock = Clock()
    bench = make(now=clock)
    send(bench, np.ones(37))
    at_once = bench.displacement()
    clock.seconds += 100.0
    later = bench.displacement()
    growth = (later - at_once) / (at_once + 4e-6)
    assert np.all((growth > 0.01) & (growth < 0.06))


@pytest.mark.slow
def test_the_same_seed_gives_the_same_maps(make: Make) -> None:
    first, second, other = make(), make(), make(seed=2)
    paths = [bench.measure() for bench in (first, second, other)]
    contents = [path.read_bytes() for path in paths]
    assert len(set(paths)) == 3
    assert contents[0] == contents[1] != contents[2]
    assert first.measure().read_bytes() != contents[0]


def run_client(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-S", "-I", str(FOLDER / "interferometer" / "trigger.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.slow
def test_trigger_client(make: Make, tmp_path: Path) -> None:
    bench = make()
    port = str(bench.endpoints["trigger_port"])
    answer = run_client("--port", port)
    assert (answer.returncode, answer.stderr) == (0, "")
    assert Path(answer.stdout.strip()) == tmp_path / "maps" / "map_000000.dat"
    wanted = tmp_path / "a map with blanks.datx"
    answer = run_client("--port", port, "--output", str(wanted))
    assert (answer.returncode, answer.stdout.strip()) == (0, str(wanted))
    assert wanted.read_bytes()[:4] == b"\x89HDF"
    assert bench.maps_written == 2


@pytest.mark.parametrize(
    ("output", "reason"),
    [
        ("relative.dat", "must be absolute"),
        ("/tmp/map.png", "must end in .dat or .datx"),
        ("/no/such/folder/map.dat", "No such file"),
    ],
)
def test_trigger_says_why_not(make: Make, output: str, reason: str) -> None:
    bench = make()
    answer = run_client("--port", str(bench.endpoints["trigger_port"]), "--output", output)
    assert answer.returncode == 1
    assert reason in answer.stderr
    assert bench.maps_written == 0


def test_trigger_client_without_a_bench_or_with_wrong_arguments() -> None:
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        answer = run_client("--port", str(reserved.getsockname()[1]))
    assert answer.returncode == 1
    assert "refused" in answer.stderr
    assert run_client("--prot", "1").returncode == 1
    assert trigger.main(["--port", "many"]) == 1


def test_unknown_requests_are_answered(make: Make) -> None:
    bench = make()
    with socket.create_connection(("127.0.0.1", int(bench.endpoints["trigger_port"])), timeout=5) as client:
        client.sendall(b"EXPOSE now\n")
        assert client.makefile().readline().startswith("ERROR unknown request 'EXPOSE'")


@pytest.mark.slow
def test_ports_are_free_again_after_a_failed_start(make: Make) -> None:
    bench = make()
    config = replace(bench.config, ports=PortsConfig(-1, 0, -1), trigger_port=int(bench.endpoints["trigger_port"]))
    with pytest.raises(OSError, match=r"trigger.port"):
        VirtualBench(config)


def test_parameter_table_builds_the_standard_bench() -> None:
    config = bench_config({parameter.name: parameter.default for parameter in PARAMETERS})
    standard = BenchConfig()
    assert replace(config, files=standard.files) == standard
    for parameter in PARAMETERS:
        parameter.check(parameter.default)


def test_the_simulation_imports_nothing_of_what_it_judges() -> None:
    """Only the node's own module may use what all nodes share; the simulated physics knows parameters alone."""
    for module in FOLDER.rglob("*.py"):
        shared = (
            ["dm_common.ros"] if module.stem.endswith("_node") else ["dm_common.ros.parameters", "dm_common.values"]
        )
        for node in ast.walk(ast.parse(module.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            for name in names:
                if name.startswith("dm_"):
                    assert name.startswith(("dm_simulation", *shared)), (module, name)
