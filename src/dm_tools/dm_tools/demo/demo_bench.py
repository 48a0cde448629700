"""The virtual bench of a run: a configuration with ports and folders of its own."""

import contextlib
import fcntl
import os
import random
import shutil
import socket
import tempfile
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import Any

from dm_bringup.suite import Suite, load_config
from dm_tools.verbs.calibrate import made_by, run_calibration, show_result
from dm_tools.verbs.up import move_trigger, shared_config

#: Value of a port that the virtual bench does not open.
OFF = -1
#: Name of the file that marks the folder of a demo.
MARK = ".dm_demo"
#: Above the default range of Linux's ephemeral ports (net.ipv4.ip_local_port_range).
PORTS = range(61000, 65536)
#: Parameters of a bench whose actuators all follow the same law.
SAME_ACTUATORS = {f"piezo.{name}_spread": 0.0 for name in ("hysteresis", "creep", "spectrum")}


class Hysteresis(StrEnum):
    """Hysteresis of the simulated actuators."""

    off = "off"
    drawn_preisach = "drawn_preisach"
    prandtl_ishlinskii = "prandtl_ishlinskii"
    preisach = "preisach"
    bouc_wen = "bouc_wen"


def free_ports(count: int) -> list[int]:
    """Ports that are free on loopback now, for TCP and UDP alike.

    They are handed out in turn over all processes of this user: another process could draw the same port at random
    while neither has bound it. Raises RuntimeError when fewer than `count` are free.
    """
    ports: list[int] = []
    with (Path(tempfile.gettempdir()) / f"dm-ports-{os.getuid()}").open("a+") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        turn.seek(0)
        last = int(turn.read().strip() or random.SystemRandom().choice(PORTS))
        for step in range(len(PORTS)):
            port = PORTS[(last + 1 + step - PORTS.start) % len(PORTS)]
            with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as datagram:
                datagram.bind(("127.0.0.1", port))
                socket.create_server(("127.0.0.1", port)).close()
                ports.append(port)
            if len(ports) == count:
                turn.truncate(0)
                turn.write(f"{port}")
                return ports
    raise RuntimeError(f"no {count} free ports from {PORTS.start} on")


def bench_config(
    folder: Path, law: str, creep: float, seed: int, speed: float, source: Path | None = None
) -> dict[str, dict[str, Any]]:
    """A configuration of a virtual bench with ports and folders of this run's own, and time `speed` times as fast.

    Args:
        law: of all actuators, `off` = none; with a name that begins with `drawn`, they differ in loops and creep.
        source: the parameter file; None = the shipped bench.

    Raises:
        ConfigError: the file cannot be used.
        ValueError: it lacks the virtual bench, a node, or another part that a run changes.
    """
    source = source if source is not None else shared_config("bench.yaml")
    config = load_config(source)
    for node in ("virtual_bench", "pdm_driver", "interferometer", "calibration", "focus_controller"):
        if node not in config:
            raise ValueError(f"{source}: no section for {node}: a demo needs a virtual bench and all nodes")
    bench, driver = config["virtual_bench"], config["pdm_driver"]
    tcp, udp, discovery, trigger = free_ports(4)
    move_trigger(config, trigger)
    own_ports = {"electronics.tcp_port": tcp, "electronics.udp_port": udp, "electronics.discovery_port": discovery}
    bench |= {name: port for name, port in own_ports.items() if bench.get(name) != OFF}
    bench |= {
        "seed": seed,
        "piezo.law": "none" if law == "off" else law,
        "piezo.creep": creep,
        **({} if law.startswith("drawn") else SAME_ACTUATORS),
        "clock.speed": speed,
        "output_folder": str(folder / "maps"),
    }
    if bench.get("electronics.pty_link"):
        bench["electronics.pty_link"] = driver["electronics.serial_port"] = str(folder / "tty")
    driver |= {"electronics.port": tcp, "state_folder": str(folder / "driver")}
    config["focus_controller"]["state_folder"] = config["calibration"]["state_folder"] = str(folder / "controller")
    config["interferometer"]["watch_folder"] = str(folder / "maps")
    config["calibration"] |= {"calibration_folder": str(folder / "calibrations"), "load_on_start": ""}
    (folder / "maps").mkdir(parents=True, exist_ok=True)
    if speed > 0:
        if law == "off":  # such actuators need no finer time step, and every tick wakes every node
            bench["clock.period"] = 0.02
        # Ages are in ROS time, in which the same delay between two processes is `speed` times as long.
        config["pdm_driver"] |= {"limits.command_age": max(1.0, speed), "limits.command_lead": max(0.5, speed)}
        config["focus_controller"]["request_age"] = max(1.0, speed)
        for name in config:
            config[name]["use_sim_time"] = name != "virtual_bench"
    return config


def usable_folder(path: Path) -> Path:
    """The folder of a demo, absolute. Raises ValueError when it holds anything that is not from a demo."""
    folder = path.resolve()
    if folder.exists() and not (folder.is_dir() and ((folder / MARK).is_file() or not any(folder.iterdir()))):
        raise ValueError(
            f"--out {path}: exists and is not of a demo, which would empty it: name another, or delete it (earlier "
            "versions left no mark)"
        )
    return folder


def make_empty(folder: Path) -> None:
    """Create or empty `folder` (see `usable_folder`); it is not replaced: it may be a mount or a working directory."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MARK).write_text("made by dm demo, which empties this folder when it begins\n")
    for path in (path for path in folder.iterdir() if path.name != MARK):
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    (folder / "maps").mkdir()


@contextlib.contextmanager
def running_bench(config: dict[str, dict[str, Any]], logs: Path, domain: int, client_class: Any) -> Iterator[Any]:
    """The nodes of a configuration and a client of theirs, once the driver accepts commands."""
    from dm_client import STARTING_S

    with Suite(config, logs, domain) as suite, client_class(domain=domain, timeout_s=STARTING_S) as client:
        try:
            client.wait_until_active(20.0)
            yield client
        except Exception:
            suite.check()  # a node that died explains more than the request that failed
            raise


def wait_for_calibration(client: Any, identifier: str) -> None:
    """Wait until the focus controller uses a calibration. Raises RuntimeError if it does not."""
    if not client.wait(lambda: client.capabilities.calibration_id == identifier):
        raise RuntimeError("the focus controller did not load the new calibration")


def identify_hysteresis(client: Any, maps: int, note: str) -> Any:
    """Calibrate with hysteresis and creep from `maps` maps and print the outcome; returns the action's result."""
    from dm_msgs.action import Calibrate

    goal = Calibrate.Goal(plan=Calibrate.Goal.PLAN_HYSTERESIS, hysteresis_maps=maps, activate=True, note=note)
    result = run_calibration(client, goal)
    show_result(result, made_by(client, result))
    return result
