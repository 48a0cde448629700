"""`dm calibrate --boresight`: keep the picture of a camera still while the focus changes."""

from pathlib import Path
from typing import Any

import numpy as np
import typer

from dm_autofocus.sharpness import check_region
from dm_common.errors import ErrorCode
from dm_tools.output import NotRunningError, console, next_step, write_json
from dm_tools.parameter_changes import get_parameter, set_parameter, source_of, write_parameters
from dm_tools.running_suite import BUSY_S, nodes_of_suite

#: A picture that moves by less than this over the range of curvatures counts as still [px].
STILL_PX = 0.5


def region_of(text: str) -> tuple[float, ...]:
    """Parse `text` as left, top, width and height. Raises typer.BadParameter."""
    try:
        return check_region([float(part) for part in text.split(",")])
    except ValueError as error:
        raise typer.BadParameter(f"--region {text!r}: {error}") from error


def price(client: Any, axis: Any) -> dict[str, Any]:
    """Cost of a still picture: reachable curvatures [1/m] and residual [nm rms], with held and with free tilt."""
    from dm_controller.planning.active_calibration import active_calibration
    from dm_controller.planning.target import FocusTarget

    figures: dict[str, Any] = {}
    reachable_tolerance = get_parameter(client, "focus_controller", "reachable_tolerance")
    wanted = [client.capabilities.curvature_min, client.capabilities.curvature_max]
    for name, hold in (("held", True), ("free", False)):
        active = active_calibration(client.latest("calibration"), client.mirror_info, hold, tuple(axis))
        low, high = active.reachable_range(FocusTarget(0.0), reachable_tolerance)
        rms = max(active.mirror.plan(FocusTarget(curvature)).rms for curvature in wanted)
        figures[name] = {"curvature_min": low, "curvature_max": high, "residual_rms_nm": 1e9 * rms}
    return figures


def run_boresight(
    namespace: str,
    region: str,
    image_topic: str,
    take_over: bool,
    write: Path | None,
    config: Path | None,
    json: Path | None,
) -> None:
    """Find the camera's axis, set it in the focus controller, and measure whether the picture now stays still.

    Raises DeformableMirrorError when the picture moves no less than before; the old axis is then restored.
    """
    from dm_autofocus import CameraFocusClient
    from dm_calibration.influence.poke_cure import parameter_text
    from dm_client import DeformableMirrorError

    part = region_of(region)
    with CameraFocusClient(namespace) as client:
        if not client.wait(lambda: nodes_of_suite(client), BUSY_S):
            raise NotRunningError("no node of the suite is heard: start them (./dm up --camera, or your launch file)")
        source = source_of(write, config, client.mirror_info.serial, namespace) if write is not None else None
        reach = client.focus_range()
        span = reach.curvature_max - reach.curvature_min

        def moved() -> tuple[Any, float, float]:
            """The result, the motion of the picture over the range and its standard deviation, both in px."""
            with console.status("tip, tilt and focus, to and fro"):
                found = client.boresight(part, image_topic=image_topic, stamp_lead=lead, take_over=take_over)
            return found, float(span * np.hypot(*found.drift)), float(span * np.hypot(*found.drift_sigma))

        lead = get_parameter(client, "autofocus", "stamp_lead")
        axis = np.array(get_parameter(client, "focus_controller", "optical_axis"))
        found, before, sigma = moved()
        console.print(f"over the range of curvatures the picture moves by {before:.2f} px (± {sigma:.2f})")
        after = before
        if before > max(STILL_PX, 2 * sigma):
            held, axis = axis, axis + found.offset(client.capabilities.aperture_radius)
            set_parameter(client, "focus_controller", "optical_axis", axis.tolist())
            try:
                _found, after, sigma = moved()
                if after >= before:
                    raise DeformableMirrorError(
                        ErrorCode.NOT_CONVERGED,
                        f"with the axis that was found it moves by {after:.2f} px: is all in and near the region at "
                        "rest, at one distance? The axis was not changed",
                    )
            except BaseException:  # Ctrl-C too: an axis that was not confirmed is not kept
                set_parameter(client, "focus_controller", "optical_axis", held.tolist())
                raise
            console.print(f"now by {after:.2f} px (± {sigma:.2f})")
        cost = price(client, axis)
    console.print(f"the camera's axis meets the mirror at x = {1e3 * axis[0]:+.3f} mm, y = {1e3 * axis[1]:+.3f} mm")
    for name, figures in cost.items():
        console.print(
            f"tilt {name}: {figures['curvature_min']:+.4f} to {figures['curvature_max']:+.4f} 1/m, at most "
            f"{figures['residual_rms_nm']:.1f} nm rms"
        )
    figures = {"optical_axis_m": axis.tolist(), "moved_before_px": before, "moved_px": after, "sigma_px": sigma}
    write_json(json, {"boresight": figures | cost})
    parameters = parameter_text({"focus_controller": {"optical_axis": axis.round(6).tolist()}})
    if write is not None and source is not None:
        write_parameters(parameters, write, source, namespace, ("autofocus",))
    else:
        console.print("in use until the node ends; to keep it, put into its parameter file (--write FILE does it):")
        console.print(parameters, markup=False)
    next_step("./dm focus 0.02", namespace)
