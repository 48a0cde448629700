"""docs/interfaces.md is what the code says."""

from __future__ import annotations

import subprocess
import sys

from documentation import ROOT


def test_the_interface_page_is_what_the_code_says() -> None:
    """In a process of its own: it makes every node."""
    done = subprocess.run(
        [sys.executable, "-m", "studies.documentation.interfaces"], capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 0, done.stderr
    committed = (ROOT / "docs" / "interfaces.md").read_text()
    assert committed == done.stdout, "./dm exec python -m studies.documentation.interfaces > docs/interfaces.md"
