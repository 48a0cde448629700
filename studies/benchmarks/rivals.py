"""The programs with which the suite is compared: from the environment, else installed in a folder apart from it."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

#: Modules by the name of the package that provides them.
MODULES = {"prysm": "prysm.polynomials", "hcipy": "hcipy", "zernike": "zernike"}


def load(root: Path, install: bool, say: Callable[[str], None]) -> dict[str, ModuleType]:
    """Import the rivals that are available.

    Args:
        root: of the repository; missing packages go to its folder ``runs/bench-packages``, behind the environment's
            own packages on the path, so that NumPy and SciPy stay the pinned ones.
        install: whether to install what is missing.
        say: gets one line for each thing a user should know.

    Returns:
        Modules by package name; what is missing is left out.
    """
    folder = root / "runs" / "bench-packages"
    requirements = root / "requirements" / "bench.txt"
    if folder.is_dir() and str(folder) not in sys.path:
        sys.path.append(str(folder))
    found = _importable()
    if len(found) < len(MODULES) and install and requirements.is_file():
        say("installing the programs to compare with (once, some 400 MB) ...")
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--prefer-binary"]
        done = subprocess.run(
            [*command, "--target", str(folder), "-r", str(requirements)], check=False, capture_output=True, text=True
        )
        if done.returncode != 0:
            say(f"that failed: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
        elif str(folder) not in sys.path:
            sys.path.append(str(folder))
        importlib.invalidate_caches()
        found = _importable()
    missing = sorted(MODULES.keys() - found.keys())
    if missing:
        say(
            f"skipped, because they are not installed: {', '.join(missing)} (requirements/bench.txt names the versions)"
        )
    return found


def _importable() -> dict[str, Any]:
    found = {}
    for name, module in MODULES.items():
        try:
            found[name] = importlib.import_module(module)
        except ImportError:
            continue
    return found
