"""Parameters of the node `virtual_bench`, and the bench configuration made of their values."""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from dm_common.ros.parameters import Parameter, fields_of, live, real, reals, switch, text, whole, wholes
from dm_simulation.bench import BenchConfig, FilesConfig, VirtualBench
from dm_simulation.camera import CameraConfig
from dm_simulation.electronics.drive_unit import DriveConfig
from dm_simulation.electronics.framed_unit import BYTE_ORDERS, CHECK_LENGTH, FramedConfig
from dm_simulation.electronics.monitor import MonitorConfig
from dm_simulation.electronics.server import OFF, PortsConfig
from dm_simulation.interferometer.interferometer import InterferometerConfig
from dm_simulation.interferometer.interferometer_parameters import INTERFEROMETER
from dm_simulation.interferometer.zygo_files import FORMATS, UNITS
from dm_simulation.mirror.hysteresis import LAWS
from dm_simulation.mirror.membrane import MembraneConfig
from dm_simulation.mirror.piezo import DRAWN, PiezoConfig
from dm_simulation.mirror.plate import PlateConfig

_CAMERA, _DRIVE, _FILES = CameraConfig(), DriveConfig(), FilesConfig()
_plate = fields_of("plate", PlateConfig())
_piezo = fields_of("piezo", DRAWN)
_membrane = fields_of("membrane", MembraneConfig())
_camera = fields_of("camera", _CAMERA)
_drive = fields_of("electronics", _DRIVE)
_port = fields_of("electronics", PortsConfig())
_monitor = fields_of("monitor", MonitorConfig())
_framed = fields_of("framed", FramedConfig())
_PLATE_ON_PIEZOS, _ELECTROSTATIC_MEMBRANE = PRINCIPLES = ("piezo", "membrane")
_PORT_TEXT = "on 127.0.0.1; 0 = any free port, -1 = not offered."

