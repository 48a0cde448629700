"""docs/interfaces.md is what the code says."""

from __future__ import annotations

import subprocess
import sys

import pytest

from documentation import ROOT
from studies.documentation.interfaces import LINE_MAX, wrapped


@pytest.mark.slow
def test_the_interface_page_is_what_the_code_says() -> None:
    """In a process of its own: it makes every node."""
    done = subprocess.run(
        [sys.executable, "-m", "studies.documentation.interfaces"], capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 0, done.stderr
    committed = (ROOT / "docs" / "interfaces.md").read_text()
    assert committed == done.stdout, "./dm exec python -m studies.documentation.interfaces > docs/interfaces.md"


def test_long_lines_are_wrapped_but_those_of_tables_and_code() -> None:
    long = "word " * LINE_MAX
    kept = f"| {long}|\n\n```console\n{long}\n```\n"
    assert wrapped(kept) == kept
    item, after = wrapped(f"* {long}"), wrapped(f"{kept}{long}").removeprefix(kept)
    assert "\n  word" in item and max(map(len, f"{item}\n{after}".splitlines())) <= LINE_MAX
