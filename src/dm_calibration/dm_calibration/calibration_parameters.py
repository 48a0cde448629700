"""Parameters of the node `calibration`."""

from collections.abc import Mapping
from typing import Any

from dm_calibration.calibration import CALIBRATED_ERROR_MAX
from dm_calibration.influence.fit import FitOptions
from dm_calibration.procedure.bump_check import BumpOptions
from dm_calibration.procedure.plan import PlanOptions
from dm_calibration.procedure.procedure import ProcedureOptions
from dm_calibration.recalibration.drift import UpdateOptions
from dm_common.hysteresis.creep_record import STATE_FOLDER
from dm_common.mirror import APERTURE_TOLERANCE
from dm_common.ros.parameters import AUTOSTART, Parameter, live, parameters_of
from dm_common.values import from_values, real, switch, text, whole

PARAMETERS = (
    AUTOSTART,
    Parameter("calibration_folder", text("~/.ros/dm_calibrations", path=True), "Folder of the calibration files."),
    Parameter(
        "load_on_start",
        text("last"),
        "Calibration to load as soon as the mirror is known: last = the one last in use (if there was none, the newest "
        "that fits), newest = the newest that fits, an id, or empty = none.",
    ),
    live(
        "write_report",
        switch(True),
        "Write a report, <id>.html and <id>.pdf, beside the file of every calibration that is stored.",
    ),
    Parameter(
        "state_folder",
        text(STATE_FOLDER, path=True),
        "The state_folder of focus_controller, in which it keeps the creep state of the actuators: read at the start, "
        "so that maps are compared with the same creep; empty = not known.",
    ),
    *parameters_of("", PlanOptions),
    live("settle_time", real(0.5, 0.0, 600.0, "s"), "Wait between command and map, in ROS time."),
    live(
        "map_time",
        real(1.0, 0.001, 600.0, "s"),
        "Assumed duration of a map until the first one is taken, in ROS time.",
    ),
    *parameters_of("", ProcedureOptions),
    live("driver_timeout", real(30.0, 0.1, 600.0, "s"), "Longest wait for the driver to set a shape."),
    live("degauss_timeout", real(180.0, 0.1, 3600.0, "s"), "Longest wait for a degauss."),
    live("measure_timeout", real(60.0, 0.1, 3600.0, "s"), "Longest wait for one map."),
    live(
        "resume_max_age",
        real(43200.0, 0.0, 1e8, "s"),
        "Largest age of an interrupted run that the next goal with the same plan, settings and mirror resumes; 0 = "
        "never resume.",
    ),
    live(
        "start_fresh",
        switch(False),
        "The next goal sets interrupted runs aside and starts anew; becomes false as soon as it has started.",
    ),
    *parameters_of("bump.", BumpOptions),
    live(
        "aperture_tolerance",
        real(APERTURE_TOLERANCE, 1e-6, 0.5),
        "Largest relative difference between the aperture radius of maps or calibrations and the mirror's.",
    ),
    live("folds", whole(10, 2, 1000), "Folds of the cross-validation."),
    live(
        "epsilon",
        real(0.0, 0.0, 1e-6, "m^2"),
        "Prior parameter of the region weights of AZWreg, Eq. (8); 0 = by cross-validation.",
    ),
    *parameters_of("", FitOptions),
    live(
        "calibrated_error_max",
        real(CALIBRATED_ERROR_MAX, 0.0, 1e-3, "m"),
        "A calibration counts as APPROXIMATE if its 95 % bound on the largest coefficient error of a request is "
        "larger, or if actuators are dead or were never moved (default: wavelength / 20).",
    ),
    live(
        "updates.enable",
        switch(True),
        "Use maps that arrive between calibrations to follow the drift of gains and figure.",
    ),
    live(
        "updates.still_time",
        real(0.5, 0.0, 600.0, "s"),
        "Time before and after the stamp of a map in which the mirror must not move, except for creep corrections.",
    ),
    *parameters_of("updates.", UpdateOptions),
    live("updates.gain_drift_max", real(0.02, 0.0, 1.0), "Relative drift of a gain above which to warn."),
    live("updates.offset_drift_max", real(50e-9, 0.0, 1e-3, "m"), "Rms drift of the figure above which to warn."),
    live(
        "updates.stale_after",
        real(2592000.0, 1.0, 1e10, "s"),
        "A calibration is stale if no map has agreed with it for this long (default: 30 days).",
    ),
    live(
        "temperature.silent_after",
        real(60.0, 0.1, 86400.0, "s"),
        "Time without a message on `temperature` after which the mirror's temperature is not known.",
    ),
)

#: Parameters of the node by which a report judges a calibration, with their defaults.
CRITERIA = {
    parameter.name: parameter.default
    for parameter in PARAMETERS
    if parameter.name in ("calibrated_error_max", "updates.stale_after", "updates.surprises_max")
}


def fit_options(values: Mapping[str, Any], method: str = "") -> FitOptions:
    """Options of a fit from the node's parameters; an empty `method` selects the default."""
    return from_values(FitOptions, values, method=method or FitOptions().method, epsilon=values["epsilon"] or None)


def procedure_options(values: Mapping[str, Any], maps_per_state: int = 1) -> ProcedureOptions:
    """Options of a run from the node's parameters."""
    return from_values(
        ProcedureOptions,
        values,
        maps_per_state=maps_per_state,
        fit=fit_options(values),
        bump=from_values(BumpOptions, values, "bump."),
    )


def update_options(values: Mapping[str, Any]) -> UpdateOptions:
    """Options of updates from the node's parameters."""
    return from_values(
        UpdateOptions,
        values,
        "updates.",
        valid_fraction_min=values["valid_fraction_min"],
        aperture_tolerance=values["aperture_tolerance"],
        # Without a hysteresis model, an actuator may be on any branch of its loop.
        signal_sigma=0.5 * values["hysteresis_allowance"],
    )
