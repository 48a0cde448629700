"""`dm focus`, `dm flatten`, `dm degauss`: what moves the mirror of the running suite."""

from typing import Annotated, Any

import typer

from dm_common.figures import accuracy_text, in_nanometres
from dm_common.optics.conic import range_text
from dm_tools.output import JsonOption, NamespaceOption, TakeOverOption, console, figures, next_step, write_json
from dm_tools.running_suite import (
    MENTIONED,
    REPORT_S,
    latest_message,
    naming_holder,
    promise,
    running_suite,
    saturation_text,
)


def focus(
    curvature: Annotated[float, typer.Argument(help="Surface curvature [1/m], concave positive; 0 = flat.")],
    dioptre: Annotated[
        bool, typer.Option("--dioptre", help="The number is the optical power = 2 x curvature.")
    ] = False,
    conic: Annotated[float, typer.Option(help="Conic constant: 0 = sphere, -1 = paraboloid.")] = 0.0,
    conditioned: Annotated[
        bool, typer.Option("--conditioned", help="Degauss, then go by the recipes: most accurate, takes seconds.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Predict only; nothing moves.")] = False,
    wait: Annotated[bool, typer.Option(help="Return when the shape is reached.")] = True,
    take_over: TakeOverOption = False,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Ask for a curvature: print the promised accuracy, then move."""
    from dm_msgs.msg import FocusRequest

    from dm_client import DeformableMirrorError

    wanted = curvature / 2.0 if dioptre else curvature
    mode = FocusRequest.MODE_CONDITIONED if conditioned else FocusRequest.MODE_AUTO
    with running_suite(namespace) as client, naming_holder(client):
        try:
            state = client.focus(wanted, conic, dry_run=True, mode=mode)
            _show(client, state)
            if not dry_run and wait:
                result = client.move_focus(wanted, conic, mode=mode, take_over=take_over)
                state = result.state
                console.print(f"the shape is reached after {result.duration * 1e3:.0f} ms{_held(state)}")
            elif not dry_run:
                state = client.focus(wanted, conic, mode=mode, take_over=take_over)
        except DeformableMirrorError as error:
            if error.response is not None:
                refused = {"curvature": wanted, "error_code": error.error_code, "message": str(error)}
                write_json(json, {"focus": [refused]})
            raise
    write_json(json, {"focus": [figures_of(state)]})
    _show_next(state, namespace, dry_run)


def flatten(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Predict only; nothing moves.")] = False,
    take_over: TakeOverOption = False,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Make the surface as flat as the mirror can: curvature 0, its own figure corrected."""
    with running_suite(namespace) as client, naming_holder(client):
        state = client.flatten(dry_run=dry_run, take_over=take_over)
        _show(client, state)
    if state.applied:
        console.print(f"commanded{_held(state)}")
    write_json(json, {"focus": [figures_of(state)]})
    _show_next(state, namespace, dry_run)


def degauss(take_over: TakeOverOption = False, namespace: NamespaceOption = "", json: JsonOption = None) -> None:
    """Swing all actuators with falling amplitude: the mirror ends at mid range, with a known history.

    It takes seconds. Afterwards error bounds are as small as the calibration allows.
    """
    with running_suite(namespace) as client, naming_holder(client):
        console.print("degaussing: the mirror swings over its whole range and ends at mid range")
        response = client.degauss(take_over=take_over)
        known = client.wait(lambda: client.actuator_state.history_known, 2.0)
    console.print(f"done in {response.duration:.1f} s; the actuators' history is {'known' if known else 'not known'}")
    write_json(json, {"degauss": {"seconds": response.duration, "history_known": known}})
    if not known:
        raise typer.Exit(1)
    next_step("./dm focus 0.02", namespace)


def _show(client: Any, state: Any) -> None:
    """Print what a dm_msgs/FocusState promises."""
    calibration, mirror = (latest_message(client, topic, REPORT_S) for topic in ("calibration", "mirror_info"))
    predicted = state.predicted_max_zernike
    predicted_part = f", of which {in_nanometres(predicted)} are predicted" if predicted >= MENTIONED else ""
    console.print(
        f"{state.curvature:+.4f} 1/m ({state.power:+.3f} dioptre): promised "
        f"{promise(state.predicted_max_zernike_upper)} for the largest coefficient{predicted_part}; "
        f"reachable {range_text(state.curvature_min, state.curvature_max, '1/m')}"
    )
    if calibration is not None:
        console.print(accuracy_text(state.predicted_max_zernike_upper - predicted, calibration, state.curvature))
    if state.saturated:
        console.print(f"[yellow]saturated[/]: {saturation_text(state, mirror)}")
    if remarks := state.message.partition("; ")[2]:
        console.print(remarks, style="yellow", markup=False)


def _held(state: Any) -> str:
    return " and is held against creep" if state.creep_held else ""


def _show_next(state: Any, namespace: str, dry_run: bool) -> None:
    if dry_run:
        next_step("the same without --dry-run moves the mirror")
    elif not state.applied:
        next_step("./dm status shows the shape after the degauss", namespace)
    elif not state.history_known:
        next_step("./dm degauss, then ask again: the error bound is then smaller", namespace)
    else:
        next_step("./dm check compares the promise with a map, ./dm status shows the present shape", namespace)


def figures_of(state: Any) -> dict[str, Any]:
    """A dm_msgs/FocusState's figures for JSON."""
    lengths = ("predicted_rms_nm", "predicted_rms_upper_nm", "predicted_max_zernike_nm")
    rest = ("predicted_max_zernike_upper_nm", "saturated", "applied")
    return figures(state, "curvature", *lengths, *rest) | {"calibration": state.calibration_id}
