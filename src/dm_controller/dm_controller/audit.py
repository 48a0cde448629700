"""Which packages the environment holds, and why: pinned by the requirements, or brought by one that is.

Looks at installed metadata only; nothing is asked from a network.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

from packaging.requirements import InvalidRequirement, Requirement
from packaging.utils import canonicalize_name

#: What makes an environment before anything is installed into it.
_TOOLS = frozenset({"pip"})
_PIN = re.compile(r"==[^*]+")


@dataclass(frozen=True)
class Audit:
    """What an audit found.

    Attributes:
        pinned: version by name of what the requirements name.
        brought: version by name of what those need; their versions are not pinned.
        findings: what is wrong, in words.
    """

    pinned: Mapping[str, str]
    brought: Mapping[str, str]
    findings: Sequence[str] = field(default_factory=tuple)

    def lock(self) -> str:
        """All of it as a constraints file for pip."""
        return "".join(f"{name}=={version}\n" for name, version in sorted({**self.brought, **self.pinned}.items()))


def read_pins(files: Iterable[Path]) -> tuple[list[Requirement], list[str]]:
    """The requirements of the files, and in words those that do not name exactly one version.

    Raises:
        OSError: a file cannot be read.
    """
    pins, findings = [], []
    for path in files:
        for line in path.read_text().splitlines():
            text = line.split("#")[0].strip()
            if not text:
                continue
            try:
                pin = Requirement(text)
            except InvalidRequirement as error:
                findings.append(f"{path.name}: {text}: {error}")
                continue
            if not _PIN.fullmatch(str(pin.specifier)):
                findings.append(f"{path.name}: {text}: must name one version, as in {pin.name}==1.0")
            pins.append(pin)
    return pins, findings


def audit(files: Iterable[Path], site_packages: Sequence[str]) -> Audit:
    """Compare the packages installed in `site_packages` with the requirements.

    Raises:
        OSError: a requirements file cannot be read.
    """
    pins, findings = read_pins(files)
    distributions = metadata.distributions(path=list(site_packages))
    installed: dict[str, metadata.Distribution] = {canonicalize_name(found.name): found for found in distributions}
    pinned: dict[str, str] = {}
    for pin in pins:
        found = installed.get(canonicalize_name(pin.name))
        if found is None:
            findings.append(f"{pin}: not installed")
            continue
        pinned[canonicalize_name(pin.name)] = found.version
        if not pin.specifier.contains(found.version, prereleases=True):
            findings.append(f"{pin}: version {found.version} is installed")
    needed = _needed(pins, installed)
    inside = _inside_others(installed)
    for name in sorted(set(installed) - needed - inside - _TOOLS):
        findings.append(
            f"{name}=={installed[name].version}: installed, but neither pinned nor needed by what is pinned"
        )
    brought = {name: installed[name].version for name in needed - set(pinned) if name in installed}
    return Audit(pinned, brought, tuple(findings))


def _needed(pins: Sequence[Requirement], installed: Mapping[str, metadata.Distribution]) -> set[str]:
    """Names of the pinned packages and of all that they need, with the extras that are asked for."""
    seen: set[tuple[str, str]] = set()
    waiting: list[tuple[str, str]]
    waiting = [(canonicalize_name(pin.name), extra) for pin in pins for extra in ("", *pin.extras)]
    while waiting:
        name, extra = waiting.pop()
        if (name, extra) in seen or name not in installed:
            continue
        seen.add((name, extra))
        for text in installed[name].requires or ():
            need = Requirement(text)
            if need.marker is None or need.marker.evaluate({"extra": extra}):
                waiting += [(canonicalize_name(need.name), inner) for inner in ("", *need.extras)]
    return {name for name, _extra in seen}


def _inside_others(installed: Mapping[str, metadata.Distribution]) -> set[str]:
    """Names of packages that came as files of another one: ROS 2 wheels hold several Python packages each."""
    folders = {folder: name for name, found in installed.items() if (folder := _folder(found))}
    inside = set()
    for name, found in installed.items():
        for file in found.files or ():
            owner = next((folders[part] for part in file.parts if part in folders), name)
            if owner != name:
                inside.add(owner)
    return inside


def _folder(found: metadata.Distribution) -> str:
    """Name of the folder that holds a package's metadata."""
    return str(getattr(found, "_path", Path()).name)
