"""Parameters of the node `focus_controller`, and allowed values of the fields of its goals."""

from dataclasses import replace
from typing import Final

from dm_common.hysteresis.creep_record import STATE_FOLDER
from dm_common.limits import DEGAUSS_STEPS_MAX, DEGAUSS_STEPS_MIN
from dm_common.ros.parameters import AUTOSTART, Parameter, live
from dm_common.values import Fields, real, reals, switch, text, whole
from dm_controller.creep_hold import PERIOD_S
from dm_controller.planning.planner import SETTLE_S

#: Largest distance of the camera's axis from the middle of the mirror, m.
AXIS_MAX = 0.1

#: For requests and recipes alike.
REACHABLE_TOLERANCE: Final = Parameter(
    "reachable_tolerance",
    real(2e-8, 1e-10, 1e-5, "m"),
    "largest predicted Zernike coefficient error at which a curvature still counts as reachable",
    live=True,
)

PARAMETERS: Final = (
    AUTOSTART,
    REACHABLE_TOLERANCE,
    Parameter(
        "request_age",
        real(1.0, 0.0, 3600.0, "s"),
        "focus requests stamped longer ago, or further in the future, are refused; 0 = never",
    ),
    Parameter(
        "settle_time",
        real(SETTLE_S, 0.0, 60.0, "s"),
        "wait after the last write before a MoveFocus goal succeeds; shapes are planned to be exact then",
    ),
    Parameter("move_timeout", real(10.0, 0.1, 600.0, "s"), "longest time a move may take"),
    live(
        "driver_timeout",
        real(3.0, 0.0, 600.0, "s"),
        "time without reports from pdm_driver after which requests are refused, and longest wait for it to confirm a "
        "command; choose it longer than its state_period; 0 = never refuse, and 3 s for a command",
    ),
    live(
        "time_budget",
        real(0.0, 0.0, 3600.0, "s"),
        "time within which AUTO may condition the mirror, for requests that set none; 0 = AUTO does not condition",
    ),
    live(
        "condition.degauss_steps",
        whole(
            0,
            DEGAUSS_STEPS_MIN,
            DEGAUSS_STEPS_MAX,
            zero="as the recipes were built; without recipes, as in the driver",
        ),
        "half-swings of the degauss that conditions the mirror",
    ),
    live("condition.timeout", real(180.0, 0.1, 3600.0, "s"), "longest wait for the conditioning degauss"),
    live("hold.enable", switch(True), "correct a shape for creep while it is held"),
    Parameter("hold.period", real(PERIOD_S, 0.01, 3600.0, "s"), "shortest time between two corrections"),
    live(
        "hold.tolerance",
        real(2e-10, 1e-12, 1e-6, "m"),
        "predicted Zernike coefficient error above which a held shape is corrected",
    ),
    live("hold.slew", real(0.02, 1e-5, 2.0), "largest change of a signal in one correction, normalised"),
    live(
        "hold.resolution",
        real(3.0518e-5, 0.0, 0.1),
        "step of the electronics, normalised (16 bit over the range: 2/65535); no correction below half of it is sent",
    ),
    live(
        "calibration_age_max",
        real(2_592_000.0, 0.0, 1e9, "s"),
        "time without a map that confirms a calibration, after which it is called stale but still used; 0 = never",
    ),
    Parameter(
        "state_folder",
        text(STATE_FOLDER, path=True),
        "folder for the creep state of each mirror's actuators, which the next start reads; empty = keep nothing",
    ),
    live(
        "hold_tilt",
        switch(True),
        "keep the mirror's tilt while its curvature changes, so that the picture of a camera does not move; false = "
        "tilt is free",
    ),
    live(
        "optical_axis",
        reals([0.0, 0.0], -AXIS_MAX, AXIS_MAX, "m", sizes=(2,)),
        "x and y of the point where the camera's axis meets the mirror, from the centre of the calibrated aperture: "
        "the picture does not move if the vertex of the sphere stays there; `./dm calibrate --boresight` finds it",
    ),
    # Of the closed loops.
    live(
        "converge.tolerance",
        real(2e-9, 1e-11, 1e-5, "m"),
        "largest coefficient error at which a closed loop ends",
    ),
    live("converge.max_maps", whole(5, 1, 100), "maps that a closed loop may take"),
    live(
        "converge.creep",
        real(0.01, 0.0, 0.2),
        "creep that a closed loop assumes if none was identified: growth of a move per decade of time; 0 = none",
    ),
    live(
        "recipes.tolerance",
        real(6.3e-10, 1e-11, 1e-5, "m"),
        "largest re-measured coefficient error of a recipe",
    ),
    live("recipes.max_maps", whole(32, 4, 100), "maps that one recipe may take"),
    live("recipes.average", whole(8, 2, 50), "largest number of maps averaged after each degauss of a recipe"),
    Parameter("converge.settle_time", real(0.5, 0.0, 600.0, "s"), "wait between command and map, in ROS time"),
    Parameter("converge.driver_timeout", real(30.0, 0.1, 600.0, "s"), "longest wait for the driver to set a shape"),
    Parameter("converge.measure_timeout", real(60.0, 0.1, 3600.0, "s"), "longest wait for one map"),
    live("converge.measure_retries", whole(1, 0, 20), "further tries after a map that failed"),
    Parameter(
        "recipes.degauss_steps",
        whole(100, DEGAUSS_STEPS_MIN, DEGAUSS_STEPS_MAX),
        "half-swings of the degauss that recipes begin with",
    ),
    Parameter("recipes.degauss_timeout", real(120.0, 1.0, 3600.0, "s"), "longest wait for a degauss"),
)

#: Allowed values of the fields of goals; the shape that they request is judged with the mirror at hand.
_TOLERANCE, _MAPS = real(0.0, 0.0, 1e-3, "m", zero="as configured"), whole(0, 1, 100, zero="as configured")
CONVERGE = Fields({"request.holder": text(""), "method": text(""), "tolerance": _TOLERANCE, "max_maps": _MAPS})
BUILD_RECIPES = Fields(
    {
        "curvatures": reals([], sizes=range(1, 1001)),
        "conic_constant": real(0.0),
        "zernike": reals([]),
        "holder": text(""),
        "tolerance": _TOLERANCE,
        "max_maps": whole(0, 4, 100, zero="as configured"),
    }
)
MOVE_FOCUS = Fields(
    {
        "tolerance": replace(_TOLERANCE, zero="any error inside the reachable range"),
        "settle_time": real(0.0, 0.0, 3600.0, "s", zero="as configured"),
    }
)
