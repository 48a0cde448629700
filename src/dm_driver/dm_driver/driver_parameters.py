"""Parameters of the node `pdm_driver`."""

from __future__ import annotations

import math
from typing import Final

from dm_driver.electronics import BACK_ENDS
from dm_runtime.parameters import REQUIRED, Parameter

PARAMETERS: Final = (
    Parameter("autostart", bool, True, "Configure and activate by itself after the start."),
    Parameter("frame_id", str, "mirror", "Name of the mirror surface frame (x right, y up)."),
    Parameter("state_period", float, 0.5, "Time between periodic actuator_state messages.", "s", 0.02, 60.0),
    Parameter("mirror.name", str, "PDM30-37", "Model of the mirror."),
    Parameter("mirror.serial", str, REQUIRED, "Serial number; calibrations belong to one."),
    Parameter("mirror.actuators", int, 37, "Number of actuators.", low=1, high=4096),
    Parameter(
        "mirror.wiring", str, "trihex", "Wiring table: trihex, 37ch_30mm, 37ch_30mm_v2005, or custom (mirror.channels)."
    ),
    Parameter(
        "mirror.channels",
        "int[]",
        [],
        "For the wiring 'custom': connector channel of actuator 1, 2, ..., from 0; -1 = no channel.",
        low=-1,
        high=4095,
    ),
    Parameter("mirror.actuator_x", "float[]", [], "Actuator positions, x; empty = hexagonal pattern.", "m", -1.0, 1.0),
    Parameter("mirror.actuator_y", "float[]", [], "Actuator positions, y; empty = hexagonal pattern.", "m", -1.0, 1.0),
    Parameter("mirror.pitch", float, 4.3e-3, "Hexagonal pattern: distance of neighbours.", "m", 1e-5, 1.0),
    Parameter(
        "mirror.start_angle",
        float,
        0.0,
        "Hexagonal pattern: direction of the first actuator of every ring, counter-clockwise from x.",
        "rad",
        -2 * math.pi,
        2 * math.pi,
    ),
    Parameter("mirror.clockwise", bool, False, "Hexagonal pattern: numbers rise clockwise."),
    Parameter("mirror.reflected", bool, False, "Hexagonal pattern: mirrored left-right."),
    Parameter("mirror.full_aperture_diameter", float, 0.030, "Diameter of the mirror.", "m", 1e-4, 10.0),
    Parameter("mirror.working_aperture_diameter", float, 0.022, "Diameter to be used.", "m", 1e-4, 10.0),
    Parameter("electronics.kind", str, REQUIRED, "Drive electronics.", choices=tuple(BACK_ENDS)),
    Parameter("electronics.address", str, "", "EDAC40: host name or IPv4 address."),
    Parameter("electronics.port", int, 1234, "EDAC40: TCP or UDP port.", low=1, high=65535),
    Parameter(
        "electronics.discovery_port",
        int,
        0,
        "EDAC40 over UDP: port of the discovery (30303 on real units) to check the link with; 0 = not checked.",
        low=0,
        high=65535,
    ),
    Parameter("electronics.serial_port", str, "", "USB DAC-40: device file, for example /dev/ttyUSB0."),
    Parameter("electronics.timeout", float, 1.0, "Longest wait for the electronics.", "s", 0.01, 60.0),
    Parameter("volts.dac_at_zero", float, REQUIRED, "DAC output for code 0 (EDAC40 as delivered: -6).", "V"),
    Parameter("volts.dac_at_full", float, REQUIRED, "DAC output for the full-scale code (EDAC40: +6).", "V"),
    Parameter("volts.amplifier_gain", float, REQUIRED, "Actuator volts per DAC volt (about 80)."),
    Parameter("volts.min", float, REQUIRED, "Actuator voltage for signal -1.", "V"),
    Parameter("volts.max", float, REQUIRED, "Actuator voltage for signal +1.", "V"),
    Parameter("limits.signal_min", float, -1.0, "Lowest signal.", low=-1.0, high=1.0),
    Parameter("limits.signal_max", float, 1.0, "Highest signal.", low=-1.0, high=1.0),
    Parameter(
        "limits.neighbour_difference", float, 1.0, "Largest difference of neighbouring signals.", low=1e-6, high=2.0
    ),
    Parameter("limits.slew_rate", float, 40.0, "Largest rate of change of a signal.", "1/s", 1e-3, 1e6),
    Parameter("limits.step", float, 0.1, "Largest change of a signal in one write.", low=1e-4, high=2.0),
    Parameter("limits.command_age", float, 1.0, "Commands with an older stamp are refused.", "s", 1e-3, 1e9),
    Parameter("limits.command_lead", float, 0.5, "Commands stamped further ahead are refused.", "s", 1e-3, 1e9),
    Parameter("limits.watchdog", float, 0.0, "Without a command for this long: safe shape; 0 = never.", "s", 0.0, 1e6),
    Parameter(
        "state_folder",
        str,
        "~/.ros/dm_driver",
        "Folder that keeps what was last sent to each unit: a driver that was killed goes on from there in steps. "
        "Empty = keep nothing.",
    ),
    Parameter("safe_signals", "float[]", [], "The safe shape; empty = all -1 (volts.min).", low=-1.0, high=1.0),
    Parameter("degauss.steps", int, 100, "Half-swings of a degauss.", low=1, high=10000),
)
