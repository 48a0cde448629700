"""`dm focus`: ask the running suite for a curvature."""

from __future__ import annotations

from typing import Annotated

import typer

from dm_tools.output import JsonOption, NamespaceOption, as_wavelengths, console, nanometres, write_json


def focus(
    curvature: Annotated[float, typer.Argument(help="Surface curvature [1/m], concave positive; 0 = flat.")],
    dioptre: Annotated[
        bool, typer.Option("--dioptre", help="The number is the optical power = 2 x curvature.")
    ] = False,
    conic: Annotated[float, typer.Option(help="Conic constant: 0 = sphere, -1 = paraboloid.")] = 0.0,
    dry_run: Annotated[bool, typer.Option(help="Predict only; nothing moves.")] = False,
    wait: Annotated[bool, typer.Option(help="Return when the shape stands.")] = True,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Ask for a curvature: the prediction first, then the move.

    Negative numbers need two dashes before them: dm focus -- -0.02
    """
    from dm_client import DeformableMirrorClient, DeformableMirrorError

    wanted = curvature / 2.0 if dioptre else curvature
    with DeformableMirrorClient(namespace) as client:
        try:
            state = client.focus(wanted, conic, dry_run=True)
        except DeformableMirrorError as error:
            if error.response is not None:
                write_json(
                    json, {"focus": [{"curvature": wanted, "error_code": error.error_code, "message": str(error)}]}
                )
            raise
        console.print(
            f"{wanted:+.4f} 1/m ({2 * wanted:+.3f} dioptre): predicted residual "
            f"{nanometres(state.predicted_rms):.1f} nm rms, largest coefficient "
            f"{nanometres(state.predicted_max_zernike):.2f} nm "
            f"({as_wavelengths(state.predicted_max_zernike_upper)} with the calibration's own error), "
            f"reachable {state.curvature_min:+.4f} to {state.curvature_max:+.4f} 1/m"
        )
        if state.saturated:
            console.print(
                f"[yellow]saturated[/]: actuators {', '.join(map(str, state.saturated_actuators))} at a limit"
            )
        if not state.history_known:
            console.print("[yellow]the hysteresis history is unknown[/]: a degauss would make this more accurate")
        if not dry_run:
            if wait:
                result = client.move_focus(wanted, conic)
                state = result.state
                console.print(f"the shape stands after {result.duration * 1e3:.0f} ms")
            else:
                state = client.focus(wanted, conic)
    figures = {
        "curvature": wanted,
        "predicted_rms_nm": nanometres(state.predicted_rms),
        "predicted_rms_upper_nm": nanometres(state.predicted_rms_upper),
        "predicted_max_zernike_nm": nanometres(state.predicted_max_zernike),
        "predicted_max_zernike_upper_nm": nanometres(state.predicted_max_zernike_upper),
        "saturated": state.saturated,
        "applied": state.applied,
        "calibration": state.calibration_id,
    }
    write_json(json, {"focus": [figures]})
