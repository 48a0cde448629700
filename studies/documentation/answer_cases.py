"""Test cases of `studies.documentation.answers`: right and wrong values of every service, action and command topic.

Values are written as for `ros2 service call` and `ros2 action send_goal`. `[37 x 0.0]` means 37 such values, LONG a
text of 5000 characters; IN_USE and LAST_MAP are names that only the run knows.
"""

from __future__ import annotations

from typing import Any

from dm_msgs import action, msg, srv

#: One wrong value of each field of a focus request, for interfaces that contain one in `request` or consist of one.
_WRONG = (
    "curvature: .nan",
    "curvature: 0.5",
    "conic_constant: .nan",
    "zernike: [1.0e-9, 2.0e-9]",
    "mode: sideways",
    "time_budget: -1.0",
    "header: {stamp: {sec: 1}}",
)
#: More values of a focus request.
_FOCUS = (
    *_WRONG,
    "curvature: .inf",
    "curvature: 1000.0",
    "conic_constant: -.inf",
    "conic_constant: 1.0e+9, curvature: 0.01",
    "zernike: [22 x 0.0]",
    "zernike: [21 x .nan]",
    "zernike: [21 x 1.0e-3]",
    "mode: conditioned",
    "time_budget: .nan",
    "time_budget: 1.0e+9",
)
#: Fields of a recipe that could be stored.
_RECIPE = "effective: [37 x 0.0], signals: [37 x 0.0]"

