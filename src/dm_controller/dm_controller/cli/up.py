"""`dm up`: the nodes on this terminal, against hardware or the virtual bench."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Annotated

import typer

from dm_controller.cli.output import NamespaceOption, console


def shared_config(name: str) -> Path:
    """A file of the package's config folder."""
    from ament_index_python.packages import get_package_share_directory

    return Path(get_package_share_directory("dm_controller")) / "config" / name


def up(
    config: Annotated[
        Path | None, typer.Option(help="Parameter file of your bench, see config/hardware.yaml; none = virtual bench.")
    ] = None,
    namespace: NamespaceOption = "",
    logs: Annotated[Path | None, typer.Option(help="Write the nodes' output to files in this folder instead.")] = None,
) -> None:
    """Start the nodes and keep them running until Ctrl-C; the mirror is then ramped to its safe shape."""
    from dm_controller.suite import Suite, load_config

    configuration = load_config(config if config is not None else shared_config("bench.yaml"))
    if "pdm_driver" not in configuration:
        raise ValueError(f"{config}: no section for pdm_driver: its required parameters must be given")
    with tempfile.TemporaryDirectory(prefix="dm-up-") as temporary:
        folder = logs if logs is not None else Path(temporary)
        with Suite(configuration, folder, namespace=namespace, echo=logs is None) as suite:
            kind = "virtual bench" if "virtual_bench" in configuration else "hardware"
            console.print(f"the nodes are starting ({kind}); Ctrl-C stops them and makes the mirror safe")
            try:
                while True:
                    suite.check()
                    time.sleep(0.2)
            except KeyboardInterrupt:
                console.print("\nstopping")
