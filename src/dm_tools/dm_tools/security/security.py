"""`dm security`: the hardened profile for installations with SROS 2, generated and checked."""

from pathlib import Path
from typing import Annotated

import typer

from dm_tools.output import JsonOption, NamespaceOption, console, fail, write_json


def security(
    out: Annotated[Path | None, typer.Option(help="Write policies, governance and environment to this folder.")] = None,
    check: Annotated[Path | None, typer.Option(help="Compare this keystore with the profile.")] = None,
    namespace: NamespaceOption = "",
    domain: Annotated[int, typer.Option(min=0, max=232, help="ROS domain of the bench.")] = 0,
    simulation: Annotated[
        bool, typer.Option("--simulation", help="With the virtual bench, which publishes the clock.")
    ] = False,
    sensor: Annotated[
        str, typer.Option(help="Topic of a sensor in place of map files: zernike_topic of the interferometer.")
    ] = "",
    json: JsonOption = None,
) -> None:
    """Generate or check least-privilege SROS 2 policies, one enclave per node; exit status 1 when the check fails."""
    from dm_tools.security.keystore import check_keystore, keys_missing
    from dm_tools.security.policy import Profile, write_profile

    if (out is None) == (check is None):
        raise typer.BadParameter("--out and --check: give one of them")
    profile = Profile(namespace, domain, simulation, sensor)
    if out is not None:
        files = write_profile(profile, out)
        console.print(f"{len(files)} files in {out}: one policy per enclave, governance, and environment.sh")
        console.print(f"{profile.folder(out) / 'environment.sh'} says how to make the keys; see docs/security.md")
        write_json(json, {"security": {"files": [str(path) for path in files]}})
        return
    assert check is not None
    found, missing = check_keystore(check, profile), keys_missing(check, profile)
    for line in found:
        fail(line)
    for enclave in missing:
        console.print(f"[yellow]no keys yet:[/] {enclave}")
    write_json(json, {"security": {"findings": found, "without_keys": missing}})
    if found:
        raise typer.Exit(1)
    console.print("the keystore keeps to the profile" if not missing else "the policies keep to the profile")
