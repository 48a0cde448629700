"""`dm check`: compare one map with the calibration in use, and let it improve it."""

from typing import Annotated, Any

import typer

from dm_common.errors import CHECK_ANOTHER_SHAPE
from dm_common.figures import accuracy_text, counted
from dm_tools.output import JsonOption, NamespaceOption, TakeOverOption, console, figures, next_step, write_json
from dm_tools.running_suite import (
    BUSY_S,
    MENTIONED,
    REPORT_S,
    kept,
    naming_holder,
    nodes_of_suite,
    promise_of,
    receive_health,
    running_suite,
    settled_shape,
    unknown_history,
    verdict,
)


def check(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Compare only; the calibration stays as it is.")] = False,
    forget: Annotated[bool, typer.Option("--forget", help="Drop all earlier updates; no map is taken.")] = False,
    without: Annotated[
        list[int] | None,
        typer.Option(
            metavar="NUMBER",
            min=1,
            max=65535,
            help="Continue without this actuator, which no longer moves; repeatable. --forget uses it again.",
        ),
    ] = None,
    take_over: TakeOverOption = False,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Check the calibration against the mirror as it stands, and follow its drift.

    Needs the running suite (`dm up`) with an interferometer. Nothing moves. Exit status 1 when the map disagrees,
    or shows a larger error than is promised.
    """
    if forget and (dry_run or without):
        raise typer.BadParameter(f"--{'dry-run' if dry_run else 'without'} and --forget: only one of them")
    with running_suite(namespace) as client, naming_holder(client):
        health = receive_health(client)

        def heard() -> bool:
            return "focus_controller" in health and "capabilities" in client.messages

        # The promise that counts is the bound of the present shape, not that of any shape, as it was before the map,
        # which may widen it. Its predicted part is subtracted: the map is compared with the prediction. A recipe makes
        # another surface than the model predicts, so for a conditioned shape the model's bound counts where it is
        # larger: it holds no creep. A shape that was not requested, as after a degauss, has no bound of its own; that
        # of a flat mirror includes the creep which shapes held before have left.
        if not client.wait(heard, REPORT_S) and nodes_of_suite(client)["focus_controller"]:  # not found at first
            client.wait(heard, BUSY_S - REPORT_S)
        shape, capabilities = settled_shape(health), client.messages.get("capabilities")
        # The map is compared by the history known to the node `calibration`, which may have run for longer.
        lost = unknown_history(capabilities)
        unasked = not (forget or lost) and shape is None and capabilities is not None
        flat = _flat_bound(client) if unasked else 0.0
        response = client.update_calibration(dry_run=dry_run, forget=forget, without=without or (), take_over=take_over)
        calibration = client.latest("calibration")
    if lost or capabilities is None:  # what a focus controller with that node's knowledge would promise
        promised = promise_of(calibration)
    elif shape is None:
        promised = max(capabilities.error_bound, flat)
    else:
        promised = max(shape.bound - shape.predicted, capabilities.error_bound if shape.conditioned else 0.0)
    if forget:
        console.print(response.message)
    else:
        if lost:
            console.print(
                "[yellow]compared with the state of the actuators that the node `calibration` knows, and not with "
                f"the shape requested: focus_controller does not know their history ({lost})[/]"
            )
        beyond = " beyond what is predicted" if shape is not None and shape.predicted >= MENTIONED else ""
        console.print(f"largest coefficient{beyond}: {verdict(promised, response.max_zernike)}")
        console.print(accuracy_text(promised, calibration, shape.curvature if shape else 0.0))
        if not response.accepted:
            console.print(f"[red]the map disagrees with the calibration[/]: {response.message}")
        elif without:
            console.print(response.message)
    console.print(
        f"since the calibration was made: {counted(response.revision, 'map')} used for updates, gains changed by up to "
        f"{response.gain_drift:.2%}, the figure by {1e9 * response.offset_drift:.2f} nm rms"
    )
    names = ("accepted", "max_zernike_nm", "rms_nm", "surprise", "revision", "gain_drift", "offset_drift_nm")
    write_json(json, {"check": figures(response, *names) | {"promised_nm": 1e9 * promised}})
    outside = not (forget or without or kept(promised, response.max_zernike))
    if failed := not (response.accepted or forget):
        cure = "as the message says, or ./dm calibrate" if "./dm check --" in response.message else "./dm calibrate"
        then = f"./dm degauss and ./dm check again; if it still disagrees, {cure}"
    elif outside:
        then = "one map in twenty may be outside: ./dm check again with another shape; if it is too, ./dm calibrate"
    elif without and dry_run:
        then = "the same command without --dry-run continues so; nothing is changed yet"
    elif without and CHECK_ANOTHER_SHAPE in response.message:
        then = "./dm focus to another curvature, then ./dm check: bounds stay wide until a map shows that it is stuck"
    elif without:
        then = "ask for the shape again: the present command still relies on all actuators; ./dm status shows the range"
    elif lost and not forget:
        then = "./dm degauss: then focus_controller knows the history too"
    elif calibration.hysteresis.play_radius:
        then = "./dm report writes what the calibration holds"
    else:
        then = "./dm calibrate finds the hysteresis too; its error bound is far smaller than this"
    next_step(then, namespace)
    if failed or outside:
        raise typer.Exit(1)


def _flat_bound(client: Any) -> float:
    """Bound of a request for the flat mirror at this moment beyond its prediction, m; 0 = there is none."""
    from dm_msgs.msg import FocusRequest

    from dm_client import DeformableMirrorError

    try:
        state = client.focus(0.0, dry_run=True, mode=FocusRequest.MODE_DIRECT)  # by the model, as the map is predicted
    except DeformableMirrorError:  # not within reach
        return 0.0
    return float(state.predicted_max_zernike_upper - state.predicted_max_zernike)