#: {interface: (type, values)}, in the order in which they are tried.
CASES: dict[str, tuple[Any, tuple[str, ...]]] = {
    "set_signals": (
        srv.SetSignals,
        (
            "signals: [37 x 0.1], wait: true",
            "signals: [37 x 0.1], dry_run: true",
            "signals: []",
            "signals: [36 x 0.0]",
            "signals: [37 x .nan]",
            "signals: [37 x .inf]",
            "signals: [37 x 1.5]",
        ),
    ),
    "actuator_command": (
        msg.ActuatorCommand,
        (
            "signals: [37 x 0.0]",
            "signals: [36 x 0.0]",
            "signals: [37 x .nan]",
            "signals: [37 x -1.5]",
            "signals: [37 x 0.0], header: {stamp: {sec: 1}}",
            "signals: [37 x 0.0], expected_turns: 1",
        ),
    ),
    "degauss": (
        action.Degauss,
        (
            "steps: 10",
            "amplitude: .nan",
            "amplitude: .inf",
            "amplitude: -0.5",
            "amplitude: 1.5",
            "steps: 100000",
            "steps: 10, end_signals: [36 x 0.0]",
            "steps: 10, end_signals: [37 x .nan]",
            "steps: 10, end_signals: [37 x 2.0]",
        ),
    ),
    "hold_mirror": (
        srv.HoldMirror,
        (
            "operation: hold, holder: me, purpose: a test",
            "operation: release, holder: me",
            "operation: keep, holder: me",
            "operation: hold",
            "operation: hold, holder: me, lease: .nan",
            "operation: hold, holder: me, lease: -1.0",
            "operation: hold, holder: me, duration: .inf",
            "operation: hold, holder: me, duration: 2.0e+9",
            "operation: hold, holder: LONG",
            "operation: hold, holder: me, purpose: LONG",
        ),
    ),
    "measure": (
        srv.Measure,
        (
            "label: by hand, answer_only: true",
            "timeout: .nan",
            "timeout: .inf",
            "timeout: -1.0",
            "timeout: 1.0e+6",
            "label: LONG",
        ),
    ),
    "ingest_file": (
        srv.IngestFile,
        (
            "path: LAST_MAP",
            "path: ''",
            "path: no/such/file.dat",
            "path: /",
            "path: LONG",
        ),
    ),
    "list_calibrations": (srv.ListCalibrations, ("",)),
    "fit_influence_function": (
        srv.FitInfluenceFunction,
        (
            "method: AZreg",
            "method: AZregg",
            "calibration: nonsense",
            "calibration: LONG",
            "exclude: [poke+99]",
            "exclude: ['LONG']",
            "activate: true",
        ),
    ),
    "load_calibration": (
        srv.LoadCalibration,
        (
            "calibration: ''",
            "calibration: nonsense",
            "calibration: /etc/passwd",
            "calibration: LONG",
            "calibration: IN_USE",
        ),
    ),
    "fit_regression": (
        srv.FitRegression,
        (
            "",
            "method: nonsense",
            "calibration: nonsense",
            "p_enter: .nan",
            "p_enter: -0.1",
            "p_enter: 2.0",
            "p_remove: .inf",
            "p_remove: -0.1",
            "p_enter: 0.2, p_remove: 0.1",
        ),
    ),
    "predict_error": (
        srv.PredictError,
        ("signals: [37 x 0.1]", "signals: [36 x 0.0]", "signals: [37 x .nan]", "signals: [37 x -1.5]"),
    ),
    "update_calibration": (
        srv.UpdateCalibration,
        ("dry_run: true", "without: [38]", "forget: true", "forget: true, dry_run: true"),
    ),
    "calibrate": (
        action.Calibrate,
        (
            "dry_run: true",
            "activate: false, dry_run: true",
            "plan: everything",
            "poke_amplitude: .nan",
            "poke_amplitude: -0.1",
            "poke_amplitude: 1.5",
            "settle_time: .nan",
            "settle_time: .inf",
            "settle_time: -1.0",
            "settle_time: 1.0e+6",
            "maps_per_state: 1000",
            "reference_every: 4000000000",
            "plan: hysteresis, hysteresis_maps: 5",
            "plan: hysteresis, hysteresis_maps: 60",
            "plan: hysteresis, hysteresis_maps: 100000",
            "plan: hysteresis, skip_degauss: true",
            "plan: hysteresis, until: .nan",
            "plan: hysteresis, until: -1.0",
            "plan: pokes, until: 1.0e-9",
            "plan: surfaces, surfaces: [p0x]",
            "plan: surfaces, surfaces: ['LONG']",
            "note: LONG",
        ),
    ),
    "set_focus": (
        srv.SetFocus,
        (
            "request: {curvature: 0.02}",
            "request: {curvature: 0.02}, dry_run: true",
            *(f"request: {{{case}}}" for case in _FOCUS),
        ),
    ),
    "focus_request": (msg.FocusRequest, ("curvature: 0.01", *_WRONG)),
    "flatten": (srv.Flatten, ("", "dry_run: true")),
    "move_focus": (
        action.MoveFocus,
        (
            "request: {curvature: 0.02}, settle_time: 0.2",
            *(f"request: {{{case}}}" for case in _WRONG),
            "tolerance: .nan",
            "tolerance: .inf",
            "tolerance: -1.0",
            "tolerance: 1.0e-15",
            "settle_time: .nan",
            "settle_time: .inf",
            "settle_time: -3.0",
            "settle_time: 1.0e+6",
        ),
    ),
    "converge": (
        action.Converge,
        (
            *(f"request: {{{case}}}" for case in _WRONG),
            "method: nonsense",
            "method: LONG",
            "tolerance: .nan",
            "tolerance: -1.0",
            "tolerance: .inf",
            "max_maps: 1000",
        ),
    ),
    "build_recipes": (
        action.BuildRecipes,
        (
            "curvatures: []",
            "curvatures: [.nan]",
            "curvatures: [0.01, 0.01]",
            "curvatures: [0.5]",
            "curvatures: [2000 x 0.01]",
            "curvatures: [0.01], conic_constant: .nan",
            "curvatures: [0.01], zernike: [2 x 0.0]",
            "curvatures: [0.01], tolerance: .nan",
            "curvatures: [0.01], tolerance: -1.0",
            "curvatures: [0.01], max_maps: 1000",
        ),
    ),
    "store_recipes": (
        srv.StoreRecipes,
        (
            *(f"recipes: {{calibration_id: {whose}}}" for whose in ("IN_USE", "LONG")),
            f"recipes: {{calibration_id: nonsense, degauss_steps: 100, recipes: [{{{_RECIPE}}}]}}",
            *(
                f"recipes: {{calibration_id: IN_USE, degauss_steps: 100, recipes: [{{{recipe}}}]}}"
                for recipe in (
                    f"curvature: .nan, {_RECIPE}",
                    f"conic_constant: .inf, {_RECIPE}",
                    f"zernike: [2 x 0.0], {_RECIPE}",
                    "effective: [36 x 0.0], signals: [36 x 0.0]",
                    "effective: [37 x 0.0], signals: [36 x 0.0]",
                    "effective: [37 x .nan], signals: [37 x 0.0]",
                    "effective: [37 x 0.0], signals: [37 x .inf]",
                    "effective: [37 x 0.0], signals: [37 x 3.0]",
                    f"max_zernike: -1.0, {_RECIPE}",
                    f"rms: .nan, {_RECIPE}",
                    f"by_model: [36 x 0.0], {_RECIPE}",
                )
            ),
            f"recipes: {{calibration_id: IN_USE, degauss_steps: 0, recipes: [{{{_RECIPE}}}]}}",
            "recipes: {calibration_id: IN_USE, degauss_steps: 100, interpolation_error: .nan}",
            "recipes: {calibration_id: IN_USE, degauss_steps: 100, interpolation_error: 1.0e-9, "
            f"recipes: [{{stamp: {{sec: 1}}, curvature: 0.03, conic_constant: -1.0, maps: 4, {_RECIPE}}}]}}",
        ),
    ),
    "get_focus_range": (srv.GetFocusRange, ("",)),
    "set_focus_distance": (
        srv.SetFocusDistance,
        (
            "distance: 100.0",
            "distance: 100.0, dry_run: true",
            "dioptre: 0.01",
            "distance: .inf",
            "distance: .nan",
            "distance: -1.0",
            "distance: 0.1",
            "dioptre: .nan",
            "dioptre: .inf",
            "dioptre: 100.0",
            "distance: 100.0, dioptre: 0.01",
        ),
    ),
    "autofocus": (
        action.Autofocus,
        (
            "track: true",
            "region: [0.1]",
            "region: [4 x .nan]",
            "region: [-1.0, 0.0, 1.0, 1.0]",
            "curvature_min: .nan",
            "curvature_max: .inf",
            "curvature_min: 0.02, curvature_max: -0.02",
            "curvature_min: -1.0, curvature_max: 1.0",
        ),
    ),
    "focus_stack": (
        action.FocusStack,
        ("images: 4", "images: 1001", "curvature_min: .nan", "curvature_min: 0.02, curvature_max: -0.02"),
    ),
}
