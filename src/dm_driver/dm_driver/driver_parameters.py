"""Parameters of the node `pdm_driver`."""

from __future__ import annotations

import math
from typing import Final

from dm_common.ros.parameters import REQUIRED, Parameter
from dm_driver.electronics import BACK_ENDS
from dm_driver.electronics.check_sums import CHECK_SUMS
from dm_driver.electronics.frame_format import BYTE_ORDERS, MOST_BITS, MOST_WORD_BITS, PARITIES, FrameFormat
from dm_driver.output.volts import LAWS, LINEAR

_FRAME: Final = FrameFormat()

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
    Parameter("electronics.serial_port", str, "", "USB DAC-40, framed_serial: device file, for example /dev/ttyUSB0."),
    Parameter(
        "electronics.await_arrival",
        bool,
        True,
        "EDAC40 over TCP: large ramps go no faster than the unit acknowledges, so that a link that vanishes in a move "
        "leaves at most one step. False = never wait: for a unit that acknowledges late, where speed counts more.",
    ),
    Parameter("electronics.timeout", float, 1.0, "Longest wait for the electronics.", "s", 0.01, 60.0),
    Parameter("framed_serial.channels", int, _FRAME.channels, "Output channels of the unit.", low=1, high=4096),
    Parameter("framed_serial.bits", int, _FRAME.bits, "Bits of a code.", low=1, high=MOST_BITS),
    Parameter("framed_serial.header", str, _FRAME.header, "Bytes before the words, hexadecimal, for example 'A5 5A'."),
    Parameter("framed_serial.terminator", str, _FRAME.terminator, "Bytes after the check sum, hexadecimal."),
    Parameter(
        "framed_serial.channel_order",
        "int[]",
        [],
        "Connector channels, from 0, in the order of their words; empty = 0, 1, 2, ...",
        low=0,
        high=4095,
    ),
    Parameter(
        "framed_serial.word_bits",
        int,
        _FRAME.word_bits,
        "Bits of a word on the wire, no gaps between words; 0 = framed_serial.bits rounded up to whole bytes.",
        low=0,
        high=MOST_WORD_BITS,
    ),
    Parameter(
        "framed_serial.byte_order",
        str,
        _FRAME.byte_order,
        "big: words begin with their most significant bit; little: with their least significant byte and bit.",
        choices=BYTE_ORDERS,
    ),
    Parameter("framed_serial.scale", int, _FRAME.scale, "word = offset + scale * code.", low=-(2**31), high=2**31),
    Parameter(
        "framed_serial.offset",
        int,
        _FRAME.offset,
        "word = offset + scale * code; negative words in two's complement.",
        low=-(2**31),
        high=2**32,
    ),
    Parameter("framed_serial.checksum", str, _FRAME.checksum, "Check sum.", choices=tuple(CHECK_SUMS)),
    Parameter(
        "framed_serial.checksum_covers_header", bool, _FRAME.checksum_covers_header, "The check sum counts the header."
    ),
    Parameter(
        "framed_serial.checksum_byte_order",
        str,
        _FRAME.checksum_byte_order,
        "Of check sums of two bytes.",
        choices=BYTE_ORDERS,
    ),
    Parameter("framed_serial.opening", str, _FRAME.opening, "Bytes sent once after opening, hexadecimal."),
    Parameter(
        "framed_serial.reply",
        str,
        _FRAME.reply,
        "What the unit answers to every frame within electronics.timeout, hexadecimal; empty = it does not answer.",
    ),
    Parameter("framed_serial.baud_rate", int, _FRAME.baud_rate, "Of the line.", "bit/s", 50, 10_000_000),
    Parameter("framed_serial.parity", str, _FRAME.parity, "Parity bit.", choices=PARITIES),
    Parameter("framed_serial.stop_bits", int, _FRAME.stop_bits, "Stop bits.", low=1, high=2),
    Parameter(
        "framed_serial.frame_rate",
        float,
        _FRAME.frame_rate,
        "Most frames per second; 0 = as many as the line carries.",
        "Hz",
        0.0,
        1e6,
    ),
    Parameter("volts.dac_at_zero", float, REQUIRED, "DAC output for code 0 (EDAC40 as delivered: -6).", "V"),
    Parameter("volts.dac_at_full", float, REQUIRED, "DAC output for the full-scale code (EDAC40: +6).", "V"),
    Parameter("volts.amplifier_gain", float, REQUIRED, "Actuator volts per DAC volt (about 80)."),
    Parameter("volts.min", float, REQUIRED, "Actuator voltage for signal -1.", "V"),
    Parameter("volts.max", float, REQUIRED, "Actuator voltage for signal +1.", "V"),
    Parameter(
        "drive.law",
        str,
        LINEAR,
        "What is linear in the signal from volts.min to volts.max: the volts (piezo), or their square (electrostatic "
        "membrane).",
        choices=tuple(LAWS),
    ),
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
