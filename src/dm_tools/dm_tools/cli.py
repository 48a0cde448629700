"""The `dm` command: one module per verb, whose heavy imports wait until the verb runs."""

import importlib
import os
import re
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup

from dm_bringup.nodes import node_environment
from dm_common.errors import CodedError, ErrorCode
from dm_common.figures import with_point
from dm_tools.output import NotRunningError, fail

#: Module of each verb, in the order of the help text; its function has the verb's name.
VERBS = {
    "demo": "dm_tools.demo.demo",
    "up": "dm_tools.verbs.up",
    "status": "dm_tools.verbs.status",
    "calibrate": "dm_tools.verbs.calibrate",
    "focus": "dm_tools.verbs.focus",
    "flatten": "dm_tools.verbs.focus",
    "degauss": "dm_tools.verbs.focus",
    "measure": "dm_tools.verbs.measure",
    "check": "dm_tools.verbs.check",
    "instrument": "dm_tools.verbs.instrument",
    "report": "dm_tools.verbs.report",
    "recipes": "dm_tools.verbs.recipes",
    "console": "dm_tools.verbs.console",
    "compare": "studies.verbs.compare",
    "paper": "studies.verbs.paper",
    "bench": "studies.verbs.bench",
    "record": "dm_tools.verbs.record",
    "replay": "dm_tools.verbs.replay",
    "faults": "fault_injection.verb",
    "security": "dm_tools.security.security",
    "doctor": "dm_tools.doctor.doctor",
    "test": "studies.verbs.run_checks",
}
#: Packages that are not installed: their verbs exist only in a checkout of the repository.
CHECKOUT = ("studies", "fault_injection")
#: Settings of verbs that take more than their own options: `test` hands the rest to pytest.
SETTINGS = {"test": {"allow_extra_args": True, "ignore_unknown_options": True}}
#: A number as users type it: it may be negative, which does not make it an option, or have a decimal comma.
NUMBER = re.compile(r"[-−]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?")
#: Exit codes, as listed in the help.
REFUSED, NOT_RUNNING, INTERRUPTED = 1, 3, 130
EXIT_CODES = f"""Exit codes: 0 done; {REFUSED} refused or failed, with the reason on standard error; 2 wrong usage;
{NOT_RUNNING} the nodes are not running; {INTERRUPTED} interrupted by Ctrl-C."""


class Command(TyperCommand):
    """A verb that accepts `-0.02` and `0,02` as numbers."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Write numbers as Python does, and put the first negative argument behind `--`, where nothing is an option.

        Values of options that are no numbers, such as lists with commas, stay as they are.
        """
        hints = get_type_hints(self.callback) if self.callback else {}
        valued = {
            name: float in (hints.get(str(option.name)), *get_args(hints.get(str(option.name))))
            for option in self.params
            if not getattr(option, "is_flag", True)
            for name in option.opts
        }
        for place, word in enumerate(args):
            option, equals, value = word.rpartition("=")
            if NUMBER.fullmatch(value) and valued.get(option or args[place - 1], not option):
                args = [*args[:place], option + equals + with_point(value), *args[place + 1 :]]
        for place, word in enumerate(args):
            if word == "--":
                break
            if word.startswith("-") and NUMBER.fullmatch(word) and (place == 0 or args[place - 1] not in valued):
                args = [*args[:place], *args[place + 1 :], "--", word]
                break
        return super().parse_args(ctx, args)


def _interrupted(error: BaseException) -> str:
    """Message after Ctrl-C, with what became of the goal that it cancelled, if any."""
    return "; ".join(filter(None, ("interrupted", str(error))))


class Group(TyperGroup):
    """The command group: an interrupted verb ends with the same exit status under every version of typer."""

    def invoke(self, ctx: Any) -> Any:
        """Run the verb."""
        try:
            # `./dm` blocks SIGINT while modules are imported; typer would end silently while it parses the arguments.
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            return super().invoke(ctx)
        except (KeyboardInterrupt, typer.Abort) as error:  # the latter during a prompt
            fail(_interrupted(error))
            raise typer.Exit(INTERRUPTED) from error


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"dm {version('dm_tools')}, Python {sys.version.split()[0]}, {sys.prefix}")
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Say which version this is.", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    """Options of the command itself."""


def _spelt_out(hint: Any) -> Any:
    """Replace `X | None` by the equivalent `Union`: the typer of Ubuntu 24.04 (0.9) knows no other form."""
    if get_origin(hint) is Annotated:
        return Annotated[(_spelt_out(hint.__origin__), *hint.__metadata__)]
    return Union[get_args(hint)] if isinstance(hint, UnionType) else hint  # noqa: UP007


def verb(function: Callable[..., None]) -> Callable[..., None]:
    """Give the function of a verb type hints that every version of typer understands."""
    hints = get_type_hints(function, include_extras=True)
    function.__annotations__ = {name: _spelt_out(hint) for name, hint in hints.items()}
    return function


def make_app(only: str = "") -> typer.Typer:
    """Build the command with all verbs that are available, or with `only` this one, without importing the others."""
    app = typer.Typer(
        name="dm",
        cls=Group,
        help="Open-loop focus with a deformable mirror: calibrate once, then ask for a curvature.",
        epilog=EXIT_CODES,
        no_args_is_help=True,
        add_completion=True,
        rich_markup_mode="markdown" if sys.stderr.isatty() else None,  # frames are for screens
        pretty_exceptions_enable=False,
    )
    app.callback()(verb(_options))
    for name, module in {only: VERBS[only]}.items() if only in VERBS else VERBS.items():
        try:
            function = getattr(importlib.import_module(module), name)
        except ModuleNotFoundError as error:
            if error.name not in CHECKOUT:
                raise
        else:
            app.command(name=name, cls=Command, context_settings=SETTINGS.get(name))(verb(function))
    return app


def _set_environment() -> None:
    """Set the environment that every process of the suite runs with, except what `./dm` or the user has set."""
    from ament_index_python.packages import get_package_share_directory

    with suppress(LookupError, OSError):  # no ROS workspace is sourced: only the help works
        for name, value in node_environment(Path(get_package_share_directory("dm_bringup")) / "config").items():
            os.environ.setdefault(name, value)


def run(words: list[str], name: str) -> None:
    """Run the command, called by this name with these words, and end the process with its exit status."""
    _set_environment()
    for number in (signal.SIGTERM, signal.SIGHUP):  # these cancel a run as Ctrl-C does, so that the mirror is released
        if signal.getsignal(number) is signal.SIG_DFL:  # nohup ignores SIGHUP
            signal.signal(number, signal.default_int_handler)
    try:
        make_app(*words[:1])(words, prog_name=name)
    except (RuntimeError, OSError, ValueError) as error:  # DeformableMirrorError and ConfigError among them
        # The name in dm_msgs/ErrorCode, so that users can look it up or search a log for it.
        code = f"{ErrorCode(error.error_code).name}: " if isinstance(error, CodedError) else ""
        fail(f"{code}{error}")
        sys.exit(NOT_RUNNING if isinstance(error, NotRunningError) else REFUSED)
    except KeyboardInterrupt as error:
        fail(_interrupted(error))
        sys.exit(INTERRUPTED)


def main() -> None:
    """Entry point of `dm`."""
    run(sys.argv[1:], "dm")
