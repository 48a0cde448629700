"""`dm measure`: take one map. `dm check`: compare one with the calibration in use, and let it improve it."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from dm_common.figures import two_fold
from dm_tools.output import JsonOption, NamespaceOption, TakeOverOption, console, nanometres, next_step, write_json
from dm_tools.running_suite import REPORT_S, hear_health, kept, naming_holder, running_suite, settled_shape, verdict


def measure(
    label: Annotated[str, typer.Option(help="Goes into the log.")] = "",
    reference_sphere: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="In place of the mirror stands a sphere of this radius of curvature (negative = convex): find the "
            "lateral scale from it.",
        ),
    ] = None,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Take one map of the mirror as it stands, and say what it shows. Nothing moves."""
    from dm_common.optics.zernike import PISTON_TILT, SPOKEN, curvature_of, rms_beyond_tilt

    with running_suite(namespace) as client:
        answer = client.measure(label)
    info, coefficients = answer.info, list(answer.zernike.coefficients)
    figures: dict[str, Any] = {
        "curvature": curvature_of(coefficients, info.aperture_radius) if info.aperture_radius > 0 else None,
        "rms_beyond_tilt_nm": nanometres(rms_beyond_tilt(coefficients, answer.zernike.residual_rms)),
        "rms_nm": nanometres(info.rms),
        "pv_nm": nanometres(info.pv),
        "valid_fraction": info.valid_fraction,
        "zernike_nm": {name: nanometres(value) for name, value in zip(SPOKEN, coefficients, strict=True)},
        "file": info.file,
    }
    terms = list(figures["zernike_nm"].items())[PISTON_TILT:]
    largest = sorted(terms, key=lambda term: -abs(term[1]))[:3]
    console.print(
        f"{figures['rms_beyond_tilt_nm']:.1f} nm rms beyond tilt, of the whole map {figures['rms_nm']:.1f} nm rms and "
        f"{figures['pv_nm']:.1f} nm peak to valley; {info.valid_fraction:.0%} of the aperture valid"
    )
    console.print(
        f"largest coefficients beyond tilt: {', '.join(f'{name} {value:+.1f} nm' for name, value in largest)}"
    )
    if figures["curvature"] is not None:
        console.print(f"defocus: as of a surface of {figures['curvature']:+.4f} 1/m")
    console.print(f"file: {info.file}", soft_wrap=True)
    if reference_sphere is not None:
        figures["pitch"] = _scale(info, coefficients, reference_sphere)
        write_json(json, {"measure": figures})
        next_step("put the parameters into the parameter file; then take the sphere out")
        return
    write_json(json, {"measure": figures})
    next_step("./dm check compares a map with the calibration in use")


def _scale(info: Any, coefficients: list[float], radius_of_curvature: float) -> float:
    """Say what lateral resolution (m per pixel) a map of a known sphere shows, as parameters, and what limits it."""
    from dm_common.optics.conic import pitch_of_sphere

    try:
        pitch, share = pitch_of_sphere(coefficients, info.aperture_radius_px, info.pitch, radius_of_curvature)
    except ValueError as error:
        raise typer.BadParameter(f"--reference-sphere: {error}") from error
    differs = f", {pitch / info.pitch - 1.0:+.3%} against what is in use" if info.pitch > 0.0 else ""
    console.print(
        f"pitch: {pitch * 1e6:.5f} um{differs}; each nm of the instrument's own error in defocus is {share:.3%} of it, "
        "and the sphere's radius counts by half",
        soft_wrap=True,
    )
    console.print(f"/**/interferometer:\n  ros__parameters:\n    pitch: {pitch:.12f}")
    if info.instrument_error > 0.0:
        console.print(f"    scale_error: {1e9 * info.instrument_error * share:.6f}")
    return pitch


def check(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Compare only; the calibration stays as it is.")] = False,
    forget: Annotated[bool, typer.Option("--forget", help="Drop all earlier updates; no map is taken.")] = False,
    without: Annotated[
        list[int] | None,
        typer.Option(
            metavar="NUMBER",
            help="Go on without this actuator, which does not move any more; repeatable. --forget takes it back.",
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
        health = hear_health(client)
        response = client.update_calibration(dry_run=dry_run, forget=forget, without=without or (), take_over=take_over)
        calibration = client.latest("calibration")
        # What the shape that stands was promised, and not what the calibration promises of any.
        client.wait(lambda: "focus_controller" in health, REPORT_S)
    shape, capabilities = settled_shape(health), client.messages.get("capabilities")
    if shape is not None:
        promised = shape.bound
    elif capabilities is not None:
        promised = capabilities.error_bound
    else:  # without a focus controller, what the calibration's own maps showed
        promised = calibration.hysteresis.held_out_max_zernike or calibration.held_out_max_zernike
    if forget:
        console.print(response.message)
    else:
        console.print(f"largest coefficient: {verdict(promised, response.max_zernike)}")
        console.print(two_fold(promised, calibration, shape.curvature if shape else 0.0), soft_wrap=True)
        if not response.accepted:
            console.print(f"[red]the map disagrees with the calibration[/]: {response.message}", soft_wrap=True)
        elif without:
            console.print(response.message, soft_wrap=True)
    console.print(
        f"since the calibration was made: {response.revision} maps taken in, gains changed by up to "
        f"{response.gain_drift:.2%}, the figure by {nanometres(response.offset_drift):.2f} nm rms"
    )
    write_json(json, {"check": figures_of(response) | {"promised_nm": nanometres(promised)}})
    if not (response.accepted or forget):
        cure = "as the message says, or ./dm calibrate" if "--without" in response.message else "./dm calibrate"
        next_step(f"./dm degauss and ./dm check again; if it still disagrees, {cure}")
        raise typer.Exit(1)
    if not (forget or without or kept(promised, response.max_zernike)):
        next_step("one map in twenty may be outside: ./dm check again with another shape; if it is too, ./dm calibrate")
        raise typer.Exit(1)
    if without and not dry_run:
        next_step("ask for the shape again: the command that stands counts on all actuators; ./dm status has the range")
        return
    next_step(
        "./dm report writes what the calibration holds"
        if calibration.hysteresis.play_radius
        else "./dm calibrate finds the hysteresis too, and promises far less than this"
    )


def figures_of(response: Any) -> dict[str, Any]:
    """A check's figures for JSON."""
    return {
        "accepted": response.accepted,
        "max_zernike_nm": nanometres(response.max_zernike),
        "rms_nm": nanometres(response.rms),
        "surprise": response.surprise,
        "revision": response.revision,
        "gain_drift": response.gain_drift,
        "offset_drift_nm": nanometres(response.offset_drift),
    }
