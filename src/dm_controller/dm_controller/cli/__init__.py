"""The `dm` command: one module per subcommand, imported only when it is used."""

from __future__ import annotations

import sys

import typer

from dm_controller.cli.audit import audit
from dm_controller.cli.bench import bench
from dm_controller.cli.calibrate import calibrate
from dm_controller.cli.check import check as check_calibration
from dm_controller.cli.checks import check
from dm_controller.cli.compare import compare
from dm_controller.cli.console import console
from dm_controller.cli.demo import demo
from dm_controller.cli.doctor import doctor
from dm_controller.cli.focus import focus
from dm_controller.cli.output import fail
from dm_controller.cli.paper import paper
from dm_controller.cli.recipes import recipes
from dm_controller.cli.record import record
from dm_controller.cli.replay import replay
from dm_controller.cli.report import report
from dm_controller.cli.security import security
from dm_controller.cli.torture import torture
from dm_controller.cli.up import up

app = typer.Typer(
    name="dm",
    help="Open-loop focus with a deformable mirror: calibrate once, then ask for a curvature.",
    no_args_is_help=True,
    add_completion=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
for command in (
    demo,
    up,
    calibrate,
    recipes,
    report,
    focus,
    console,
    compare,
    paper,
    bench,
    record,
    replay,
    torture,
    security,
    audit,
    doctor,
):
    app.command()(command)
app.command(name="check")(check_calibration)
app.command(name="test", context_settings={"allow_extra_args": True, "ignore_unknown_options": True})(check)


def main() -> None:
    """Entry point of `dm`."""
    from dm_controller.client import DeformableMirrorError
    from dm_controller.suite import ConfigError

    try:
        app(prog_name="dm")
    except (DeformableMirrorError, ConfigError, RuntimeError, OSError, ValueError) as error:
        fail(str(error))
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
