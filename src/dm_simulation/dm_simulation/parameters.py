"""Parameters of the node `virtual_bench`, and the bench configuration made from their values."""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from dm_common.ros.parameters import Parameter, parameters_of
from dm_common.values import from_values, real, text, whole, wholes
from dm_simulation.bench import BenchConfig, FilesConfig, VirtualBench
from dm_simulation.camera import CameraConfig
from dm_simulation.electronics.drive_unit import DriveConfig
from dm_simulation.electronics.framed_unit import FramedConfig
from dm_simulation.electronics.monitor import MonitorConfig
from dm_simulation.electronics.server import OFF, PORT_TEXT, PortsConfig
from dm_simulation.interferometer.interferometer import InterferometerConfig
from dm_simulation.mirror.membrane import MembraneConfig
from dm_simulation.mirror.piezo import DRAWN, PiezoConfig
from dm_simulation.mirror.plate import PlateConfig

PARAMETERS = (
    Parameter("seed", whole(1, 0, 2**31), "Random seed of gains, initial figure, noise and all else that is drawn."),
    Parameter("mirror.name", text(FilesConfig.part_name), "Model of the mirror, as map files name it."),
    Parameter(
        "mirror.principle",
        text("piezo", choices=("piezo", "membrane")),
        "A plate on piezo stacks (plate.*, piezo.*), or a membrane pulled by electrodes (membrane.*).",
    ),
    *parameters_of("plate.", PlateConfig),
    *parameters_of("piezo.", DRAWN),
    *parameters_of("membrane.", MembraneConfig),
    *parameters_of("interferometer.", InterferometerConfig),
    *parameters_of("camera.", CameraConfig),
    *parameters_of("electronics.", PortsConfig),
    *parameters_of("framed.", FramedConfig),
    *parameters_of("electronics.", DriveConfig),
    Parameter("volts.min", real(DriveConfig.volts_min, -1e4, 1e4, "V"), "Actuator volts at signal -1."),
    Parameter("volts.max", real(DriveConfig.volts_max, -1e4, 1e4, "V"), "Actuator volts at signal +1."),
    Parameter(
        "wiring", wholes(list(DriveConfig.wiring), 0, 4095), "True connector channel (0-based) of actuators 1, 2, ..."
    ),
    *parameters_of("monitor.", MonitorConfig),
    Parameter("trigger.port", whole(BenchConfig.trigger_port, -1, 65535), f"Trigger {PORT_TEXT}"),
    Parameter(
        "output_folder",
        text(str(Path(tempfile.gettempdir()) / "virtual_bench"), path=True),
        "Folder of maps without a given path.",
    ),
    *parameters_of("output_", FilesConfig),
    Parameter(
        "clock.speed",
        real(0.0, 0.0, 1e4),
        "Publish /clock at this multiple of wall time and run the bench by it; 0 = no /clock, run by the node's time.",
    ),
    Parameter("clock.period", real(0.002, 1e-4, 1.0, "s"), "Wall time between two messages on /clock."),
)


def check_bench(values: Mapping[str, Any]) -> None:
    """Check that a bench of these values can be built, by building one without ports in a temporary folder.

    Raises:
        ValueError: it cannot; the message names the parameter.
    """
    config = bench_config(values)
    with tempfile.TemporaryDirectory(prefix="virtual-bench-") as folder:
        terminal = str(Path(folder) / "pty") if config.ports.pty_link else ""
        ports = replace(config.ports, tcp_port=OFF, udp_port=OFF, discovery_port=OFF, pty_link=terminal)
        files = replace(config.files, folder=Path(folder))
        VirtualBench(replace(config, ports=ports, files=files, trigger_port=OFF)).close()


def bench_config(values: Mapping[str, Any]) -> BenchConfig:
    """The configuration for the values of all parameters of PARAMETERS."""
    membrane = values["mirror.principle"] == "membrane"
    return BenchConfig(
        seed=values["seed"],
        plate=from_values(PlateConfig, values, "plate."),
        piezo=from_values(PiezoConfig, values, "piezo."),
        membrane=from_values(MembraneConfig, values, "membrane.") if membrane else None,
        interferometer=from_values(InterferometerConfig, values, "interferometer."),
        camera=from_values(CameraConfig, values, "camera."),
        drive=from_values(
            DriveConfig,
            values,
            "electronics.",
            volts_min=values["volts.min"],
            volts_max=values["volts.max"],
            squared=membrane,
            wiring=tuple(values["wiring"]),
        ),
        ports=from_values(PortsConfig, values, "electronics.", framed=from_values(FramedConfig, values, "framed.")),
        monitor=from_values(MonitorConfig, values, "monitor."),
        files=from_values(
            FilesConfig,
            values,
            "output_",
            folder=Path(values["output_folder"]).expanduser(),
            part_name=values["mirror.name"],
        ),
        trigger_port=values["trigger.port"],
    )
