"""Nodes do without shared memory; segments of killed ones are removed, those of living ones are not."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dm_common.ros.shared_memory import PROFILE, RANGE, SHARED_MEMORY, remove_orphaned_segments, use_udp_alone

NODE = "import rclpy; rclpy.init(domain_id={}); node = rclpy.create_node('a'); print('ready', flush=True); input()"
OWN_LOCK = re.compile("fastrtps_[0-9a-f]{16}_el")


@contextmanager
def running_node(domain: int) -> Iterator[tuple[subprocess.Popen[str], set[Path]]]:
    """A process with a participant, and the segments that are its own."""
    command = [sys.executable, "-c", NODE.format(domain)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            opened = [file.resolve().name for file in Path(f"/proc/{process.pid}/fd").iterdir()]
            segments = {SHARED_MEMORY / name.removesuffix("_el") for name in opened if OWN_LOCK.fullmatch(name)}
            assert segments
            yield process, segments
        finally:
            process.kill()


def test_segments_go_after_their_process_was_killed(domain: int) -> None:
    with running_node(domain) as (process, segments):
        remove_orphaned_segments(0.0)
        process.kill()
        process.wait()
        remove_orphaned_segments()  # may be of a process that has not locked them yet
        assert all(segment.exists() for segment in segments)
        remove_orphaned_segments(0.0)
        assert not any(segment.exists() or segment.with_name(f"{segment.name}_el").exists() for segment in segments)


@pytest.mark.parametrize(
    ("given", "reach", "profile", "alone"),
    [
        ("LOCALHOST", "SYSTEM_DEFAULT", "fastdds.xml", "fastdds_udp_local.xml"),
        ("SUBNET", "SUBNET", "fastdds.xml", "fastdds_udp.xml"),
        ("LOCALHOST", "LOCALHOST", "of_the_user.xml", "of_the_user.xml"),
    ],
)
def test_a_process_takes_the_profile_without_shared_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str, reach: str, profile: str, alone: str
) -> None:
    for name in (profile, "fastdds_udp.xml", "fastdds_udp_local.xml"):
        (tmp_path / name).touch()
    monkeypatch.setenv(PROFILE, str(tmp_path / profile))
    monkeypatch.setenv(RANGE, given)
    use_udp_alone()
    assert (os.environ[RANGE], os.environ[PROFILE]) == (reach, str(tmp_path / alone))


@pytest.mark.parametrize("profile", ["", "/nowhere/fastdds.xml"])
def test_without_the_profiles_of_the_suite_all_stays(monkeypatch: pytest.MonkeyPatch, profile: str) -> None:
    monkeypatch.setenv(PROFILE, profile)
    monkeypatch.setenv(RANGE, "LOCALHOST")
    use_udp_alone()
    assert (os.environ[RANGE], os.environ[PROFILE]) == ("LOCALHOST", profile)
