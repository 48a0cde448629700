"""`dm measure`: take one map of the mirror as it stands."""

import math
from typing import Annotated, Any

import typer

from dm_common.optics.conic import pitch_of_sphere
from dm_common.optics.zernike import DEFOCUS, PISTON_TILT, SPOKEN, curvature_of_defocus, rms_beyond_tilt
from dm_tools.output import JsonOption, NamespaceOption, console, figures, next_step, write_json
from dm_tools.running_suite import REPORT_S, latest_message, running_suite


def measure(
    label: Annotated[str, typer.Option(help="Text for the log.")] = "",
    reference_sphere: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="A sphere of this radius of curvature (negative = convex) stands in place of the mirror: find the "
            "lateral scale from it.",
        ),
    ] = None,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Take one map of the mirror as it stands, and say what it shows. Nothing moves."""
    if reference_sphere is not None and not 0.0 < abs(reference_sphere) < math.inf:
        raise typer.BadParameter(f"--reference-sphere {reference_sphere:g}: must be a radius in m other than 0")
    with running_suite(namespace) as client:
        answer = client.measure(label, answer_only=reference_sphere is not None)
        calibration = latest_message(client, "calibration", REPORT_S) if reference_sphere is None else None
    info, coefficients = answer.info, list(answer.zernike.coefficients)
    radius = info.aperture_radius
    found: dict[str, Any] = {
        "curvature": curvature_of_defocus(coefficients[DEFOCUS], radius) if radius > 0 else None,
        "rms_beyond_tilt_nm": 1e9 * rms_beyond_tilt(coefficients, answer.zernike.residual_rms),
        "zernike_nm": {name: 1e9 * value for name, value in zip(SPOKEN, coefficients, strict=True)},
    } | figures(info, "rms_nm", "pv_nm", "valid_fraction", "file")
    terms = list(found["zernike_nm"].items())[PISTON_TILT:]
    largest = sorted(terms, key=lambda term: -abs(term[1]))[:3]
    console.print(
        f"{found['rms_beyond_tilt_nm']:.1f} nm rms beyond tilt, of the whole map {found['rms_nm']:.1f} nm rms and "
        f"{found['pv_nm']:.1f} nm peak to valley; {info.valid_fraction:.0%} of the aperture valid"
    )
    console.print(
        f"largest coefficients beyond tilt: {', '.join(f'{name} {value:+.1f} nm' for name, value in largest)}"
    )
    if found["curvature"] is not None:
        console.print(f"defocus: that of a surface with the curvature {round(found['curvature'], 4) + 0.0:+.4f} 1/m")
    console.print(f"file: {info.file}")
    in_use = calibration is not None and calibration.id
    then = f"./dm {'check compares a map with the calibration in use' if in_use else 'status says what to do next'}"
    if reference_sphere is not None:
        found["pitch"] = _scale(info, coefficients, reference_sphere)
        then = "put the parameters into the parameter file; then take the sphere out"
    write_json(json, {"measure": found})
    next_step(then, namespace)


def _scale(info: Any, coefficients: list[float], radius_of_curvature: float) -> float:
    """Print the lateral resolution (m per pixel) that a map of a known sphere gives, as parameters, and its limits."""
    from dm_calibration.influence.poke_cure import parameter_text

    pitch, share = pitch_of_sphere(coefficients, info.aperture_radius_px, info.pitch, radius_of_curvature)
    differs = f", {pitch / info.pitch - 1.0:+.3%} against the value in use" if info.pitch > 0.0 else ""
    console.print(
        f"pitch: {pitch * 1e6:.5f} um{differs}; each nm of the instrument's own error in defocus is {share:.3%} of it. "
        "Add half the relative error of the sphere's radius to scale_error"
    )
    found = {"pitch": pitch}
    if info.instrument_error > 0.0:
        found["scale_error"] = 1e9 * info.instrument_error * share
    console.print(parameter_text({"interferometer": found}), markup=False)
    return pitch
