"""Parameters of the node `focus_controller`."""

from __future__ import annotations

from typing import Final

from dm_common.ros.parameters import APERTURE_PARAMETER, Parameter, real, switch, text, whole
from dm_controller.creep_hold import PERIOD_S
from dm_controller.focus_actions import LOOP_PARAMETERS
from dm_controller.planning.planner import SETTLE_S

PARAMETERS: Final = (
    Parameter(
        "reachable_tolerance",
        real(2e-8, 1e-10, 1e-5, "m"),
        "largest predicted Zernike coefficient error at which a curvature still counts as reachable",
        live=True,
    ),
    Parameter("request_age", real(1.0, 0.0, 3600.0, "s"), "focus requests with an older stamp are refused; 0 = never"),
    Parameter(
        "settle_time",
        real(SETTLE_S, 0.0, 60.0, "s"),
        "wait after the last write before a MoveFocus goal succeeds, and when a shape is to be right",
    ),
    Parameter("move_timeout", real(10.0, 0.1, 600.0, "s"), "longest time a move may take"),
    Parameter(
        "driver_timeout",
        real(3.0, 0.0, 600.0, "s"),
        "silence of pdm_driver after which requests are refused, and longest wait until it confirms a command; longer "
        "than its state_period; 0 = never",
        live=True,
    ),
    Parameter(
        "time_budget",
        real(0.0, 0.0, 3600.0, "s"),
        "time in which AUTO may condition the mirror, for requests that name none; 0 = never by itself",
        live=True,
    ),
    Parameter(
        "condition.degauss_steps",
        whole(0, 0, 10000),
        "half-swings of the degauss that conditions; 0 = as the recipes were built, without recipes as the driver does",
        live=True,
    ),
    Parameter("condition.timeout", real(180.0, 0.1, 3600.0, "s"), "longest wait for that degauss", live=True),
    Parameter("hold.enable", switch(True), "correct a shape for creep while it is held", live=True),
    Parameter("hold.period", real(PERIOD_S, 0.01, 3600.0, "s"), "shortest time between two corrections"),
    Parameter(
        "hold.tolerance",
        real(2e-10, 1e-12, 1e-6, "m"),
        "predicted Zernike coefficient error from which a held shape is corrected",
        live=True,
    ),
    Parameter(
        "hold.slew", real(0.02, 1e-5, 2.0), "largest change of a signal in one correction, normalised", live=True
    ),
    Parameter(
        "hold.resolution",
        real(3.0518e-5, 0.0, 0.1),
        "step of the electronics, normalised (16 bit over the range: 2/65535); less than half of it is not corrected",
        live=True,
    ),
    Parameter(
        "calibration_age_max",
        real(2_592_000.0, 0.0, 1e9, "s"),
        "age from which a calibration that no map has confirmed is called stale; it is still used; 0 = never",
        live=True,
    ),
    Parameter(
        "state_folder",
        text("~/.ros/focus_controller"),
        "folder that keeps what the actuators of each mirror have crept to, for the next start; empty = keep nothing",
    ),
    Parameter(
        "hold_tilt",
        switch(True),
        "keep the mirror's tilt while its curvature changes, so that the picture of a camera stands still; "
        "false = tilt is free",
    ),
    APERTURE_PARAMETER,
    *LOOP_PARAMETERS,
)
