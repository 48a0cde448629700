"""The floor plan: which way imports go between packages and folders, and how large folders and modules may be."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from studies.house_figures import WALKED, printed_by

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = sorted(path.name for path in (ROOT / "src").iterdir() if (path / path.name / "__init__.py").is_file())
#: Folders beside the installed packages, by the name under which they are imported.
CHECKOUT = {"studies": ROOT / "studies", "fault_injection": ROOT / "tests" / "fault_injection"}
HOMES = {package: ROOT / "src" / package / package for package in PACKAGES} | CHECKOUT

FOLDER_MODULES_MAX = 12
MODULE_LINES_MAX = 300
#: A module shorter than this has more than one importer, or is one that something outside of Python starts.
SMALL_MODULE_LINES = 40
#: Modules of this project that the focus controller's node may load at its start, __init__ counted too; what a request
#: or an action imports later is not among them.
NODE_MODULES_MAX = 45
#: Modules that a request passes from the callback of its topic to the command that is published.
WALK_MODULES_MAX = 8


def name_of(path: Path, home: str) -> str:
    """Name under which a module is imported."""
    parts = [home, *path.relative_to(HOMES[home]).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path, home): path for home in HOMES for path in sorted(HOMES[home].rglob("*.py"))}


@cache
def imports(module: str) -> set[str]:
    """Modules of this project that a module imports, anywhere in its text."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return (found & MODULES.keys()) - {module}


def is_package(module: str) -> bool:
    return MODULES[module].name == "__init__.py"


def folder(module: str) -> str:
    """The folder of a module, as a dotted name."""
    return module if is_package(module) else module.rpartition(".")[0]


@pytest.mark.slow
@pytest.mark.parametrize("package", PACKAGES)
def test_what_is_installed_needs_nothing_of_the_checkout(package: str) -> None:
    for module in (name for name in MODULES if name.split(".")[0] == package):
        others = {name for name in imports(module) if name.split(".")[0] in CHECKOUT}
        assert not others, f"{module} imports {others}"


def test_studies_do_not_need_the_fault_injection() -> None:
    for module in (name for name in MODULES if name.startswith("studies")):
        assert not {name for name in imports(module) if name.startswith("fault_injection")}, module


def loaded(module: str) -> set[str]:
    """All modules of this project that an import of `module` loads."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in found or name not in MODULES:
            continue
        found.add(name)
        waiting += [*imports(name), name.rpartition(".")[0]]
    return found


@pytest.mark.slow
def test_the_focus_controller_is_on_its_own() -> None:
    modules = loaded("dm_controller.focus_controller_node")
    assert {name.split(".")[0] for name in modules} == {"dm_common", "dm_controller"}
    # What a closed loop needs is loaded with its first goal.
    script = (
        "import sys, dm_controller.focus_controller_node;"
        "print(*(n for n in sys.modules if n.startswith('dm_') and not n.startswith('dm_msgs')))"
    )
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    started = [name for name in output.split() if name in MODULES]
    assert 0 < len(started) <= NODE_MODULES_MAX, sorted(started)


@pytest.mark.slow
def test_a_request_passes_few_modules_on_its_way_to_the_mirror() -> None:
    files = printed_by(WALKED, str(ROOT))["files"]
    assert "dm_controller/dm_controller/planning/planner.py" in files
    assert len(files) <= WALK_MODULES_MAX, files


@pytest.mark.slow
def test_the_calibration_node_starts_without_what_draws_reports() -> None:
    script = (
        "import sys, dm_calibration.calibration_node; "
        "print(*({'matplotlib', 'scipy.stats', 'statsmodels'} & {*sys.modules}))"
    )
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert not output.split()  # together they would double the time that it takes


@pytest.mark.parametrize("home", HOMES)
def test_folders_side_by_side_import_in_no_circle(home: str) -> None:
    needs: dict[str, set[str]] = {}
    for module in (name for name in MODULES if name.split(".")[0] == home):
        here = f"{folder(module)}."  # with the dot it begins the name of what lies in it and of no other
        others = {f"{folder(other)}." for other in imports(module) if other.split(".")[0] == home}
        needs.setdefault(here, set()).update(x for x in others if not x.startswith(here) and not here.startswith(x))
    TopologicalSorter(needs).prepare()  # raises CycleError, which names the circle


@pytest.mark.parametrize("home", HOMES)
def test_folders_hold_a_dozen_modules(home: str) -> None:
    counts = Counter(folder(name) for name in MODULES if name.split(".")[0] == home and not is_package(name))
    assert not {name for name, count in counts.items() if count > FOLDER_MODULES_MAX}


@pytest.mark.parametrize("home", HOMES)
def test_modules_can_be_read_at_one_sitting(home: str) -> None:
    lines = {name: len(MODULES[name].read_text().splitlines()) for name in MODULES if name.split(".")[0] == home}
    assert not {name for name, count in lines.items() if count > MODULE_LINES_MAX}


def test_small_modules_serve_more_than_one() -> None:
    importers = Counter(other for module in MODULES for other in imports(module))
    small = {
        name
        for name, path in MODULES.items()
        if len(path.read_text().splitlines()) < SMALL_MODULE_LINES and importers[name] == 1
        if not (is_package(name) or name.endswith("_node") or 'if __name__ == "__main__":' in path.read_text())
    }
    assert not small
