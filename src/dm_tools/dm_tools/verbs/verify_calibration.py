"""`dm check`: compare the calibration in use with a map taken now, and let the map improve it."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from dm_tools.output import JsonOption, NamespaceOption, console, nanometres, write_json


def check(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Compare only; the calibration stays as it is.")] = False,
    forget: Annotated[bool, typer.Option("--forget", help="Drop all earlier updates; no map is taken.")] = False,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Check the calibration against the mirror as it stands, and follow its drift.

    Needs the running suite (`dm up`) with an interferometer. Nothing moves. Exit status 1 when the map disagrees.
    """
    from dm_client import DeformableMirrorClient

    if dry_run and forget:
        raise typer.BadParameter("--dry-run and --forget: only one of them")
    with DeformableMirrorClient(namespace) as client:
        response = client.update_calibration(dry_run=dry_run, forget=forget)
    figures = figures_of(response)
    if forget:
        console.print(response.message)
    else:
        colour, word = ("green", "agrees") if response.accepted else ("red", "disagrees")
        console.print(
            f"the map [{colour}]{word}[/]: {response.message}; largest coefficient difference "
            f"{figures['max_zernike_nm']:.2f} nm, {figures['rms_nm']:.2f} nm rms"
        )
    console.print(
        f"since the calibration was made: {response.revision} maps taken in, gains changed by up to "
        f"{response.gain_drift:.2%}, the figure by {figures['offset_drift_nm']:.2f} nm rms"
    )
    write_json(json, {"check": figures})
    if not (response.accepted or forget):
        raise typer.Exit(1)


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
