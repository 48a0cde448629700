"""Parameters of the node `pdm_driver`."""

import math
from typing import Final

from dm_common.ros.parameters import (
    AUTOSTART,
    REQUIRED,
    Parameter,
    fields_of,
    live,
    real,
    reals,
    switch,
    text,
    whole,
    wholes,
)
from dm_driver.degauss import STEPS_MAX
from dm_driver.electronics import BACK_ENDS
from dm_driver.electronics.check_sums import CHECK_SUMS
from dm_driver.electronics.frame_format import BYTE_ORDERS, MOST_BITS, MOST_WORD_BITS, PARITIES, FrameFormat
from dm_driver.output.volts import LAWS, LINEAR

_frame = fields_of("framed_serial", FrameFormat())

PARAMETERS: Final = (
    AUTOSTART,
    Parameter(
        "frame_id",
        text(""),
        "Mirror surface frame (x right, y up); empty = mirror, behind the namespace where there is one.",
    ),
    Parameter("state_period", real(0.5, 0.02, 60.0, "s"), "Time between periodic actuator_state messages."),
    Parameter("mirror.name", text("PDM30-37"), "Model of the mirror."),
    Parameter("mirror.serial", text(REQUIRED), "Serial number; calibrations belong to one."),
    Parameter("mirror.actuators", whole(37, 1, 4096), "Number of actuators."),
    Parameter(
        "mirror.wiring",
        text("trihex"),
        "Wiring table: trihex, 37ch_30mm, 37ch_30mm_v2005, or custom (mirror.channels).",
    ),
    Parameter(
        "mirror.channels",
        wholes([], -1, 4095),
        "For the wiring 'custom': connector channel of actuator 1, 2, ..., from 0; -1 = no channel.",
    ),
    Parameter("mirror.actuator_x", reals([], -1.0, 1.0, "m"), "Actuator positions, x; empty = hexagonal pattern."),
    Parameter("mirror.actuator_y", reals([], -1.0, 1.0, "m"), "Actuator positions, y; empty = hexagonal pattern."),
    Parameter("mirror.pitch", real(4.3e-3, 1e-5, 1.0, "m"), "Hexagonal pattern: distance of neighbours."),
    Parameter(
        "mirror.start_angle",
        real(0.0, -2 * math.pi, 2 * math.pi, "rad"),
        "Hexagonal pattern: direction of the first actuator of every ring, counter-clockwise from x.",
    ),
    Parameter("mirror.clockwise", switch(False), "Hexagonal pattern: numbers rise clockwise."),
    Parameter("mirror.reflected", switch(False), "Hexagonal pattern: mirrored left-right."),
    Parameter("mirror.full_aperture_diameter", real(0.030, 1e-4, 10.0, "m"), "Diameter of the mirror."),
    Parameter("mirror.working_aperture_diameter", real(0.022, 1e-4, 10.0, "m"), "Diameter to be used."),
    Parameter("electronics.kind", text(REQUIRED, choices=tuple(BACK_ENDS)), "Drive electronics."),
    Parameter(
        "electronics.address",
        text(""),
        "EDAC40: host name or IPv4 address. microscope: URI of the mirror on the device server of python-microscope, "
        "such as PYRO:Mirao52e@127.0.0.1:8000.",
    ),
    Parameter("electronics.port", whole(1234, 1, 65535), "EDAC40: TCP or UDP port."),
    Parameter(
        "electronics.discovery_port",
        whole(0, 0, 65535),
        "EDAC40 over UDP: port of the discovery (30303 on real units) to check the link with; 0 = not checked.",
    ),
    Parameter("electronics.serial_port", text(""), "USB DAC-40, framed_serial: device file, for example /dev/ttyUSB0."),
    Parameter(
        "electronics.await_arrival",
        switch(True),
        "EDAC40 over TCP: large ramps go no faster than the unit acknowledges, so that a link that vanishes in a move "
        "leaves at most one step. False = never wait: for a unit that acknowledges late, where speed counts more.",
    ),
    Parameter("electronics.timeout", real(1.0, 0.01, 60.0, "s"), "Longest wait for the electronics."),
    _frame("channels", whole(..., 1, 4096), "Output channels of the unit."),
    _frame("bits", whole(..., 1, MOST_BITS), "Bits of a code."),
    _frame("header", text(...), "Bytes before the words, hexadecimal, for example 'A5 5A'."),
    _frame("terminator", text(...), "Bytes after the check sum, hexadecimal."),
    Parameter(
        "framed_serial.channel_order",
        wholes([], 0, 4095),
        "Connector channels, from 0, in the order of their words; empty = 0, 1, 2, ...",
    ),
    _frame(
        "word_bits",
        whole(..., 0, MOST_WORD_BITS),
        "Bits of a word on the wire, no gaps between words; 0 = framed_serial.bits rounded up to whole bytes.",
    ),
    _frame(
        "byte_order",
        text(..., choices=BYTE_ORDERS),
        "big: words begin with their most significant bit; little: with their least significant byte and bit.",
    ),
    _frame("scale", whole(..., -(2**31), 2**31), "word = offset + scale * code."),
    _frame("offset", whole(..., -(2**31), 2**32), "word = offset + scale * code; negative words in two's complement."),
    _frame("checksum", text(..., choices=tuple(CHECK_SUMS)), "Check sum."),
    _frame("checksum_covers_header", switch(...), "The check sum counts the header."),
    _frame("checksum_byte_order", text(..., choices=BYTE_ORDERS), "Of check sums of two bytes."),
    _frame("opening", text(...), "Bytes sent once after opening, hexadecimal."),
    _frame(
        "reply",
        text(...),
        "What the unit answers to every frame within electronics.timeout, hexadecimal; empty = it does not answer.",
    ),
    _frame("baud_rate", whole(..., 50, 10_000_000, "bit/s"), "Of the line."),
    _frame("parity", text(..., choices=PARITIES), "Parity bit."),
    _frame("stop_bits", whole(..., 1, 2), "Stop bits."),
    _frame("frame_rate", real(..., 0.0, 1e6, "Hz"), "Most frames per second; 0 = as many as the line carries."),
    Parameter("volts.dac_at_zero", real(REQUIRED, unit="V"), "DAC output for code 0 (EDAC40 as delivered: -6)."),
    Parameter("volts.dac_at_full", real(REQUIRED, unit="V"), "DAC output for the full-scale code (EDAC40: +6)."),
    Parameter("volts.amplifier_gain", real(REQUIRED), "Actuator volts per DAC volt (about 80)."),
    Parameter("volts.min", real(REQUIRED, unit="V"), "Actuator voltage for signal -1."),
    Parameter("volts.max", real(REQUIRED, unit="V"), "Actuator voltage for signal +1."),
    Parameter(
        "drive.law",
        text(LINEAR, choices=tuple(LAWS)),
        "What is linear in the signal from volts.min to volts.max: the volts (piezo), or their square (electrostatic "
        "membrane).",
    ),
    Parameter("limits.signal_min", real(-1.0, -1.0, 1.0), "Lowest signal."),
    Parameter("limits.signal_max", real(1.0, -1.0, 1.0), "Highest signal."),
    Parameter("limits.neighbour_difference", real(1.0, 1e-6, 2.0), "Largest difference of neighbouring signals."),
    Parameter("limits.slew_rate", real(40.0, 1e-3, 1e6, "1/s"), "Largest rate of change of a signal."),
    Parameter("limits.step", real(0.1, 1e-4, 2.0), "Largest change of a signal in one write."),
    Parameter("limits.command_age", real(1.0, 1e-3, 1e9, "s"), "Commands with an older stamp are refused."),
    Parameter("limits.command_lead", real(0.5, 1e-3, 1e9, "s"), "Commands stamped further ahead are refused."),
    Parameter("limits.watchdog", real(0.0, 0.0, 1e6, "s"), "Without a command for this long: safe shape; 0 = never."),
    Parameter(
        "state_folder",
        text("~/.ros/dm_driver"),
        "Folder that keeps what was last sent to each unit: a driver that was killed goes on from there in steps. "
        "Empty = keep nothing.",
    ),
    Parameter("safe_signals", reals([], -1.0, 1.0), "The safe shape; empty = all -1 (volts.min)."),
    Parameter("degauss.steps", whole(100, 1, STEPS_MAX), "Half-swings of a degauss."),
    live(
        "degauss.duration_max",
        real(180.0, 1.0, 3600.0, "s"),
        "Longest degauss: goals that would take longer are refused.",
    ),
)
