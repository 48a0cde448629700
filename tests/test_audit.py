"""The environment beside its requirements, and what an audit must find."""

from __future__ import annotations

import os
import sys
import sysconfig
from pathlib import Path

import pytest

from dm_controller.audit import audit, read_pins
from dm_controller.cli.audit import requirement_files
from dm_controller.vulnerabilities import NotAskedError, Vulnerability, known_vulnerabilities, parse_answer

ROOT = Path(__file__).resolve().parents[1]


def package(folder: Path, name: str, version: str, *needs: str) -> None:
    """An installed package without content."""
    info = folder / f"{name}-{version}.dist-info"
    info.mkdir()
    lines = [
        "Metadata-Version: 2.1",
        f"Name: {name}",
        f"Version: {version}",
        *(f"Requires-Dist: {need}" for need in needs),
    ]
    (info / "METADATA").write_text("\n".join(lines) + "\n")
    (info / "RECORD").write_text(f"{info.name}/METADATA,,\n")


def wanted(folder: Path, *lines: str) -> Path:
    path = folder / "wanted.txt"
    path.write_text("# comment\n\n" + "\n".join(lines) + "\n")
    return path


def test_the_environment_holds_what_is_pinned_and_nothing_else() -> None:
    found = audit(requirement_files(ROOT), [sysconfig.get_path("purelib")])
    assert found.findings == ()
    assert len(found.pinned) >= 20


def test_every_requirements_file_names_versions() -> None:
    files = [path for path in (ROOT / "requirements").glob("*.txt") if path.name != "sourced-ros.txt"]
    assert len(files) >= 4
    assert read_pins(files)[1] == []


def test_packages_beyond_the_pins_are_found(tmp_path: Path) -> None:
    package(tmp_path, "one", "1.0", "two[fast]>=1")
    package(tmp_path, "two", "2.0", "three; extra == 'fast'", "four; extra == 'slow'")
    package(tmp_path, "three", "3.0")
    package(tmp_path, "four", "4.0")
    found = audit([wanted(tmp_path, "one==1.0")], [str(tmp_path)])
    assert found.findings == ("four==4.0: installed, but neither pinned nor needed by what is pinned",)
    assert found.brought == {"two": "2.0", "three": "3.0"}
    assert found.lock() == "one==1.0\nthree==3.0\ntwo==2.0\n"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("one", "one: must name one version, as in one==1.0"),
        ("one>=1.0", "must name one version"),
        ("one==1.*", "must name one version"),
        ("one==2.0", "one==2.0: version 1.0 is installed"),
        ("two==1.0", "two==1.0: not installed"),
        ("one = 1", "wanted.txt: one = 1"),
    ],
)
def test_what_is_not_pinned_or_not_as_pinned_is_named(tmp_path: Path, line: str, words: str) -> None:
    package(tmp_path, "one", "1.0")
    assert words in " ".join(audit([wanted(tmp_path, line)], [str(tmp_path)]).findings)


def test_answers_of_pip_audit() -> None:
    text = '{"dependencies": [{"name": "a", "version": "1", "vulns": [{"id": "X-1", "fix_versions": ["2"]}]}]}'
    assert parse_answer(text) == ([Vulnerability("a", "1", "X-1", ("2",))], [])
    silent = '{"name": "b", "skip_reason": "no such package"}'
    assert parse_answer(text.replace("[{", f"[{silent}, {{", 1))[1] == ["b"]
    with pytest.raises(NotAskedError, match="tells nothing about any package"):
        parse_answer(f'{{"dependencies": [{silent}]}}')
    with pytest.raises(NotAskedError, match="gave no answer"):
        parse_answer("<html>")


def test_without_pip_audit_nobody_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(os.environ, "PYTHONPATH", "")
    assert not any((Path(entry) / "pip_audit").exists() for entry in sys.path)
    with pytest.raises(NotAskedError, match="No module named"):
        known_vulnerabilities("one==1.0\n", tmp_path)
