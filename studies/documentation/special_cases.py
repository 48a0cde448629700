"""More test cases of `studies.documentation.answers`: of a mirror that is held, of the bench, of topics with data."""

from __future__ import annotations

from typing import Any

from dm_msgs import msg
from sensor_msgs.msg import Image, Temperature
from std_srvs.srv import SetBool, Trigger

#: Values of every interface that moves the mirror, while another client holds it; {} = fields of the asking client.
_HELD = {
    "set_signals": "signals: [37 x 0.0], {}",
    "actuator_command": "signals: [37 x 0.0], {}",
    "degauss": "steps: 10, {}",
    "set_focus": "request: {{curvature: 0.02, {}}}",
    "focus_request": "curvature: 0.02, {}",
    "flatten": "{}",
    "move_focus": "request: {{curvature: 0.02, {}}}, settle_time: 0.2",
    "set_focus_distance": "distance: 100.0, {}",
    "update_calibration": "dry_run: true, {}",
    "calibrate": "plan: poke_check, {}",
    "converge": "request: {{curvature: 0.02, {}}}, tolerance: 5.0e-9",
    "build_recipes": "curvatures: [0.01], tolerance: 2.0e-9, max_maps: 8, {}",
    "autofocus": "{}",
    "focus_stack": "images: 12, {}",
}
#: Long runs, for which one with `holder: me` is left out.
_LONG_RUNS = ("calibrate", "converge", "build_recipes", "autofocus", "focus_stack")
#: The request by which `me` holds the mirror.
HOLD = "operation: hold, holder: me, lease: 600.0"
#: {interface: values}, in the order in which they are tried.
HELD = {
    name: tuple(
        values.format(who)
        for who in ("holder: you", "holder: LONG", "holder: me", "take_over: true")
        if who != "holder: me" or name not in _LONG_RUNS
    )
    for name, values in _HELD.items()
}

#: Cases of the bench, in the form of `answer_cases.CASES`.
BENCH: dict[str, tuple[Any, tuple[str, ...]]] = {
    "virtual_bench/trigger": (Trigger, ("",)),
    "virtual_bench/power": (SetBool, ("data: false", "data: true")),
}

#: Topics with data: type, wrong values, and the node that reports them. Messages of one map are taken together.
TOPICS: dict[str, tuple[Any, str, str]] = {
    "image_raw": (Image, "encoding: rgb9, width: 4, height: 4", "autofocus"),
    "temperature": (Temperature, "temperature: 500.0", "calibration"),
    "zernike": (msg.ZernikeCoefficients, "convention: seven", "calibration"),
    "calibration": (msg.Calibration, "id: another, actuators: 37", "focus_controller"),
    "surface_samples": (msg.SurfaceSamples, "sag: [1.0]", "calibration"),
    "mirror_info": (msg.MirrorInfo, "actuators: 37", "calibration"),
}
#: The messages of a map.
MAP = {
    "zernike": msg.ZernikeCoefficients,
    "surface_samples": msg.SurfaceSamples,
    "surface_map_info": msg.SurfaceMapInfo,
}
