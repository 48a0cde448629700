"""Parameters of the node `focus_controller`."""

from __future__ import annotations

from typing import Final

from dm_common.mirror import APERTURE_TOLERANCE
from dm_common.ros.parameters import Parameter
from dm_controller.creep_hold import PERIOD_S
from dm_controller.focus_actions import LOOP_PARAMETERS
from dm_controller.planning.planner import SETTLE_S

PARAMETERS: Final = (
    Parameter(
        "reachable_tolerance",
        float,
        2e-8,
        "largest predicted Zernike coefficient error at which a curvature still counts as reachable",
        "m",
        1e-10,
        1e-5,
        live=True,
    ),
    Parameter("request_age", float, 1.0, "focus requests with an older stamp are refused; 0 = never", "s", 0.0, 3600.0),
    Parameter(
        "settle_time",
        float,
        SETTLE_S,
        "wait after the last write before a MoveFocus goal succeeds, and when a shape is to be right",
        "s",
        0.0,
        60.0,
    ),
    Parameter("move_timeout", float, 10.0, "longest time a move may take", "s", 0.1, 600.0),
    Parameter(
        "driver_timeout",
        float,
        3.0,
        "silence of pdm_driver after which requests are refused, and longest wait until it confirms a command; longer "
        "than its state_period; 0 = never",
        "s",
        0.0,
        600.0,
        live=True,
    ),
    Parameter(
        "time_budget",
        float,
        0.0,
        "time in which AUTO may condition the mirror, for requests that name none; 0 = never by itself",
        "s",
        0.0,
        3600.0,
        live=True,
    ),
    Parameter(
        "condition.degauss_steps",
        int,
        0,
        "half-swings of the degauss that conditions; 0 = as the recipes were built, without recipes as the driver does",
        "",
        0,
        10000,
        live=True,
    ),
    Parameter("condition.timeout", float, 180.0, "longest wait for that degauss", "s", 0.1, 3600.0, live=True),
    Parameter("hold.enable", bool, True, "correct a shape for creep while it is held", live=True),
    Parameter("hold.period", float, PERIOD_S, "shortest time between two corrections", "s", 0.01, 3600.0),
    Parameter(
        "hold.tolerance",
        float,
        2e-10,
        "predicted Zernike coefficient error from which a held shape is corrected",
        "m",
        1e-12,
        1e-6,
        live=True,
    ),
    Parameter(
        "hold.slew", float, 0.02, "largest change of a signal in one correction, normalised", "", 1e-5, 2.0, live=True
    ),
    Parameter(
        "hold.resolution",
        float,
        3.0518e-5,
        "step of the electronics, normalised (16 bit over the range: 2/65535); less than half of it is not corrected",
        "",
        0.0,
        0.1,
        live=True,
    ),
    Parameter(
        "calibration_age_max",
        float,
        2_592_000.0,
        "age from which a calibration that no map has confirmed is called stale; it is still used; 0 = never",
        "s",
        0.0,
        1e9,
        live=True,
    ),
    Parameter(
        "aperture_tolerance",
        float,
        APERTURE_TOLERANCE,
        "largest relative difference between the aperture radius of a calibration and the mirror's",
        "",
        0.0,
        0.5,
    ),
    *LOOP_PARAMETERS,
)
