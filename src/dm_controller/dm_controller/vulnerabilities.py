"""Known vulnerabilities of installed packages, told by pip-audit, which asks the Python package index."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

#: Longest time to install pip-audit, and for its answer, s.
INSTALL_S, ANSWER_S = 120.0, 180.0
_MODULE = "pip_audit"


@dataclass(frozen=True)
class Vulnerability:
    """A known one: package, its version, the advisory's id, and the versions in which it is mended."""

    package: str
    version: str
    advisory: str
    mended_in: tuple[str, ...]


class NotAskedError(Exception):
    """Nobody could be asked; the message says why."""


def install(root: Path) -> Path:
    """The folder that holds pip-audit, installed when it is not there yet.

    Raises:
        NotAskedError: it cannot be installed.
    """
    folder = root / "runs" / "audit-packages"
    if (folder / _MODULE).is_dir():
        return folder
    wanted = root / "requirements" / "audit.txt"
    options = ["--quiet", "--disable-pip-version-check", "--timeout", "10", "--retries", "1"]
    command = [sys.executable, "-m", "pip", "install", *options, "--target", str(folder), "-r", str(wanted)]
    _run(command, dict(os.environ), INSTALL_S, "pip-audit cannot be installed")
    if not (folder / _MODULE).is_dir():
        raise NotAskedError("pip-audit cannot be installed: pip left nothing")
    return folder


def known_vulnerabilities(lock: str, folder: Path) -> tuple[list[Vulnerability], list[str]]:
    """The known vulnerabilities of the packages of a lock (lines `name==version`), and the packages it does not know.

    Args:
        folder: holds pip-audit.

    Raises:
        NotAskedError: no answer; most often for want of a network.
    """
    with tempfile.TemporaryDirectory(prefix="dm-audit-") as temporary:
        file = Path(temporary) / "lock.txt"
        file.write_text(lock)
        options = ["--no-deps", "--disable-pip", "--progress-spinner", "off", "--timeout", "10", "--format", "json"]
        command = [sys.executable, "-m", _MODULE, *options, "--requirement", str(file)]
        answer = _run(command, {**os.environ, "PYTHONPATH": str(folder)}, ANSWER_S, "pip-audit gave no answer")
    return parse_answer(answer)


def parse_answer(text: str) -> tuple[list[Vulnerability], list[str]]:
    """What pip-audit says, of its JSON: vulnerabilities, and names of the packages that nobody could tell about.

    Raises:
        NotAskedError: it is not such an answer, or nobody could tell about any package.
    """
    found: list[Vulnerability] = []
    unknown: list[str] = []
    try:
        packages = json.loads(text)["dependencies"]
        for package in packages:
            if "skip_reason" in package:
                unknown.append(str(package["name"]))
                continue
            for one in package["vulns"]:
                mended = tuple(map(str, one["fix_versions"]))
                found.append(Vulnerability(str(package["name"]), str(package["version"]), str(one["id"]), mended))
        if unknown and len(unknown) == len(packages):
            raise NotAskedError("the package index in use tells nothing about any package")
    except (ValueError, KeyError, TypeError) as error:
        raise NotAskedError(f"pip-audit gave no answer: {type(error).__name__}: {error}") from error
    return found, unknown


def _run(command: Sequence[str], environment: dict[str, str], limit_s: float, what: str) -> str:
    """Standard output of a command; a status that is not 0 matters only when there is none."""
    try:
        done = subprocess.run(
            command,
            env=environment,
            capture_output=True,
            text=True,
            timeout=limit_s,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired:
        raise NotAskedError(f"{what}: not done within {limit_s:g} s") from None
    if done.returncode and not done.stdout.strip():
        last = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise NotAskedError(f"{what}: {last[:200]}")
    return done.stdout
