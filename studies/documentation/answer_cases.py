"""What `studies.documentation.answers` asks: right and wrong values of every service, action and command topic.

Values are as one types them for `ros2 service call` and `ros2 action send_goal`; `[37 x 0.0]` stands for so many, LONG
for a text of 5000 characters, IN_USE and LAST_MAP for what only the run knows.
"""

from __future__ import annotations

from typing import Any

from dm_msgs.action import Autofocus, BuildRecipes, Calibrate, Converge, Degauss, FocusStack, MoveFocus
from dm_msgs.msg import ActuatorCommand, FocusRequest
from dm_msgs.srv import (
    FitInfluenceFunction,
    FitRegression,
    Flatten,
    GetFocusRange,
    HoldMirror,
    IngestFile,
    ListCalibrations,
    LoadCalibration,
    Measure,
    PredictError,
    SetFocus,
    SetFocusDistance,
    SetSignals,
    StoreRecipes,
    UpdateCalibration,
)

#: Of every request of a focus, where it stands in a field `request` or alone.
_FOCUS = (
    "curvature: .nan",
    "curvature: .inf",
    "curvature: 0.5",
    "curvature: 1000.0",
    "conic_constant: .nan",
    "conic_constant: -.inf",
    "conic_constant: 1.0e+9, curvature: 0.01",
    "zernike: [1.0e-9, 2.0e-9]",
    "zernike: [22 x 0.0]",
    "zernike: [21 x .nan]",
    "zernike: [21 x 1.0e-3]",
    "mode: sideways",
    "mode: conditioned",
    "time_budget: .nan",
    "time_budget: -1.0",
    "time_budget: 1.0e+9",
    "header: {stamp: {sec: 1}}",
)

