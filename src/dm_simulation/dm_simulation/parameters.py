"""Parameters of the node `virtual_bench`, and the bench configuration made of their values."""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from dm_common.ros.parameters import Parameter, real, reals, switch, text, whole, wholes
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

_PLATE = PlateConfig()
_PIEZO = DRAWN
_MEMBRANE = MembraneConfig()
_CAMERA = CameraConfig()
_DRIVE = DriveConfig()
_PORTS = PortsConfig()
_MONITOR = MonitorConfig()
_FILES = FilesConfig()
_FRAMED = FramedConfig()
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
    Parameter("plate.diameter", real(_PLATE.diameter, 1e-3, 1.0, "m"), "Diameter of the faceplate."),
    Parameter("plate.thickness", real(_PLATE.thickness, 1e-5, 0.1, "m"), "Thickness of the faceplate."),
    Parameter("plate.youngs_modulus", real(_PLATE.youngs_modulus, 1e6, 1e13, "Pa"), "Young's modulus."),
    Parameter("plate.poisson_ratio", real(_PLATE.poisson_ratio, 0.0, 0.49), "Poisson's ratio."),
    Parameter("plate.spring_stiffness", real(_PLATE.spring_stiffness, 1.0, 1e12, "N/m"), "Stiffness of one stack."),
    Parameter("plate.actuators", whole(_PLATE.actuators, 7, 1000), "Actuators of the hexagonal pattern."),
    Parameter("plate.pitch", real(_PLATE.pitch, 1e-4, 0.1, "m"), "Distance of neighbouring actuators."),
    Parameter("plate.start_angle", real(_PLATE.start_angle, -7.0, 7.0, "rad"), "Angle of actuator 2 from the x axis."),
    Parameter("plate.clockwise", switch(_PLATE.clockwise), "Whether actuators are numbered clockwise in their rings."),
    Parameter("plate.order", whole(_PLATE.order, 12, 60), "Radial order of the Ritz solution."),
    Parameter(
        "plate.actuator_x", reals([], -1.0, 1.0, "m"), "Actuator positions, x, in place of the hexagonal pattern."
    ),
    Parameter(
        "plate.actuator_y", reals([], -1.0, 1.0, "m"), "Actuator positions, y, in place of the hexagonal pattern."
    ),
    Parameter("piezo.stroke", real(_PIEZO.stroke, 0.0, 1e-3, "m"), "Stroke of a stack from signal -1 to +1."),
    Parameter("piezo.gain_spread", real(_PIEZO.gain_spread, 0.0, 0.3), "Standard deviation of relative gains."),
    Parameter(
        "piezo.law", text(_PIEZO.law, choices=LAWS), "Hysteresis law; drawn_* = each actuator its own, by the seed."
    ),
    Parameter("piezo.hysteresis", real(_PIEZO.hysteresis, 0.0, 0.3), "Widest loop opening over the full stroke."),
    Parameter("piezo.hysteresis_spread", real(_PIEZO.hysteresis_spread, 0.0, 0.3), "Spread of relative loop openings."),
    Parameter("piezo.creep", real(_PIEZO.creep, 0.0, 0.1), "Creep of a step per decade of time."),
    Parameter("piezo.creep_spread", real(_PIEZO.creep_spread, 0.0, 0.3), "Spread of relative creep."),
    Parameter("piezo.creep_fastest", real(_PIEZO.creep_fastest, 1e-3, 1e6, "s"), "Fastest element of creep."),
    Parameter("piezo.creep_slowest", real(_PIEZO.creep_slowest, 1e-3, 1e7, "s"), "Slowest element of creep."),
    Parameter("piezo.creep_per_decade", whole(_PIEZO.creep_per_decade, 1, 10), "Elements per decade of time."),
    Parameter("piezo.spectrum_spread", real(_PIEZO.spectrum_spread, 0.0, 1.0), "Spread of elements, as a logarithm."),
    Parameter("piezo.creep_position", real(_PIEZO.creep_position, -0.5, 0.5), "Change of creep from mid range to 1."),
    Parameter(
        "piezo.rate_dependence", real(_PIEZO.rate_dependence, 0.0, 0.1), "Widening of loops per decade of speed."
    ),
    Parameter("piezo.stiffening", real(_PIEZO.stiffening, 0.0, 0.2), "Share of stroke lost at its ends, in squares."),
    Parameter("piezo.drift", real(_PIEZO.drift, 0.0, 1e-7, "m"), "Drift of the bases over a day."),
    Parameter("piezo.swing", real(_PIEZO.swing, 0.0, 20.0, "K"), "Swing of the temperature over a day, about 20 degC."),
    Parameter(
        "piezo.warm_gain", real(_PIEZO.warm_gain, -0.01, 0.01, "1/K"), "Relative change of all gains per kelvin."
    ),
    Parameter("piezo.warm_base", real(_PIEZO.warm_base, 0.0, 1e-7, "m/K"), "What bases go by per kelvin, spread."),
    Parameter("membrane.diameter", real(_MEMBRANE.diameter, 1e-3, 1.0, "m"), "Diameter inside the frame."),
    Parameter("membrane.tension", real(_MEMBRANE.tension, 1e-3, 1e5, "N/m"), "Tension of the membrane."),
    Parameter("membrane.gap", real(_MEMBRANE.gap, 1e-6, 1e-2, "m"), "From the electrodes to the flat membrane."),
    Parameter("membrane.actuators", whole(_MEMBRANE.actuators, 7, 1000), "Electrodes of the hexagonal pattern."),
    Parameter("membrane.pitch", real(_MEMBRANE.pitch, 1e-4, 0.1, "m"), "Distance of neighbouring electrodes."),
    Parameter(
        "membrane.electrode_diameter", real(_MEMBRANE.electrode_diameter, 1e-4, 0.1, "m"), "Diameter of an electrode."
    ),
    Parameter("membrane.gain_spread", real(_MEMBRANE.gain_spread, 0.0, 0.3), "Standard deviation of relative pulls."),
    Parameter("membrane.drift", real(_MEMBRANE.drift, 0.0, 1e-5, "m"), "Deflection that the zero drifts by."),
    Parameter("membrane.drift_time", real(_MEMBRANE.drift_time, 1.0, 1e7, "s"), "Time of 63 % of that drift."),
    Parameter("membrane.order", whole(_MEMBRANE.order, 12, 60), "Degree of the polynomials of the solution."),
    *INTERFEROMETER,
    Parameter(
        "camera.rate",
        real(_CAMERA.rate, 0.0, 200.0, "Hz"),
        "Images per second of wall time on image_raw; 0 = no camera.",
    ),
    Parameter("camera.width", whole(_CAMERA.width, 16, 2048, "px"), "Image width."),
    Parameter("camera.height", whole(_CAMERA.height, 16, 2048, "px"), "Image height."),
    Parameter("camera.pixel_pitch", real(_CAMERA.pixel_pitch, 1e-7, 1e-3, "m"), "Pixel pitch."),
    Parameter("camera.focal_length", real(_CAMERA.focal_length, 1e-3, 10.0, "m"), "Focal length of the lens."),
    Parameter(
        "camera.rest_distance",
        real(_CAMERA.rest_distance, 0.0, 1e6, "m"),
        "Object distance in focus while the mirror is flat; 0 = infinity.",
    ),
    Parameter(
        "camera.relay_magnification",
        real(_CAMERA.relay_magnification, 0.01, 100.0),
        "Diameter of the beam on the mirror / of the entrance pupil.",
    ),
    Parameter("camera.wavelength", real(_CAMERA.wavelength, 1e-7, 2e-5, "m"), "Wavelength of the images."),
    Parameter(
        "camera.distances",
        reals(list(_CAMERA.distances), 0.0, 1e6, "m"),
        "Distances of the objects, from left to right; 0 = infinity. Their number stays.",
        live=True,
    ),
    Parameter("camera.photons", real(_CAMERA.photons, 1.0, 1e9), "Electrons per pixel at the mean grey level."),
    Parameter("electronics.tcp_port", whole(_PORTS.tcp_port, -1, 65535), f"EDAC40 over TCP {_PORT_TEXT}"),
    Parameter("electronics.udp_port", whole(_PORTS.udp_port, -1, 65535), f"EDAC40 over UDP {_PORT_TEXT}"),
    Parameter("electronics.discovery_port", whole(_PORTS.discovery_port, -1, 65535), f"EDAC40 discovery {_PORT_TEXT}"),
    Parameter(
        "electronics.pty_link",
        text(_PORTS.pty_link),
        "Path of a symbolic link to the pseudo-terminal of the USB DAC-40 or the framed unit; empty = not offered.",
    ),
    Parameter(
        "framed.channels",
        whole(_FRAMED.channels, 0, 4096),
        "Words in a frame of the serial unit; 0 = it is a USB DAC-40.",
    ),
    Parameter("framed.bits", whole(_FRAMED.bits, 1, 16), "Bits of a code of the serial unit."),
    Parameter("framed.header", text(_FRAMED.header), "Bytes before the words, hexadecimal."),
    Parameter("framed.terminator", text(_FRAMED.terminator), "Bytes after the check sum, hexadecimal."),
    Parameter("framed.opening", text(_FRAMED.opening), "Bytes that may come before a frame, hexadecimal."),
    Parameter("framed.reply", text(_FRAMED.reply), "Answer to every frame, hexadecimal."),
    Parameter("framed.channel_order", wholes([], 0, 4095), "Channels in the order of their words."),
    Parameter("framed.word_bits", whole(_FRAMED.word_bits, 0, 32), "Bits of a word; 0 = whole bytes."),
    Parameter("framed.byte_order", text(_FRAMED.byte_order, choices=BYTE_ORDERS), "Order of bytes and bits."),
    Parameter("framed.scale", whole(_FRAMED.scale, -(2**31), 2**31), "word = offset + scale * code."),
    Parameter("framed.offset", whole(_FRAMED.offset, -(2**31), 2**32), "word = offset + scale * code."),
    Parameter("framed.checksum", text(_FRAMED.checksum, choices=tuple(CHECK_LENGTH)), "Check sum."),
    Parameter("framed.checksum_covers_header", switch(_FRAMED.checksum_covers_header), "It counts the header."),
    Parameter("framed.checksum_byte_order", text(_FRAMED.checksum_byte_order, choices=BYTE_ORDERS), "Of two bytes."),
    Parameter("electronics.channels", whole(_DRIVE.channels, 1, 4096), "Channels at the connector."),
    Parameter(
        "electronics.dac_volts_at_zero", real(_DRIVE.dac_volts_at_zero, -100.0, 100.0, "V"), "DAC output at code 0."
    ),
    Parameter(
        "electronics.dac_volts_at_full", real(_DRIVE.dac_volts_at_full, -100.0, 100.0, "V"), "DAC output at full code."
    ),
    Parameter("electronics.amplifier_gain", real(_DRIVE.amplifier_gain, -1e4, 1e4), "Actuator V per DAC V."),
    Parameter("electronics.amplifier_min", real(_DRIVE.amplifier_min, -1e4, 1e4, "V"), "Lowest actuator volts."),
    Parameter("electronics.amplifier_max", real(_DRIVE.amplifier_max, -1e4, 1e4, "V"), "Highest actuator volts."),
    Parameter("volts.min", real(_DRIVE.volts_min, -1e4, 1e4, "V"), "Actuator volts at signal -1."),
    Parameter("volts.max", real(_DRIVE.volts_max, -1e4, 1e4, "V"), "Actuator volts at signal +1."),
    Parameter(
        "wiring", wholes(list(_DRIVE.wiring), 0, 4095), "True connector channel (0-based) of actuators 1, 2, ..."
    ),
    Parameter("monitor.jump", real(_MONITOR.jump, 0.0, 4.0), "Counted: change per frame above this; 0 = off."),
    Parameter(
        "monitor.neighbour_difference",
        real(_MONITOR.neighbour_difference, 0.0, 4.0),
        "Counted: difference of neighbouring signals above this; 0 = off.",
    ),
    Parameter("monitor.signal_min", real(_MONITOR.signal_min, -10.0, 10.0), "Counted: signals below this."),
    Parameter("monitor.signal_max", real(_MONITOR.signal_max, -10.0, 10.0), "Counted: signals above this."),
    Parameter("monitor.tolerance", real(_MONITOR.tolerance, 0.0, 1.0), "Allowance for DAC steps."),
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
