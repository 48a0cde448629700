"""What the subcommands share: console, figures as JSON, progress bars, and their last lines."""

import json
import os
import re
import sys
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from dm_common.atomic_write import is_stream, write_whole
from dm_common.figures import in_wavelengths

#: Square brackets that are no markup of these commands, and the backslashes before them.
_NO_MARKUP = re.compile(r"(\\*)(\[(?!(?:/|bold|dim|(?:bold )?(?:red|green|yellow))\])[a-z#/@][^[]*?\])")


class _Screen(Console):
    """Prints names in square brackets as they are."""

    def render_str(self, text: str, *, markup: bool | None = None, **how: Any) -> Text:
        escaped = text if markup is False else _NO_MARKUP.sub(r"\1\1\\\2", text)
        return super().render_str(escaped, markup=markup, **how)


#: Lines are not wrapped here: a terminal does that itself, and files and pipes need them whole.
console = _Screen(highlight=False, emoji=False, width=None if os.isatty(1) else 120, soft_wrap=True)
errors = Console(stderr=True, highlight=False, emoji=False, soft_wrap=True)

#: The value of `--json` for standard output.
STANDARD_OUTPUT = Path("-")
#: Wavelength of the simulated interferometer, m.
WAVELENGTH = 632.8e-9


def output_file(path: Path | None) -> Path | None:
    """`path`, if a file can be written there: a long run must not fail at its end. Raises typer.BadParameter."""
    if path is None or path == STANDARD_OUTPUT:
        return path
    free = False
    with suppress(PermissionError):  # below a folder that cannot be searched
        nearest = next(folder for folder in path.absolute().parents if folder.exists())  # missing ones are created
        inside = nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)
        free = is_stream(path) or (inside and not path.is_dir())
    if not free:
        raise typer.BadParameter(f"{path}: must be a file, in a folder in which one can be written")
    return path


def _free_standard_output(path: Path | None) -> Path | None:
    """When the figures go to standard output, write everything else to standard error."""
    path = output_file(STANDARD_OUTPUT if path == Path("/dev/stdout") else path)
    console.file = sys.stderr if path == STANDARD_OUTPUT else None  # type: ignore[assignment]
    return path


JsonOption = Annotated[
    Path | None,
    typer.Option(
        "--json",
        help="Write the figures to this file, - = standard output.",
        metavar="FILE",
        callback=_free_standard_output,
    ),
]
TakeOverOption = Annotated[
    bool, typer.Option("--take-over", help="Take the mirror over from somebody else who holds it: their run ends.")
]


def checked_namespace(namespace: str) -> str:
    """`namespace`, if it is a valid one. Raises typer.BadParameter."""
    if namespace:  # a command without one does not wait for these imports
        from dm_client import DeformableMirrorError
        from dm_client.connection import full_namespace

        try:
            full_namespace(namespace)
        except DeformableMirrorError as error:
            raise typer.BadParameter(f"--{error}") from error
    return namespace


NamespaceOption = Annotated[
    str,
    typer.Option("--namespace", help="Namespace of the mirror, one per mirror.", callback=checked_namespace),
]


class NotRunningError(RuntimeError):
    """No node of the suite is running where the command looks for it."""


def fail(message: str) -> None:
    """Say what went wrong on standard error."""
    errors.print("[bold red]error:[/]", Text(message))


def in_namespace(text: str, namespace: str) -> str:
    """Add the namespace to each command in `text` that talks to running nodes."""
    namespace = namespace.strip("/")
    if not namespace:
        return text
    text = re.sub(rf"lifecycle set /(?!{namespace}/)", f"lifecycle set /{namespace}/", text)
    return re.sub(r"\./dm (?!(?:demo|exec|up)\b)[a-z-]+", rf"\g<0> --namespace {namespace}", text)


def next_step(text: str, namespace: str = "") -> None:
    """Print the last line of a command: what to do next."""
    console.print(f"[dim]next: {in_namespace(text, namespace)}[/]")


def progress_bar(steady: bool = True) -> Progress:
    """A progress bar with step i of n and the time left; not `steady` = drawn only when `refresh()` is called.

    Nothing is drawn into a pipe or a file.
    """
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        refresh_per_second=4,
        auto_refresh=steady,
        disable=not console.is_terminal,
    )


def write_json(path: Path | None, figures: dict[str, Any]) -> None:
    """Write figures whole or not at all, `-` to standard output; None writes nothing."""
    if path is None:
        return
    known = json.loads(json.dumps(figures), parse_constant=lambda _name: None)  # JSON has no NaN: it becomes null
    text = json.dumps(known, indent=2) + "\n"
    if path == STANDARD_OUTPUT:
        print(text, end="")
        return
    write_whole(path, text.encode())
    console.print(f"figures: {path}")


def figures(message: Any, *names: str) -> dict[str, Any]:
    """Fields of `message` for JSON; a name that ends in `_nm` means the field without this suffix, in nanometres."""
    fields = {name: getattr(message, name.removesuffix("_nm")) for name in names}
    return {name: 1e9 * value if name.endswith("_nm") else value for name, value in fields.items()}


def as_wavelengths(length: float) -> str:
    """A length (m) as a fraction of the simulated interferometer's wavelength, such as λ/50; "" above λ/5."""
    return in_wavelengths(length, WAVELENGTH)