#: {interface: (type, values)}, in the order in which they are tried.
CASES: dict[str, tuple[Any, tuple[str, ...]]] = {
    "set_signals": (
        SetSignals,
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
        ActuatorCommand,
        (
            "signals: [37 x 0.0]",
            "signals: [36 x 0.0]",
            "signals: [37 x .nan]",
            "signals: [37 x -1.5]",
            "signals: [37 x 0.0], header: {stamp: {sec: 1}}",
        ),
    ),
    "degauss": (
        Degauss,
        (
            "steps: 4",
            "amplitude: .nan",
            "amplitude: .inf",
            "amplitude: -0.5",
            "amplitude: 1.5",
            "steps: 100000",
            "steps: 4, end_signals: [36 x 0.0]",
            "steps: 4, end_signals: [37 x .nan]",
            "steps: 4, end_signals: [37 x 2.0]",
        ),
    ),
    "hold_mirror": (
        HoldMirror,
        (
            "operation: hold, holder: me, purpose: a test",
            "operation: release, holder: me",
            "operation: keep, holder: me",
            "operation: hold",
            "operation: hold, holder: me, lease: .nan",
            "operation: hold, holder: me, lease: -1.0",
            "operation: hold, holder: me, duration: .inf",
        ),
    ),
    "measure": (
        Measure,
        (
            "label: by hand",
            "timeout: .nan",
            "timeout: .inf",
            "timeout: -1.0",
            "timeout: 1.0e+6",
            "label: LONG",
        ),
    ),
    "ingest_file": (
        IngestFile,
        (
            "path: LAST_MAP",
            "path: ''",
            "path: no/such/file.dat",
            "path: /",
            "path: LONG",
        ),
    ),
    "list_calibrations": (ListCalibrations, ("",)),
    "load_calibration": (
        LoadCalibration,
        (
            "calibration: ''",
            "calibration: nonsense",
            "calibration: /etc/passwd",
            "calibration: LONG",
        ),
    ),
    "fit_influence_function": (
        FitInfluenceFunction,
        (
            "method: AZreg",
            "method: AZregg",
            "calibration: nonsense",
            "calibration: LONG",
            "exclude: [poke+99]",
            "exclude: ['LONG']",
        ),
    ),
    "fit_regression": (
        FitRegression,
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
        PredictError,
        ("signals: [37 x 0.1]", "signals: [36 x 0.0]", "signals: [37 x .nan]", "signals: [37 x -1.5]"),
    ),
    "store_recipes": (
        StoreRecipes,
        (
            "calibration_id: IN_USE",
            "calibration_id: nonsense",
            "calibration_id: LONG",
            *(
                f"calibration_id: IN_USE, recipes: {{degauss_steps: 100, recipes: [{{{recipe}}}]}}"
                for recipe in (
                    "curvature: .nan, effective: [37 x 0.0], signals: [37 x 0.0]",
                    "conic_constant: .inf, effective: [37 x 0.0], signals: [37 x 0.0]",
                    "effective: [36 x 0.0], signals: [36 x 0.0]",
                    "effective: [37 x .nan], signals: [37 x 0.0]",
                    "effective: [37 x 0.0], signals: [37 x .inf]",
                    "effective: [37 x 0.0], signals: [37 x 3.0]",
                    "max_zernike: -1.0, effective: [37 x 0.0], signals: [37 x 0.0]",
                    "rms: .nan, effective: [37 x 0.0], signals: [37 x 0.0]",
                )
            ),
            "calibration_id: IN_USE, recipes: {degauss_steps: 0, recipes: [{effective: [37 x 0.0]}]}",
            "calibration_id: IN_USE, recipes: {degauss_steps: 100, interpolation_error: .nan}",
        ),
    ),
    "update_calibration": (UpdateCalibration, ("dry_run: true", "forget: true", "forget: true, dry_run: true")),
    "calibrate": (
        Calibrate,
        (
            "dry_run: true",
            "plan: poke_check",
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
            "plan: hysteresis, hysteresis_maps: 100000",
            "plan: hysteresis, skip_degauss: true",
            "plan: surfaces, surfaces: [p0x]",
            "plan: surfaces, surfaces: ['LONG']",
            "note: LONG",
        ),
    ),
    "set_focus": (
        SetFocus,
        (
            "request: {curvature: 0.02}",
            "request: {curvature: 0.02}, dry_run: true",
            *(f"request: {{{case}}}" for case in _FOCUS),
        ),
    ),
    "focus_request": (FocusRequest, ("curvature: 0.01", *_FOCUS[:1], *_FOCUS[2:3], *_FOCUS[7:8], *_FOCUS[11:12])),
    "flatten": (Flatten, ("", "dry_run: true")),
    "move_focus": (
        MoveFocus,
        (
            "request: {curvature: 0.02}, settle_time: 0.2",
            "request: {curvature: .nan}",
            "request: {curvature: 0.5}",
            "request: {mode: sideways}",
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
        Converge,
        (
            "request: {curvature: 0.02}, tolerance: 5.0e-9",
            "request: {curvature: .nan}",
            "request: {mode: sideways}",
            "request: {time_budget: -1.0}",
            "method: nonsense",
            "method: LONG",
            "tolerance: .nan",
            "tolerance: -1.0",
            "tolerance: .inf",
            "max_maps: 1000",
        ),
    ),
    "build_recipes": (
        BuildRecipes,
        (
            "curvatures: [0.01], tolerance: 2.0e-9, max_maps: 8",
            "curvatures: []",
            "curvatures: [.nan]",
            "curvatures: [0.01, 0.01]",
            "curvatures: [0.5]",
            "curvatures: [2000 x 0.01]",
            "curvatures: [0.01], conic_constant: .nan",
            "curvatures: [0.01], tolerance: .nan",
            "curvatures: [0.01], tolerance: -1.0",
            "curvatures: [0.01], max_maps: 1000",
        ),
    ),
    "get_focus_range": (GetFocusRange, ("",)),
    "set_focus_distance": (
        SetFocusDistance,
        (
            "distance: 100.0",
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
        Autofocus,
        (
            "",
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
        FocusStack,
        ("images: 12", "images: 4", "images: 1001", "curvature_min: .nan", "curvature_min: 0.02, curvature_max: -0.02"),
    ),
}
