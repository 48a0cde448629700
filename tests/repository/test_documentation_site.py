"""The pages of docs/ as a site: one order, links that lead somewhere, a glossary, lines that one can read."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

from dm_autofocus.optics import FocusOptics
from dm_tools.verbs.up import REST_DISTANCE
from documentation import ELSEWHERE, PAGES, ROOT, classified

DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text()
#: Of the README, whose first screens are read by everybody.
README_LINES_MAX = 130
LINE_MAX = 120
#: Of pages that are written from the code, whose sentences they take over.
GENERATED_LINE_MAX = {"interfaces.md": 130, "parameters.md": 130}


def nav() -> dict[str, list[str]]:
    """{section: its pages}, in the order of the site."""
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    return {
        title: [page if isinstance(page, str) else next(iter(page.values())) for page in pages]
        for section in site["nav"]
        for title, pages in section.items()
    }


def anchors(page: Path) -> set[str]:
    """What a link may lead to on a page: headings, as GitHub and MkDocs name them, and marked places."""
    text = page.read_text()
    headings = re.findall(r"(?m)^#+ (.*)$", re.sub(r"(?ms)^```.*?^```", "", text))
    slugs = {re.sub(r"[\s]+", "-", re.sub(r"[^\w\s-]", "", heading.lower()).strip()) for heading in headings}
    return slugs | set(re.findall(r'<a id="([^"]+)">', text))


def test_every_page_has_its_place() -> None:
    listed = [page for pages in nav().values() for page in pages]
    assert len(listed) == len(set(listed))
    assert set(listed) == {path.name for path in DOCS.glob("*.md")}


def test_the_index_has_the_order_of_the_site() -> None:
    sections = re.split(r"(?m)^## ", (DOCS / "index.md").read_text())[1:]
    found = {section.split("\n", 1)[0]: re.findall(r"(?m)^\| \[[^]]+\]\((\S+?)\)", section) for section in sections}
    assert found == {title: [page for page in pages if page != "index.md"] for title, pages in nav().items()}


def test_the_readme_leads_on() -> None:
    for page in ("docs/index.md", "docs/glossary.md", "CONTRIBUTING.md", "QUALITY_DECLARATION.md", "CHANGELOG.md"):
        assert f"({page})" in README, f"README.md does not lead to {page}"
    assert len(README.splitlines()) <= README_LINES_MAX


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)", page.read_text()):
        # What lies above the checkout is the hosted repository's.
        if not target.startswith(("http", "../../actions/")):
            file = page.parent / target if target else page
            assert file.exists(), f"{page.name}: no {target}"
            assert not anchor or anchor in anchors(file), f"{page.name}: {target} has no {anchor}"
    if page.parent == DOCS:
        assert "](../" not in page.read_text(), f"{page.name} leads out of the site"


def test_the_glossary_says_each_term_once() -> None:
    marked = re.findall(r'<a id="([^"]+)">', (DOCS / "glossary.md").read_text())
    assert len(marked) == len(set(marked)) > 40
    linked = {term for page in PAGES for term in re.findall(r"glossary\.md#([\w-]+)", page.read_text())}
    assert linked <= set(marked)


def test_the_readme_installs_by_commands_that_are_known() -> None:
    commands = [command for command in re.findall(r"`([^`]+)`", README) if " && " in command]
    assert len(commands) == 3
    for command in commands:
        for part in command.split(" && "):
            assert classified(part), f"say in tests/documentation.py how {part!r} is to be tried"


def test_the_reach_is_that_of_the_optics() -> None:
    optics = FocusOptics.from_rest_distance(REST_DISTANCE)
    near, far = (optics.dioptre_for(curvature) for curvature in (0.05, -0.05))
    said = re.search(
        r"sharp at (\d+) m behind the flat mirror focuses from (\d+) m to infinity", " ".join(README.split())
    )
    assert said
    assert (float(said[1]), float(said[2])) == (REST_DISTANCE, pytest.approx(1 / near))
    assert far == pytest.approx(0.0, abs=1e-9)


def test_every_picture_can_be_made_again() -> None:
    rows = set(re.findall(r"(?m)^\| `([\w-]+\.\w+)` \| \S", (ROOT / "CONTRIBUTING.md").read_text()))
    assert rows == {path.name for path in (DOCS / "images").iterdir() if path.suffix != ".py"}
    shown = {name for page in PAGES for name in re.findall(r"\((?:docs/)?images/([^)]+)\)", page.read_text())}
    assert shown == rows, "a picture that no page shows"


def test_the_image_is_made_as_the_hosted_checks_do() -> None:
    image, checks = ((ROOT / name).read_text() for name in ("Dockerfile", ".github/workflows/ci.yml"))
    for step in re.findall(r"(rosdep install .*?-y|grep -E \S+ \S+)", image):
        assert step in checks
    for source in re.findall(r"(?m)^COPY (\S+)", image):
        assert (ROOT / source).exists()
    package, file = re.findall(r'"(\w+)", "([\w.]+)"\]', image)[0]
    assert (ROOT / "src" / package / "launch" / file).is_file()
    assert any(command.startswith("docker build") for command in ELSEWHERE)


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=lambda path: path.name)
def test_lines_are_short(page: Path) -> None:
    """But rows of tables and commands, which cannot be broken."""
    lines, most = enumerate(page.read_text().splitlines(), 1), GENERATED_LINE_MAX.get(page.name, LINE_MAX)
    long = [number for number, line in lines if len(line) > most and not line.startswith(("|", "    "))]
    assert not long, f"{page.name}: lines {long}"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_lists_and_tables_begin_after_an_empty_line(page: Path) -> None:
    """GitHub does not need it, MkDocs does."""
    text = re.sub(r"(?ms)^```.*?^```", "", page.read_text())
    for before, line in pairwise(text.splitlines()):
        starts = re.match(r"(\||[-*] |\d+\. )", line) and not re.match(r"(\s*\||\s*[-*] |\s*\d+\. |\s+\S|$)", before)
        assert not starts, f"{page.name}: {line!r} right after {before!r}"
