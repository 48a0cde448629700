"""`dm calibrate`: measure and store a calibration on the running suite."""

import math
import re
from contextlib import suppress
from copy import copy
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from dm_common.figures import accuracy_text, in_nanometres, with_point
from dm_tools.output import (
    JsonOption,
    NamespaceOption,
    TakeOverOption,
    console,
    figures,
    next_step,
    output_file,
    progress_bar,
    write_json,
)
from dm_tools.parameter_changes import set_parameter, source_of, write_parameters
from dm_tools.running_suite import REPORT_S, naming_holder, nodes_of_suite, promise, promise_of, running_suite

#: Matches the sentence of a result that says whether the accuracy of --until was reached.
REACHED = re.compile(r"^\S+ nm is (not )?reached")
#: Default region and topic of --boresight.
REGION, IMAGE_TOPIC = "0.25,0.25,0.5,0.5", "image_raw"


class CalibrationPlan(StrEnum):
    """What to measure."""

    full = "full"
    pokes = "pokes"
    surfaces = "surfaces"
    poke_check = "poke-check"
    hysteresis = "hysteresis"


def run_calibration(client: Any, goal: Any) -> Any:
    """Run a Calibrate goal with a progress bar; returns the action's result."""
    from dm_tools.long_actions import calibration_step, reached_so_far

    with progress_bar() as progress:
        task = progress.add_task("calibration", total=None)

        said, reached = set[tuple[str, int]](), 0.0

        def show(feedback: Any) -> None:
            nonlocal reached
            text = calibration_step(feedback)
            phase, tenth = text.split()[0].rstrip(","), 10 * feedback.step // max(feedback.steps, 1)
            if not console.is_terminal and (phase, tenth) not in said:  # no bar is drawn
                said.add((phase, tenth))
                console.print(f"calibration: {phase}, step {feedback.step} of {feedback.steps}")
            if feedback.reached_max_zernike != reached:
                reached = feedback.reached_max_zernike
                console.print(f"calibration: {reached_so_far(feedback)}")
            progress.update(
                task, total=feedback.steps or None, completed=feedback.step, description=f"calibration: {text}"
            )

        result = client.calibrate(goal, show)
        progress.update(task, description="calibration: done", completed=progress.tasks[0].total or 0)
    return result


def expected_run(client: Any, goal: Any) -> str:
    """Expected duration and accuracy of the whole run of a Calibrate goal; nothing moves."""
    question = copy(goal)
    question.dry_run = True
    return str(client.calibrate(question).message).removesuffix("; nothing was moved")


def metres(text: str) -> float:
    """A length above 0 with its unit, such as 2nm, in m. Raises typer.BadParameter for anything else."""
    found = re.fullmatch(r"\s*(\d+|\d*\.\d+)\s*(pm|nm|um)\s*", with_point(text))
    if found is None or float(found[1]) == 0.0:
        raise typer.BadParameter(f"--until {text!r}: must be a number above 0 with pm, nm or um, such as 2nm")
    return float(found[1]) * {"pm": 1e-12, "nm": 1e-9, "um": 1e-6}[found[2]]


def made_by(client: Any, result: Any) -> Any:
    """The message of the calibration that a run made; None where it is not in use."""

    def arrived() -> bool:
        return getattr(client.messages.get("calibration"), "id", "") == result.id

    return client.messages["calibration"] if result.id and client.wait(arrived, REPORT_S) else None


def show_result(result: Any, calibration: Any = None) -> None:
    """Print a calibration's figures and everything a person should know about it; `calibration`: see `made_by`."""
    if result.id:
        console.print(
            f"calibration [bold]{result.id}[/]: {result.maps} maps in {result.duration:.0f} s, residual "
            f"{1e9 * result.held_out_rms:.2f} nm rms on maps held out"
        )
    if result.hysteresis_model:
        promised = "none while it is not in use"
        if calibration is not None:
            promised = f"{promise(promise_of(calibration))} for the largest coefficient beyond what is predicted"
        expected = result.expected_max_zernike
        beforehand = f" ({in_nanometres(expected)} was expected beforehand)" if expected > 0.0 else ""
        console.print(
            f"promise: {promised}, from an error of {in_nanometres(result.hysteresis_held_out_max_zernike)} on moves "
            f"held out{beforehand}; hysteresis {result.hysteresis_model}"
        )
    if calibration is not None:
        console.print(f"when flat: {accuracy_text(promise_of(calibration), calibration, 0.0)}")
    if result.warning:
        console.print(f"[yellow]{result.warning}[/]")
    for entry in result.dropped:
        console.print(f"[yellow]dropped[/] {entry}")
    for entry in result.poke_findings:
        console.print(f"[yellow]poke check[/] {entry}")
    if result.parameters:
        console.print("poke check: to correct this, put into the parameter file (--write FILE does it):")
        console.print(result.parameters, markup=False)
    if result.poke_check_passed:
        console.print("poke check: wiring and orientation are as configured")


