"""The `dm` command: one module per subcommand, imported only when it is used."""

from __future__ import annotations

import importlib
import sys

import typer

from dm_tools.demo.demo import demo
from dm_tools.output import fail
from dm_tools.verbs.calibrate import calibrate
from dm_tools.verbs.console import console
from dm_tools.verbs.doctor import doctor
from dm_tools.verbs.focus import focus
from dm_tools.verbs.recipes import recipes
from dm_tools.verbs.record import record
from dm_tools.verbs.replay import replay
from dm_tools.verbs.report import report
from dm_tools.verbs.run_checks import check
from dm_tools.verbs.security import security
from dm_tools.verbs.up import up
from dm_tools.verbs.verify_calibration import check as check_calibration

#: Module and command.
STUDIES = {
    "studies.verbs.compare": "compare",
    "studies.verbs.paper": "paper",
    "studies.verbs.bench": "bench",
    "fault_injection.verb": "torture",
}

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
    record,
    replay,
    security,
    doctor,
):
    app.command()(command)


def _add_studies() -> None:
    """The commands of the checkout, which are not installed: those of `studies` and of `tests/fault_injection`."""
    for module, name in STUDIES.items():
        try:
            app.command(name=name)(getattr(importlib.import_module(module), name))
        except ModuleNotFoundError as error:
            if error.name not in ("studies", "fault_injection"):
                raise


_add_studies()
app.command(name="check")(check_calibration)
app.command(name="test", context_settings={"allow_extra_args": True, "ignore_unknown_options": True})(check)


def main() -> None:
    """Entry point of `dm`."""
    from dm_bringup.suite import ConfigError
    from dm_client.client import DeformableMirrorError

    try:
        app(prog_name="dm")
    except (DeformableMirrorError, ConfigError, RuntimeError, OSError, ValueError) as error:
        fail(str(error))
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
