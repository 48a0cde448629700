"""The `dm` command: one module a verb, whose heavy imports wait until the verb runs."""

from __future__ import annotations

import importlib
import sys

import typer

from dm_tools.output import fail

#: Module of each verb, in the order of the help text; its function has the verb's name.
VERBS = {
    "demo": "dm_tools.demo.demo",
    "up": "dm_tools.verbs.up",
    "calibrate": "dm_tools.verbs.calibrate",
    "recipes": "dm_tools.verbs.recipes",
    "report": "dm_tools.verbs.report",
    "focus": "dm_tools.verbs.focus",
    "console": "dm_tools.verbs.console",
    "compare": "studies.verbs.compare",
    "paper": "studies.verbs.paper",
    "bench": "studies.verbs.bench",
    "record": "dm_tools.verbs.record",
    "replay": "dm_tools.verbs.replay",
    "faults": "fault_injection.verb",
    "security": "dm_tools.verbs.security",
    "doctor": "dm_tools.verbs.doctor",
    "check": "dm_tools.verbs.verify_calibration",
    "test": "studies.verbs.run_checks",
}
#: Packages that are not installed: their verbs are there where the checkout is.
CHECKOUT = ("studies", "fault_injection")
#: Settings of verbs that take more than their own options: `test` hands the rest to pytest.
SETTINGS = {"test": {"allow_extra_args": True, "ignore_unknown_options": True}}


def make_app() -> typer.Typer:
    """The command with all verbs that are there."""
    app = typer.Typer(
        name="dm",
        help="Open-loop focus with a deformable mirror: calibrate once, then ask for a curvature.",
        no_args_is_help=True,
        add_completion=True,
        rich_markup_mode="markdown",
        pretty_exceptions_enable=False,
    )
    for name, module in VERBS.items():
        try:
            function = getattr(importlib.import_module(module), name)
        except ModuleNotFoundError as error:
            if error.name not in CHECKOUT:
                raise
        else:
            app.command(name=name, context_settings=SETTINGS.get(name))(function)
    return app


app = make_app()


def main() -> None:
    """Entry point of `dm`."""
    try:
        app(prog_name="dm")
    except (RuntimeError, OSError, ValueError) as error:  # DeformableMirrorError and ConfigError among them
        fail(str(error))
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