def unlisted(result: Any) -> str:
    """The message of a failed result, without the findings that `show_result` lists."""
    listed = [entry for entry in result.poke_findings if entry in result.message]
    return str(result.message.replace("; ".join(listed), "see the findings above") if listed else result.message)


def after_run(result: Any, written: Path | None, used: bool = True) -> str:
    """What to do next, with the parameters that were found `written` to a file or not; "" = nothing to advise.

    `used`: whether the calibration is in use now.
    """
    if result.parameters:  # they correct which actuators are neighbours for the limits, and where the aperture is
        return f"start the nodes with {written or 'these parameters'}, and calibrate again"
    if result.id and not used:
        return f"./dm console puts it into use, as does load_calibration with calibration: {result.id}"
    return "./dm focus 0.02" if result.id else "./dm calibrate" if result.poke_check_passed else ""


def figures_of(result: Any) -> dict[str, Any]:
    """A calibration's figures for JSON; NaN for those that it lacks, such as the residual of a dry run."""
    residuals = figures(result, "in_sample_rms_nm", "held_out_rms_nm")
    of_moves = figures(result, "hysteresis_held_out_max_zernike_nm", "expected_max_zernike_nm")
    return (
        figures(result, "id", "maps", "maps_dropped", "hysteresis_model", "parameters")
        | {name: length if length > 0.0 else math.nan for name, length in (residuals | of_moves).items()}
        | {"condition_number": result.condition_number or math.nan, "poke_findings": list(result.poke_findings)}
        | {"seconds": result.duration, "expected_seconds": result.expected_duration}
    )


