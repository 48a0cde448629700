"""Parameters of the node `pdm_driver`."""

import math
from typing import Final

from dm_common.limits import DEGAUSS_STEPS_MAX, DEGAUSS_STEPS_MIN
from dm_common.ros.parameters import AUTOSTART, REQUIRED, Parameter, live, parameters_of
from dm_common.values import real, reals, switch, text, whole, wholes
from dm_driver.electronics import BACK_ENDS
from dm_driver.electronics.base import ElectronicsSettings
from dm_driver.electronics.frame_format import FrameFormat
from dm_driver.output.volts import LAWS, LINEAR
from dm_driver.safety_limiter import DriverLimits

PARAMETERS: Final = (
    AUTOSTART,
    Parameter(
        "frame_id",
        text(""),
        "Mirror surface frame (x right, y up); empty = mirror, preceded by the namespace if there is one.",
    ),
    Parameter("state_period", real(0.5, 0.02, 60.0, "s"), "Time between periodic actuator_state messages."),
    Parameter("mirror.name", text("PDM30-37"), "Model of the mirror."),
    Parameter("mirror.serial", text(REQUIRED), "Serial number; calibrations of another serial number are refused."),
    Parameter("mirror.actuators", whole(37, 1, 4096), "Number of actuators."),
    Parameter(
        "mirror.wiring",
        text("trihex"),
        "Wiring table: trihex, 37ch_30mm, 37ch_30mm_v2005, or custom (mirror.channels).",
    ),
    Parameter(
        "mirror.channels",
        wholes([], -1, 4095),
        "Wiring 'custom': connector channels (from 0) of actuators 1, 2, ...; -1 = no channel.",
    ),
    Parameter("mirror.actuator_x", reals([], -1.0, 1.0, "m"), "Actuator positions, x; empty = hexagonal pattern."),
    Parameter("mirror.actuator_y", reals([], -1.0, 1.0, "m"), "Actuator positions, y; empty = hexagonal pattern."),
    Parameter("mirror.pitch", real(4.3e-3, 1e-5, 1.0, "m"), "Hexagonal pattern: distance between neighbours."),
    Parameter(
        "mirror.start_angle",
        real(0.0, -2 * math.pi, 2 * math.pi, "rad"),
        "Hexagonal pattern: direction of the first actuator of every ring, counter-clockwise from x.",
    ),
    Parameter("mirror.clockwise", switch(False), "Hexagonal pattern: actuators are numbered clockwise."),
    Parameter("mirror.reflected", switch(False), "Hexagonal pattern: mirrored left-right."),
    Parameter("mirror.full_aperture_diameter", real(0.030, 1e-4, 10.0, "m"), "Diameter of the mirror."),
    Parameter("mirror.working_aperture_diameter", real(0.022, 1e-4, 10.0, "m"), "Diameter of the part in use."),
    Parameter("electronics.kind", text(REQUIRED, choices=tuple(BACK_ENDS)), "Drive electronics."),
    *parameters_of("electronics.", ElectronicsSettings),
    Parameter(
        "electronics.await_arrival",
        switch(True),
        "EDAC40 over TCP: large ramps wait for acknowledgements, so that a link lost in a move leaves the outputs "
        "within one step of the last frame. False = never wait, for units that acknowledge late if speed matters more.",
    ),
    Parameter(
        "electronics.timeout",
        real(1.0, 0.01, 60.0, "s"),
        "Longest wait for the electronics, except for a TCP connection to be established (5 s).",
    ),
    *parameters_of("framed_serial.", FrameFormat),
    Parameter("volts.dac_at_zero", real(REQUIRED, unit="V"), "DAC output for code 0 (EDAC40 as delivered: -6)."),
    Parameter("volts.dac_at_full", real(REQUIRED, unit="V"), "DAC output for the full-scale code (EDAC40: +6)."),
    Parameter("volts.amplifier_gain", real(REQUIRED), "Actuator volts per DAC volt (about 80)."),
    Parameter("volts.min", real(REQUIRED, unit="V"), "Actuator voltage for signal -1."),
    Parameter("volts.max", real(REQUIRED, unit="V"), "Actuator voltage for signal +1."),
    Parameter(
        "drive.law",
        text(LINEAR, choices=tuple(LAWS)),
        "Quantity that is linear in the signal, from volts.min to volts.max: the voltage (piezo), or its square "
        "(electrostatic membrane).",
    ),
    Parameter("limits.signal_min", real(-1.0, -1.0, 1.0), "Lowest signal."),
    Parameter("limits.signal_max", real(1.0, -1.0, 1.0), "Highest signal."),
    Parameter("limits.neighbour_difference", real(1.0, 1e-6, 2.0), "Largest difference of neighbouring signals."),
    *parameters_of("limits.", DriverLimits),
    Parameter("limits.watchdog", real(0.0, 0.0, 1e6, "s"), "Time without commands until the safe shape; 0 = never."),
    Parameter(
        "state_folder",
        text("~/.ros/dm_driver", path=True),
        "Folder for a record of what was last sent to each unit, from which a driver continues in steps after it was "
        "killed; $ROS_HOME replaces ~/.ros if it is set. Empty = keep no record.",
    ),
    Parameter(
        "safe_signals",
        reals([], -1.0, 1.0),
        "The safe shape; empty = all at 0 V, or as near to it as volts.* and limits.signal_* allow.",
    ),
    Parameter("degauss.steps", whole(100, DEGAUSS_STEPS_MIN, DEGAUSS_STEPS_MAX), "Half-swings of a degauss."),
    live(
        "degauss.duration_max",
        real(180.0, 1.0, 3600.0, "s"),
        "Longest degauss: goals that would take longer are refused.",
    ),
)