PARAMETERS = (
    Parameter("seed", whole(1, 0, 2**31), "Fixes gains, initial figure and noise, and what else is drawn."),
    Parameter("mirror.name", text(_FILES.part_name), "Model of the mirror, as map files name it."),
    Parameter(
        "mirror.principle",
        text(_PLATE_ON_PIEZOS, choices=PRINCIPLES),
        "A plate on piezo stacks (plate.*, piezo.*), or a membrane that electrodes pull (membrane.*).",
    ),
    _plate("diameter", real(..., 1e-3, 1.0, "m"), "Diameter of the faceplate."),
    _plate("thickness", real(..., 1e-5, 0.1, "m"), "Thickness of the faceplate."),
    _plate("youngs_modulus", real(..., 1e6, 1e13, "Pa"), "Young's modulus."),
    _plate("poisson_ratio", real(..., 0.0, 0.49), "Poisson's ratio."),
    _plate("spring_stiffness", real(..., 1.0, 1e12, "N/m"), "Stiffness of one stack."),
    _plate("actuators", whole(..., 7, 1000), "Actuators of the hexagonal pattern."),
    _plate("pitch", real(..., 1e-4, 0.1, "m"), "Distance of neighbouring actuators."),
    _plate("start_angle", real(..., -7.0, 7.0, "rad"), "Angle of actuator 2 from the x axis."),
    _plate("clockwise", switch(...), "Whether actuators are numbered clockwise in their rings."),
    _plate("order", whole(..., 12, 60), "Radial order of the Ritz solution."),
    Parameter(
        "plate.actuator_x", reals([], -1.0, 1.0, "m"), "Actuator positions, x, in place of the hexagonal pattern."
    ),
    Parameter(
        "plate.actuator_y", reals([], -1.0, 1.0, "m"), "Actuator positions, y, in place of the hexagonal pattern."
    ),
    _piezo("stroke", real(..., 0.0, 1e-3, "m"), "Stroke of a stack from signal -1 to +1."),
    _piezo("gain_spread", real(..., 0.0, 0.3), "Standard deviation of relative gains."),
    _piezo("law", text(..., choices=LAWS), "Hysteresis law; drawn_* = each actuator its own, by the seed."),
    _piezo("hysteresis", real(..., 0.0, 0.3), "Widest loop opening over the full stroke."),
    _piezo("hysteresis_spread", real(..., 0.0, 0.3), "Spread of relative loop openings."),
    _piezo("creep", real(..., 0.0, 0.1), "Creep of a step per decade of time."),
    _piezo("creep_spread", real(..., 0.0, 0.3), "Spread of relative creep."),
    _piezo("creep_fastest", real(..., 1e-3, 1e6, "s"), "Fastest element of creep."),
    _piezo("creep_slowest", real(..., 1e-3, 1e7, "s"), "Slowest element of creep."),
    _piezo("creep_per_decade", whole(..., 1, 10), "Elements per decade of time."),
    _piezo("spectrum_spread", real(..., 0.0, 1.0), "Spread of elements, as a logarithm."),
    _piezo("creep_position", real(..., -0.5, 0.5), "Change of creep from mid range to 1."),
    _piezo("rate_dependence", real(..., 0.0, 0.1), "Widening of loops per decade of speed."),
    _piezo("stiffening", real(..., 0.0, 0.2), "Share of stroke lost at its ends, in squares."),
    _piezo("drift", real(..., 0.0, 1e-7, "m"), "Drift of the bases over a day."),
    _piezo("swing", real(..., 0.0, 20.0, "K"), "Swing of the temperature over a day, about 20 degC."),
    _piezo("warm_gain", real(..., -0.01, 0.01, "1/K"), "Relative change of all gains per kelvin."),
    _piezo("warm_base", real(..., 0.0, 1e-7, "m/K"), "What bases go by per kelvin, spread."),
    _membrane("diameter", real(..., 1e-3, 1.0, "m"), "Diameter inside the frame."),
    _membrane("tension", real(..., 1e-3, 1e5, "N/m"), "Tension of the membrane."),
    _membrane("gap", real(..., 1e-6, 1e-2, "m"), "From the electrodes to the flat membrane."),
    _membrane("actuators", whole(..., 7, 1000), "Electrodes of the hexagonal pattern."),
    _membrane("pitch", real(..., 1e-4, 0.1, "m"), "Distance of neighbouring electrodes."),
    _membrane("electrode_diameter", real(..., 1e-4, 0.1, "m"), "Diameter of an electrode."),
    _membrane("gain_spread", real(..., 0.0, 0.3), "Standard deviation of relative pulls."),
    _membrane("drift", real(..., 0.0, 1e-5, "m"), "Deflection that the zero drifts by."),
    _membrane("drift_time", real(..., 1.0, 1e7, "s"), "Time of 63 % of that drift."),
    _membrane("order", whole(..., 12, 60), "Degree of the polynomials of the solution."),
    *INTERFEROMETER,
    _camera("rate", real(..., 0.0, 200.0, "Hz"), "Images per second of wall time on image_raw; 0 = no camera."),
    _camera("width", whole(..., 16, 2048, "px"), "Image width."),
    _camera("height", whole(..., 16, 2048, "px"), "Image height."),
    _camera("pixel_pitch", real(..., 1e-7, 1e-3, "m"), "Pixel pitch."),
    _camera("focal_length", real(..., 1e-3, 10.0, "m"), "Focal length of the lens."),
    _camera(
        "rest_distance", real(..., 0.0, 1e6, "m"), "Object distance in focus while the mirror is flat; 0 = infinity."
    ),
    _camera(
        "relay_magnification", real(..., 0.01, 100.0), "Diameter of the beam on the mirror / of the entrance pupil."
    ),
    _camera("wavelength", real(..., 1e-7, 2e-5, "m"), "Wavelength of the images."),
    live(
        "camera.distances",
        reals(list(_CAMERA.distances), 0.0, 1e6, "m"),
        "Distances of the objects, from left to right; 0 = infinity. Their number stays.",
    ),
    _camera("photons", real(..., 1.0, 1e9), "Electrons per pixel at the mean grey level."),
    _port("tcp_port", whole(..., -1, 65535), f"EDAC40 over TCP {_PORT_TEXT}"),
    _port("udp_port", whole(..., -1, 65535), f"EDAC40 over UDP {_PORT_TEXT}"),
    _port("discovery_port", whole(..., -1, 65535), f"EDAC40 discovery {_PORT_TEXT}"),
    _port(
        "pty_link",
        text(...),
        "Path of a symbolic link to the pseudo-terminal of the USB DAC-40 or the framed unit; empty = not offered.",
    ),
    _framed("channels", whole(..., 0, 4096), "Words in a frame of the serial unit; 0 = it is a USB DAC-40."),
    _framed("bits", whole(..., 1, 16), "Bits of a code of the serial unit."),
    _framed("header", text(...), "Bytes before the words, hexadecimal."),
    _framed("terminator", text(...), "Bytes after the check sum, hexadecimal."),
    _framed("opening", text(...), "Bytes that may come before a frame, hexadecimal."),
    _framed("reply", text(...), "Answer to every frame, hexadecimal."),
    Parameter("framed.channel_order", wholes([], 0, 4095), "Channels in the order of their words."),
    _framed("word_bits", whole(..., 0, 32), "Bits of a word; 0 = whole bytes."),
    _framed("byte_order", text(..., choices=BYTE_ORDERS), "Order of bytes and bits."),
    _framed("scale", whole(..., -(2**31), 2**31), "word = offset + scale * code."),
    _framed("offset", whole(..., -(2**31), 2**32), "word = offset + scale * code."),
    _framed("checksum", text(..., choices=tuple(CHECK_LENGTH)), "Check sum."),
    _framed("checksum_covers_header", switch(...), "It counts the header."),
    _framed("checksum_byte_order", text(..., choices=BYTE_ORDERS), "Of two bytes."),
    _drive("channels", whole(..., 1, 4096), "Channels at the connector."),
    _drive("dac_volts_at_zero", real(..., -100.0, 100.0, "V"), "DAC output at code 0."),
    _drive("dac_volts_at_full", real(..., -100.0, 100.0, "V"), "DAC output at full code."),
    _drive("amplifier_gain", real(..., -1e4, 1e4), "Actuator V per DAC V."),
    _drive("amplifier_min", real(..., -1e4, 1e4, "V"), "Lowest actuator volts."),
    _drive("amplifier_max", real(..., -1e4, 1e4, "V"), "Highest actuator volts."),
    Parameter("volts.min", real(_DRIVE.volts_min, -1e4, 1e4, "V"), "Actuator volts at signal -1."),
    Parameter("volts.max", real(_DRIVE.volts_max, -1e4, 1e4, "V"), "Actuator volts at signal +1."),
    Parameter(
        "wiring", wholes(list(_DRIVE.wiring), 0, 4095), "True connector channel (0-based) of actuators 1, 2, ..."
    ),
    _monitor("jump", real(..., 0.0, 4.0), "Counted: change per frame above this; 0 = off."),
    _monitor(
        "neighbour_difference", real(..., 0.0, 4.0), "Counted: difference of neighbouring signals above this; 0 = off."
    ),
    _monitor("signal_min", real(..., -10.0, 10.0), "Counted: signals below this."),
    _monitor("signal_max", real(..., -10.0, 10.0), "Counted: signals above this."),
    _monitor("tolerance", real(..., 0.0, 1.0), "Allowance for DAC steps."),
    Parameter("trigger.port", whole(1235, -1, 65535), f"Trigger {_PORT_TEXT}"),
    Parameter(
        "output_folder",
        text(str(Path(tempfile.gettempdir()) / "virtual_bench")),
        "Folder of maps without a given path.",
    ),
    Parameter("output_format", text(_FILES.format, choices=FORMATS), "Format of maps without a given path."),
    Parameter("output_datx_unit", text(_FILES.datx_unit, choices=UNITS), "Unit of the heights in .datx files."),
    Parameter("output_intensity", switch(_FILES.intensity), "Whether .dat files have an intensity frame."),
    Parameter(
        "output_slow_write",
        real(_FILES.slow_write, 0.0, 60.0, "s"),
        "Wall time over which a file grows; 0 = it appears whole.",
    ),
    Parameter(
        "output_limit",
        real(_FILES.limit, 0.0, 1e15, "B"),
        "Maps in output_folder are removed, the oldest first, beyond this; 0 = all are kept.",
    ),
    Parameter(
        "clock.speed",
        real(0.0, 0.0, 1e4),
        "Publish /clock at this multiple of the wall clock, and live by it; 0 = no /clock, the node's own time.",
    ),
    Parameter("clock.period", real(0.002, 1e-4, 1.0, "s"), "Wall time between two messages on /clock."),
)