def calibrate(
    plan: Annotated[
        CalibrationPlan, typer.Option(help="What to measure; the other plans are for special purposes.")
    ] = CalibrationPlan.hysteresis,
    surfaces: Annotated[
        str, typer.Option(help="Names from Table 1, comma separated, such as p01,pz02; empty = all.")
    ] = "",
    amplitude: Annotated[float, typer.Option(help="Half-swing of a poke, normalised; 0 = configured.")] = 0.0,
    settle: Annotated[float, typer.Option(help="Seconds between command and map; 0 = configured.")] = 0.0,
    maps_per_state: Annotated[int, typer.Option(min=1, help="Maps averaged per state.")] = 1,
    hysteresis: Annotated[
        int | None,
        typer.Option(min=60, max=2000, help="Maps of the hysteresis plan; none = as configured."),
    ] = None,
    until: Annotated[
        str,
        typer.Option(
            help="End a hysteresis run as soon as 95 % of moves are accurate to this, such as 2nm; --hysteresis is "
            "then the largest number of maps."
        ),
    ] = "",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Predict duration and accuracy, move nothing.")] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Begin anew; an interrupted run of the same plan is set aside.")
    ] = False,
    activate: Annotated[bool, typer.Option(help="Use the new calibration at once.")] = True,
    note: Annotated[str, typer.Option(help="Stored with the calibration.")] = "",
    take_over: TakeOverOption = False,
    boresight: Annotated[
        bool,
        typer.Option(
            "--boresight", help="Find where the camera's axis meets the mirror, by its images; no interferometer."
        ),
    ] = False,
    region: Annotated[
        str,
        typer.Option(
            help="With --boresight: left, top, width, height of a part that stands still, as shares of the image."
        ),
    ] = REGION,
    image_topic: Annotated[
        str, typer.Option(help="With --boresight: the camera's topic, as the node autofocus has it.")
    ] = IMAGE_TOPIC,
    write: Annotated[
        Path | None,
        typer.Option(
            help="Write what a poke check or --boresight finds into this copy of the parameter file.",
            callback=output_file,
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            help="With --write: the file that the nodes run with; none = FILE of --write, or the shipped one."
        ),
    ] = None,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Calibrate the mirror on the bench: command, settle, measure, fit, store.

    One run finds the influence function, the hysteresis and the creep of all actuators, and checks the wiring. Needs
    the running suite (`dm up`). Ctrl-C cancels and leaves the mirror at mid range; what was measured is kept, and the
    same command goes on from there. --boresight needs a calibration, the camera and `autofocus` instead.
    """
    from dm_msgs.action import Calibrate

    from dm_client import DeformableMirrorError

    if config is not None and write is None:
        raise typer.BadParameter("--config without --write: it is used only together with --write")
    if boresight:
        of_calibration = (dry_run, fresh, until, note, surfaces, amplitude, settle, hysteresis is not None)
        if any(of_calibration) or (plan, maps_per_state, activate) != (CalibrationPlan.hysteresis, 1, True):
            raise typer.BadParameter(
                "--boresight takes no option of a calibration: it measures by images, and moves the mirror"
            )
        from dm_tools.boresight import run_boresight

        run_boresight(namespace, region, image_topic, take_over, write, config, json)
        return
    if (region, image_topic) != (REGION, IMAGE_TOPIC):
        raise typer.BadParameter("--region and --image-topic are for --boresight")
    if (hysteresis is not None or until) and plan != CalibrationPlan.hysteresis:
        option = "--until" if until else "--hysteresis"
        raise typer.BadParameter(f"--plan {plan.value} and {option}: only the plan hysteresis has this option")
    if amplitude and plan in (CalibrationPlan.hysteresis, CalibrationPlan.surfaces):
        raise typer.BadParameter(
            f"--plan {plan.value} and --amplitude: must be a plan with pokes, such as --plan pokes"
        )
    goal = Calibrate.Goal(
        plan=plan.name,
        hysteresis_maps=hysteresis or 0,
        until=metres(until) if until else 0.0,
        dry_run=dry_run,
        surfaces=[name.strip() for name in surfaces.split(",") if name.strip()],
        poke_amplitude=amplitude,
        settle_time=settle,
        maps_per_state=maps_per_state,
        activate=activate,
        note=note,
        take_over=take_over,
    )
    if dry_run:
        fresh, write = False, None
    with running_suite(namespace) as client, naming_holder(client):
        source = source_of(write, config, client.mirror_info.serial, namespace) if write is not None else None
        if fresh:
            set_parameter(client, "calibration", "start_fresh", True)
        try:
            if not dry_run and plan == CalibrationPlan.hysteresis:
                console.print(f"expected: {expected_run(client, goal)}")
            result = client.calibrate(goal) if dry_run else run_calibration(client, goal)
            calibration = made_by(client, result) if activate and not dry_run else None
            nodes = nodes_of_suite(client) if source is not None else ()  # only now: at first not all are heard
        except DeformableMirrorError as error:
            if (response := error.response) is None:
                raise
            show_result(response)
            if write is not None and source is not None and response.poke_findings:
                write_parameters(response.parameters, write, source, namespace, nodes_of_suite(client))
            raise DeformableMirrorError(error.error_code, unlisted(response), response) from error
        finally:
            if fresh:  # if the run did not begin, the parameter would still be set for somebody else's goal
                with suppress(DeformableMirrorError):
                    set_parameter(client, "calibration", "start_fresh", False)
    if dry_run:
        console.print(result.message)
    else:
        if result.message.startswith("resumed run"):
            console.print(result.message.partition(";")[0])
        show_result(result, calibration)
        if until:
            console.print(next((part for part in result.message.split("; ") if REACHED.search(part)), ""))
    if write is not None and source is not None:
        write_parameters(result.parameters, write, source, namespace, nodes)
    write_json(json, {"calibration": figures_of(result)})
    if dry_run:
        next_step("the same without --dry-run measures")
    elif then := after_run(result, write, activate):
        next_step(then, namespace)
