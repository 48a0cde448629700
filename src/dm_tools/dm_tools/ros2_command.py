"""`ros2 dm`: the command `dm` among those of ROS 2. Its entry point is all that ros2cli asks for."""

import argparse
from typing import Any


class DmCommand:
    """Open-loop focus with a deformable mirror: calibrate once, then ask for a curvature."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Leave all words to the command itself, and its help too."""

        def print_help(_file: Any = None) -> None:
            self._run(["--help"], cli_name)

        parser.print_help = print_help  # type: ignore[method-assign, assignment]
        parser.add_argument("words", nargs=argparse.REMAINDER)
        parser.set_defaults(cli_name=cli_name)

    def main(self, *, parser: argparse.ArgumentParser, args: argparse.Namespace) -> int:
        """Run a verb; its exit status ends the process."""
        self._run(args.words, args.cli_name)
        return 0

    def _run(self, words: list[str], name: str) -> None:
        from dm_tools.cli import run  # imported late, since `ros2` creates every command just to list them

        run(words, name)
