"""docs/interfaces.md is what the code says, and every link in the documentation leads somewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from documentation import PAGES, ROOT


def test_the_interface_page_is_what_the_code_says() -> None:
    """In a process of its own: it makes every node."""
    done = subprocess.run(
        [sys.executable, "-m", "studies.documentation.interfaces"], capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 0, done.stderr
    committed = (ROOT / "docs" / "interfaces.md").read_text()
    assert committed == done.stdout, "./dm exec python -m studies.documentation.interfaces > docs/interfaces.md"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), f"{page.name}: no {target}"


def test_the_readme_leads_to_every_page() -> None:
    readme = (ROOT / "README.md").read_text()
    for page in PAGES:
        assert page.name == "README.md" or f"({page.relative_to(ROOT)})" in readme, (
            f"README.md does not lead to {page.name}"
        )