def check_bench(values: Mapping[str, Any]) -> None:
    """Build the bench of these values, away from its ports and folder, to see whether it can be built.

    Raises:
        ValueError: it cannot, naming the parameter.
    """
    config = bench_config(values)
    with tempfile.TemporaryDirectory(prefix="virtual-bench-") as folder:
        terminal = str(Path(folder) / "pty") if config.ports.pty_link else ""
        ports = replace(config.ports, tcp_port=OFF, udp_port=OFF, discovery_port=OFF, pty_link=terminal)
        files = replace(config.files, folder=Path(folder))
        VirtualBench(replace(config, ports=ports, files=files, trigger_port=OFF)).close()


def bench_config(values: Mapping[str, Any]) -> BenchConfig:
    """The configuration for the values of all parameters of PARAMETERS."""

    def group(prefix: str) -> dict[str, Any]:
        return {name.partition(".")[2]: value for name, value in values.items() if name.startswith(prefix + ".")}

    electronics = group("electronics")
    ports = {name: electronics.pop(name) for name in ("tcp_port", "udp_port", "discovery_port", "pty_link")}
    if ports["pty_link"]:
        ports["pty_link"] = str(Path(ports["pty_link"]).expanduser())
    membrane = values["mirror.principle"] == _ELECTROSTATIC_MEMBRANE
    return BenchConfig(
        seed=values["seed"],
        plate=PlateConfig(
            **group("plate") | {name: tuple(values[f"plate.{name}"]) for name in ("actuator_x", "actuator_y")}
        ),
        piezo=PiezoConfig(**group("piezo")),
        membrane=MembraneConfig(**group("membrane")) if membrane else None,
        interferometer=InterferometerConfig(**group("interferometer")),
        camera=CameraConfig(**group("camera") | {"distances": tuple(values["camera.distances"])}),
        drive=DriveConfig(
            **electronics,
            volts_min=values["volts.min"],
            volts_max=values["volts.max"],
            squared=membrane,
            wiring=tuple(values["wiring"]),
        ),
        ports=PortsConfig(
            **ports, framed=FramedConfig(**group("framed") | {"channel_order": tuple(values["framed.channel_order"])})
        ),
        monitor=MonitorConfig(**group("monitor")),
        files=FilesConfig(
            folder=Path(values["output_folder"]).expanduser(),
            format=values["output_format"],
            datx_unit=values["output_datx_unit"],
            intensity=values["output_intensity"],
            slow_write=values["output_slow_write"],
            limit=values["output_limit"],
            part_name=values["mirror.name"],
        ),
        trigger_port=values["trigger.port"],
    )
