"""Parameters of the node `calibration`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dm_calibration.influence.fit import FitOptions
from dm_calibration.influence.quality import GradeOptions
from dm_calibration.influence.screening import ScreeningOptions
from dm_calibration.procedure.bump_check import BumpOptions
from dm_calibration.procedure.procedure import ProcedureOptions
from dm_calibration.recalibration.drift_filter import DriftRates
from dm_calibration.recalibration.updates import UpdateOptions
from dm_common.mirror import APERTURE_TOLERANCE
from dm_common.ros.parameters import Parameter

PARAMETERS = (
    Parameter("calibration_folder", str, "~/.ros/dm_calibrations", "Folder of the calibration files."),
    Parameter(
        "load_on_start",
        str,
        "",
        "Calibration to use as soon as the mirror is known: empty = none, newest = the newest that fits, or an id.",
    ),
    Parameter(
        "write_report",
        bool,
        True,
        "Write the report of every calibration that is stored, <id>.html and <id>.pdf, beside its file.",
        live=True,
    ),
    Parameter("poke_amplitude", float, 0.5, "Half-swing of a push-pull poke, normalised.", "", 0.01, 1.0, live=True),
    Parameter("reference_every", int, 10, "Steps between two reference frames.", "", 1, 1000, live=True),
    Parameter("hysteresis_maps", int, 300, "Commands of a hysteresis plan; more, less noise.", "", 60, 2000, live=True),
    Parameter("settle_time", float, 0.5, "Wait between command and map, in ROS time.", "s", 0.0, 600.0, live=True),
    Parameter("measure_retries", int, 1, "Further tries after a map that failed.", "", 0, 20, live=True),
    Parameter(
        "failures_max", int, 3, "Shapes in a row without a map after which a run is given up.", "", 1, 1000, live=True
    ),
    Parameter("driver_timeout", float, 30.0, "Longest wait for the driver to set a shape.", "s", 0.1, 600.0, live=True),
    Parameter("degauss_timeout", float, 180.0, "Longest wait for a degauss.", "s", 0.1, 3600.0, live=True),
    Parameter("measure_timeout", float, 60.0, "Longest wait for one map.", "s", 0.1, 3600.0, live=True),
    Parameter(
        "resume_max_age",
        float,
        43200.0,
        "An interrupted run goes on with the next goal of the same plan, settings and mirror when it is not older; "
        "0 = never.",
        "s",
        0.0,
        1e8,
        live=True,
    ),
    Parameter(
        "start_fresh",
        bool,
        False,
        "The next goal sets interrupted runs aside and begins anew; false again as soon as it has begun.",
        live=True,
    ),
    Parameter(
        "bump.tilt_max",
        float,
        3e-6,
        "Largest change of tilt between two reference frames, as sag at the edge; 0 = not checked.",
        "m",
        0.0,
        1e-3,
        live=True,
    ),
    Parameter(
        "bump.shift_max",
        float,
        1e-4,
        "Largest shift of the aperture on the map between two reference frames, at the mirror; 0 = not checked.",
        "m",
        0.0,
        1e-2,
        live=True,
    ),
    Parameter(
        "bump.figure_max",
        float,
        50e-9,
        "Largest change of the rms figure between two reference frames, beyond what `hysteresis_allowance` explains; "
        "0 = not checked.",
        "m",
        0.0,
        1e-3,
        live=True,
    ),
    Parameter(
        "aperture_tolerance",
        float,
        APERTURE_TOLERANCE,
        "Largest relative difference between the aperture radius of maps or calibrations and the mirror's.",
        "",
        0.0,
        0.5,
        live=True,
    ),
    Parameter("folds", int, 10, "Folds of the cross-validation.", "", 2, 1000, live=True),
    Parameter(
        "epsilon",
        float,
        0.0,
        "Prior parameter of the region weights of AZWreg, Eq. (8); 0 = by cross-validation.",
        "m^2",
        0.0,
        1e-6,
        live=True,
    ),
    Parameter("valid_fraction_min", float, 0.5, "Least share of valid pixels of a map.", "", 0.0, 1.0, live=True),
    Parameter(
        "outlier_sigmas",
        float,
        6.0,
        "Residual of a map, in robust sigmas, beyond which it is dropped.",
        "",
        3.0,
        1e3,
        live=True,
    ),
    Parameter(
        "hysteresis_allowance",
        float,
        0.10,
        "Share of their moves by which actuators may miss their mark (hysteresis) without the map being an outlier.",
        "",
        0.0,
        1.0,
        live=True,
    ),
    Parameter("dead_sigmas", float, 3.0, "Dead below this many standard errors.", "", 0.0, 1e3, live=True),
    Parameter("weak_sigmas", float, 10.0, "Weak below this many standard errors.", "", 0.0, 1e3, live=True),
    Parameter(
        "weak_share", float, 0.4, "Weak below this share of the median response of its ring.", "", 0.0, 1.0, live=True
    ),
    Parameter(
        "calibrated_error_max",
        float,
        32e-9,
        "A calibration whose held-out coefficient error is larger counts as APPROXIMATE (default: wavelength / 20).",
        "m",
        0.0,
        1e-3,
        live=True,
    ),
    Parameter(
        "updates.enable",
        bool,
        True,
        "Take maps that arrive between calibrations to follow the drift of gains and figure.",
        live=True,
    ),
    Parameter(
        "updates.still_time",
        float,
        0.5,
        "The mirror must stand still for so long before and after the stamp of a map.",
        "s",
        0.0,
        600.0,
        live=True,
    ),
    Parameter(
        "updates.surprise_max",
        float,
        3.0,
        "A map that differs from its prediction by more than this times the expected difference is not taken.",
        "",
        1.0,
        100.0,
        live=True,
    ),
    Parameter(
        "updates.surprises_max",
        int,
        3,
        "Maps in a row that differ so much after which the mirror counts as changed.",
        "",
        1,
        1000,
        live=True,
    ),
    Parameter(
        "updates.gain_rate",
        float,
        3e-4,
        "Expected relative drift of a gain in one day; it grows with the root of time. 0 = the gains stay.",
        "",
        0.0,
        1.0,
    ),
    Parameter(
        "updates.figure_rate",
        float,
        1e-9,
        "Expected rms drift of the figure in one day; it grows with the root of time. 0 = the figure stays.",
        "m",
        0.0,
        1e-6,
    ),
    Parameter("updates.gain_drift_max", float, 0.02, "Drift of a gain from which to warn.", "", 0.0, 1.0, live=True),
    Parameter(
        "updates.offset_drift_max", float, 50e-9, "Drift of the figure from which to warn.", "m", 0.0, 1e-3, live=True
    ),
    Parameter(
        "updates.stale_after",
        float,
        2592000.0,
        "A calibration that no map has agreed with for so long is stale (default: 30 days).",
        "s",
        1.0,
        1e10,
        live=True,
    ),
)


def fit_options(values: Mapping[str, Any], method: str = "") -> FitOptions:
    """Options of a fit from the node's parameters; `method` empty = the default."""
    screening = ScreeningOptions(
        valid_fraction_min=values["valid_fraction_min"],
        outlier_sigmas=values["outlier_sigmas"],
        hysteresis_allowance=values["hysteresis_allowance"],
    )
    grades = GradeOptions(
        dead_sigmas=values["dead_sigmas"], weak_sigmas=values["weak_sigmas"], weak_share=values["weak_share"]
    )
    return FitOptions(method or FitOptions().method, values["folds"], screening, grades, values["epsilon"] or None)


def procedure_options(values: Mapping[str, Any], maps_per_state: int = 0) -> ProcedureOptions:
    """Options of a run from the node's parameters; `maps_per_state` 0 = 1."""
    return ProcedureOptions(
        measure_retries=values["measure_retries"],
        failures_max=values["failures_max"],
        maps_per_state=maps_per_state or 1,
        aperture_tolerance=values["aperture_tolerance"],
        fit=fit_options(values),
        bump=BumpOptions(
            values["bump.tilt_max"],
            values["bump.shift_max"],
            values["bump.figure_max"],
            values["hysteresis_allowance"],
        ),
    )


def update_options(values: Mapping[str, Any]) -> UpdateOptions:
    """Options of updates from the node's parameters."""
    return UpdateOptions(
        surprise_max=values["updates.surprise_max"],
        surprises_max=values["updates.surprises_max"],
        valid_fraction_min=values["valid_fraction_min"],
        aperture_tolerance=values["aperture_tolerance"],
        # Without a hysteresis model, an actuator may stand on any branch of its loop.
        signal_sigma=0.5 * values["hysteresis_allowance"],
        rates=DriftRates(values["updates.gain_rate"], values["updates.figure_rate"]),
    )
