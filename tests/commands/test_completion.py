"""Shell completion of `./dm`: the script that a shell loads, and the words it offers."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SHELL = shutil.which("bash") or ""

pytestmark = [pytest.mark.processes, pytest.mark.skipif(not SHELL, reason="no bash here")]


def in_bash(script: str, home: Path, folder: Path) -> str:
    environment = {**os.environ, "HOME": str(home), "DM": str(ROOT / "dm")}
    done = subprocess.run(
        [SHELL, "--norc", "-c", script + "\nexit $?"],
        capture_output=True,
        text=True,
        cwd=folder,
        env=environment,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


#: What bash does at the press of the Tab key behind the words in WORDS.
PRESS_TAB = """
eval "$("$DM" --show-completion)"
function=$(complete -p dm | sed 's/.*-F \\([^ ]*\\) .*/\\1/')
COMP_WORDS=($WORDS); COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
$function "${COMP_WORDS[0]}"
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("cal", {"calibrate"}),
        ("re", {"recipes", "report", "record", "replay"}),
        ("calibrate --hys", {"--hysteresis"}),
        ("demo --hysteresis pr", {"prandtl_ishlinskii", "preisach"}),
    ],
)
def test_words_are_offered_from_any_folder(tmp_path: Path, words: str, offered: set[str]) -> None:
    assert set(in_bash(f"WORDS='{ROOT}/dm {words}'\n{PRESS_TAB}", tmp_path, tmp_path).split()) == offered


def test_a_relative_path_is_completed_too(tmp_path: Path) -> None:
    assert in_bash(f"WORDS='./dm doc'\n{PRESS_TAB}", tmp_path, ROOT).split() == ["doctor"]


def test_a_link_on_the_path_serves_as_well(tmp_path: Path) -> None:
    (tmp_path / "dm").symlink_to(ROOT / "dm")
    assert in_bash(f"PATH={tmp_path}:$PATH\nWORDS='dm doc'\n{PRESS_TAB}", tmp_path, tmp_path).split() == ["doctor"]


def test_it_installs_itself_for_the_shell_that_asks(tmp_path: Path) -> None:
    assert "completion installed" in in_bash('"$DM" --install-completion', tmp_path, tmp_path)
    assert "bash_completions/dm.sh" in (tmp_path / ".bashrc").read_text()
    script = tmp_path / ".bash_completions" / "dm.sh"
    assert "complete" in script.read_text()


def test_an_unprepared_checkout_offers_nothing_and_sets_nothing_up(tmp_path: Path) -> None:
    shutil.copy(ROOT / "dm", tmp_path / "dm")
    (tmp_path / "requirements").mkdir()
    for name in ("ros.txt", "python.txt"):
        (tmp_path / "requirements" / name).touch()
    (tmp_path / "src" / "dm_msgs").mkdir(parents=True)
    said = in_bash("_DM_COMPLETE=complete_bash COMP_WORDS='dm c' COMP_CWORD=1 ./dm", tmp_path, tmp_path)
    assert said == ""
    assert not (tmp_path / ".venv").exists()
