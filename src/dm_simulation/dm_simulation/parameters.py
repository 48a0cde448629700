"""Parameters of the node `virtual_bench`, and the bench configuration made of their values."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dm_common.ros.parameters import Parameter
from dm_simulation.bench import BenchConfig, FilesConfig
from dm_simulation.camera import CameraConfig
from dm_simulation.electronics.drive_unit import DriveConfig
from dm_simulation.electronics.framed_unit import BYTE_ORDERS, CHECK_LENGTH, FramedConfig
from dm_simulation.electronics.monitor import MonitorConfig
from dm_simulation.electronics.server import PortsConfig
from dm_simulation.interferometer.interferometer import InterferometerConfig
from dm_simulation.interferometer.zygo_files import FORMATS, UNITS
from dm_simulation.mirror.hysteresis import LAWS
from dm_simulation.mirror.piezo import PiezoConfig
from dm_simulation.mirror.plate import PlateConfig

_PLATE = PlateConfig()
_PIEZO = PiezoConfig()
_INSTRUMENT = InterferometerConfig()
_CAMERA = CameraConfig()
_DRIVE = DriveConfig()
_PORTS = PortsConfig()
_MONITOR = MonitorConfig()
_FILES = FilesConfig()
_FRAMED = FramedConfig()
_PORT_TEXT = "on 127.0.0.1; 0 = any free port, -1 = not offered."

PARAMETERS = (
    Parameter("seed", int, 1, "Fixes gains, initial figure and noise.", low=0, high=2**31),
    Parameter("mirror.name", str, _FILES.part_name, "Model of the mirror, as map files name it."),
    Parameter("plate.diameter", float, _PLATE.diameter, "Diameter of the faceplate.", "m", 1e-3, 1.0),
    Parameter("plate.thickness", float, _PLATE.thickness, "Thickness of the faceplate.", "m", 1e-5, 0.1),
    Parameter("plate.youngs_modulus", float, _PLATE.youngs_modulus, "Young's modulus.", "Pa", 1e6, 1e13),
    Parameter("plate.poisson_ratio", float, _PLATE.poisson_ratio, "Poisson's ratio.", "", 0.0, 0.49),
    Parameter("plate.spring_stiffness", float, _PLATE.spring_stiffness, "Stiffness of one stack.", "N/m", 1.0, 1e12),
    Parameter("plate.actuators", int, _PLATE.actuators, "Actuators of the hexagonal pattern.", "", 7, 1000),
    Parameter("plate.pitch", float, _PLATE.pitch, "Distance of neighbouring actuators.", "m", 1e-4, 0.1),
    Parameter("plate.start_angle", float, _PLATE.start_angle, "Angle of actuator 2 from the x axis.", "rad", -7.0, 7.0),
    Parameter("plate.clockwise", bool, _PLATE.clockwise, "Whether actuators are numbered clockwise in their rings."),
    Parameter("plate.order", int, _PLATE.order, "Radial order of the Ritz solution.", low=12, high=60),
    Parameter(
        "plate.actuator_x", "float[]", [], "Actuator positions, x, in place of the hexagonal pattern.", "m", -1.0, 1.0
    ),
    Parameter(
        "plate.actuator_y", "float[]", [], "Actuator positions, y, in place of the hexagonal pattern.", "m", -1.0, 1.0
    ),
    Parameter("piezo.stroke", float, _PIEZO.stroke, "Stroke of a stack from signal -1 to +1.", "m", 0.0, 1e-3),
    Parameter("piezo.gain_spread", float, _PIEZO.gain_spread, "Standard deviation of relative gains.", "", 0.0, 0.3),
    Parameter("piezo.law", str, _PIEZO.law, "Hysteresis law.", choices=LAWS),
    Parameter("piezo.hysteresis", float, _PIEZO.hysteresis, "Widest loop opening over the full stroke.", "", 0.0, 0.3),
    Parameter("piezo.creep", float, _PIEZO.creep, "Creep of a step per decade of time.", "", 0.0, 0.1),
    Parameter("interferometer.pixels", int, _INSTRUMENT.pixels, "Pixels along each side.", "px", 32, 4096),
    Parameter(
        "interferometer.field_diameter",
        float,
        _INSTRUMENT.field_diameter,
        "Diameter of the field of view.",
        "m",
        1e-3,
        1.0,
    ),
    Parameter("interferometer.wavelength", float, _INSTRUMENT.wavelength, "Wavelength.", "m", 1e-7, 2e-5),
    Parameter("interferometer.figure_rms", float, _INSTRUMENT.figure_rms, "Initial figure, rms.", "m", 0.0, 1e-5),
    Parameter("interferometer.pixel_noise", float, _INSTRUMENT.pixel_noise, "Noise per pixel, rms.", "m", 0.0, 1e-6),
    Parameter(
        "interferometer.low_order_noise",
        float,
        _INSTRUMENT.low_order_noise,
        "Noise of all Zernike terms of orders 2-5 together, rms over the field.",
        "m",
        0.0,
        1e-6,
    ),
    Parameter("interferometer.piston_spread", float, _INSTRUMENT.piston_spread, "Spread of piston.", "m", 0.0, 1e-4),
    Parameter(
        "interferometer.tilt_spread", float, _INSTRUMENT.tilt_spread, "Spread of edge sag by tilt.", "m", 0.0, 1e-4
    ),
    Parameter("interferometer.specks", int, _INSTRUMENT.specks, "Mean number of dropped pixels.", "", 0, 1_000_000),
    Parameter("interferometer.blobs", int, _INSTRUMENT.blobs, "Dropped discs per map.", "", 0, 1000),
    Parameter("interferometer.flip_x", bool, _INSTRUMENT.flip_x, "Picture mirrored left-right, after turning."),
    Parameter("interferometer.flip_y", bool, _INSTRUMENT.flip_y, "Picture mirrored upside down, after turning."),
    Parameter(
        "interferometer.rotate_deg",
        int,
        _INSTRUMENT.rotate_deg,
        "Picture turned anticlockwise by 0, 90, 180 or 270.",
        "deg",
        0,
        270,
    ),
    Parameter(
        "camera.rate",
        float,
        _CAMERA.rate,
        "Images per second of wall time on image_raw; 0 = no camera.",
        "Hz",
        0.0,
        200.0,
    ),
    Parameter("camera.width", int, _CAMERA.width, "Image width.", "px", 16, 2048),
    Parameter("camera.height", int, _CAMERA.height, "Image height.", "px", 16, 2048),
    Parameter("camera.pixel_pitch", float, _CAMERA.pixel_pitch, "Pixel pitch.", "m", 1e-7, 1e-3),
    Parameter("camera.focal_length", float, _CAMERA.focal_length, "Focal length of the lens.", "m", 1e-3, 10.0),
    Parameter(
        "camera.rest_distance",
        float,
        _CAMERA.rest_distance,
        "Object distance in focus while the mirror is flat; 0 = infinity.",
        "m",
        0.0,
        1e6,
    ),
    Parameter(
        "camera.relay_magnification",
        float,
        _CAMERA.relay_magnification,
        "Diameter of the beam on the mirror / of the entrance pupil.",
        "",
        0.01,
        100.0,
    ),
    Parameter("camera.wavelength", float, _CAMERA.wavelength, "Wavelength of the images.", "m", 1e-7, 2e-5),
    Parameter(
        "camera.distances",
        "float[]",
        list(_CAMERA.distances),
        "Distances of the objects, from left to right; 0 = infinity.",
        "m",
        0.0,
        1e6,
    ),
    Parameter("camera.photons", float, _CAMERA.photons, "Electrons per pixel at the mean grey level.", "", 1.0, 1e9),
    Parameter("electronics.tcp_port", int, _PORTS.tcp_port, f"EDAC40 over TCP {_PORT_TEXT}", low=-1, high=65535),
    Parameter("electronics.udp_port", int, _PORTS.udp_port, f"EDAC40 over UDP {_PORT_TEXT}", low=-1, high=65535),
    Parameter(
        "electronics.discovery_port",
        int,
        _PORTS.discovery_port,
        f"EDAC40 discovery {_PORT_TEXT}",
        low=-1,
        high=65535,
    ),
    Parameter(
        "electronics.pty_link",
        str,
        _PORTS.pty_link,
        "Path of a symbolic link to the pseudo-terminal of the USB DAC-40 or the framed unit; empty = not offered.",
    ),
    Parameter(
        "framed.channels",
        int,
        _FRAMED.channels,
        "Words in a frame of the serial unit; 0 = it is a USB DAC-40.",
        "",
        0,
        4096,
    ),
    Parameter("framed.bits", int, _FRAMED.bits, "Bits of a code of the serial unit.", "", 1, 16),
    Parameter("framed.header", str, _FRAMED.header, "Bytes before the words, hexadecimal."),
    Parameter("framed.terminator", str, _FRAMED.terminator, "Bytes after the check sum, hexadecimal."),
    Parameter("framed.opening", str, _FRAMED.opening, "Bytes that may come before a frame, hexadecimal."),
    Parameter("framed.reply", str, _FRAMED.reply, "Answer to every frame, hexadecimal."),
    Parameter("framed.channel_order", "int[]", [], "Channels in the order of their words.", "", 0, 4095),
    Parameter("framed.word_bits", int, _FRAMED.word_bits, "Bits of a word; 0 = whole bytes.", "", 0, 32),
    Parameter("framed.byte_order", str, _FRAMED.byte_order, "Order of bytes and bits.", choices=BYTE_ORDERS),
    Parameter("framed.scale", int, _FRAMED.scale, "word = offset + scale * code.", "", -(2**31), 2**31),
    Parameter("framed.offset", int, _FRAMED.offset, "word = offset + scale * code.", "", -(2**31), 2**32),
    Parameter("framed.checksum", str, _FRAMED.checksum, "Check sum.", choices=tuple(CHECK_LENGTH)),
    Parameter("framed.checksum_covers_header", bool, _FRAMED.checksum_covers_header, "It counts the header."),
    Parameter("framed.checksum_byte_order", str, _FRAMED.checksum_byte_order, "Of two bytes.", choices=BYTE_ORDERS),
    Parameter("electronics.channels", int, _DRIVE.channels, "Channels at the connector.", "", 1, 4096),
    Parameter(
        "electronics.dac_volts_at_zero", float, _DRIVE.dac_volts_at_zero, "DAC output at code 0.", "V", -100.0, 100.0
    ),
    Parameter(
        "electronics.dac_volts_at_full", float, _DRIVE.dac_volts_at_full, "DAC output at full code.", "V", -100.0, 100.0
    ),
    Parameter("electronics.amplifier_gain", float, _DRIVE.amplifier_gain, "Actuator V per DAC V.", "", -1e4, 1e4),
    Parameter("electronics.amplifier_min", float, _DRIVE.amplifier_min, "Lowest actuator volts.", "V", -1e4, 1e4),
    Parameter("electronics.amplifier_max", float, _DRIVE.amplifier_max, "Highest actuator volts.", "V", -1e4, 1e4),
    Parameter("volts.min", float, _DRIVE.volts_min, "Actuator volts at signal -1.", "V", -1e4, 1e4),
    Parameter("volts.max", float, _DRIVE.volts_max, "Actuator volts at signal +1.", "V", -1e4, 1e4),
    Parameter(
        "wiring", "int[]", list(_DRIVE.wiring), "True connector channel (0-based) of actuators 1, 2, ...", "", 0, 4095
    ),
    Parameter("monitor.jump", float, _MONITOR.jump, "Counted: change per frame above this; 0 = off.", "", 0.0, 4.0),
    Parameter(
        "monitor.neighbour_difference",
        float,
        _MONITOR.neighbour_difference,
        "Counted: difference of neighbouring signals above this; 0 = off.",
        "",
        0.0,
        4.0,
    ),
    Parameter("monitor.signal_min", float, _MONITOR.signal_min, "Counted: signals below this.", "", -10.0, 10.0),
    Parameter("monitor.signal_max", float, _MONITOR.signal_max, "Counted: signals above this.", "", -10.0, 10.0),
    Parameter("monitor.tolerance", float, _MONITOR.tolerance, "Allowance for DAC steps.", "", 0.0, 1.0),
    Parameter("trigger.port", int, 1235, f"Trigger {_PORT_TEXT}", low=-1, high=65535),
    Parameter(
        "output_folder", str, str(Path(tempfile.gettempdir()) / "virtual_bench"), "Folder of maps without a given path."
    ),
    Parameter("output_format", str, _FILES.format, "Format of maps without a given path.", choices=FORMATS),
    Parameter("output_datx_unit", str, _FILES.datx_unit, "Unit of the heights in .datx files.", choices=UNITS),
    Parameter("output_intensity", bool, _FILES.intensity, "Whether .dat files have an intensity frame."),
    Parameter(
        "output_slow_write",
        float,
        _FILES.slow_write,
        "Wall time over which a file grows; 0 = it appears whole.",
        "s",
        0.0,
        60.0,
    ),
    Parameter(
        "clock.speed",
        float,
        0.0,
        "Publish /clock at this multiple of the wall clock, and live by it; 0 = no /clock, the node's own time.",
        "",
        0.0,
        1e4,
    ),
    Parameter("clock.period", float, 0.002, "Wall time between two messages on /clock.", "s", 1e-4, 1.0),
)


def bench_config(values: Mapping[str, Any]) -> BenchConfig:
    """The configuration for the values of all parameters of PARAMETERS."""

    def group(prefix: str) -> dict[str, Any]:
        return {name.partition(".")[2]: value for name, value in values.items() if name.startswith(prefix + ".")}

    electronics = group("electronics")
    ports = {name: electronics.pop(name) for name in ("tcp_port", "udp_port", "discovery_port", "pty_link")}
    if ports["pty_link"]:
        ports["pty_link"] = str(Path(ports["pty_link"]).expanduser())
    return BenchConfig(
        seed=values["seed"],
        plate=PlateConfig(
            **group("plate") | {name: tuple(values[f"plate.{name}"]) for name in ("actuator_x", "actuator_y")}
        ),
        piezo=PiezoConfig(**group("piezo")),
        interferometer=InterferometerConfig(**group("interferometer")),
        camera=CameraConfig(**group("camera") | {"distances": tuple(values["camera.distances"])}),
        drive=DriveConfig(
            **electronics,
            volts_min=values["volts.min"],
            volts_max=values["volts.max"],
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
            part_name=values["mirror.name"],
        ),
        trigger_port=values["trigger.port"],
    )
