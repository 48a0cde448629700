"""Nodes do without shared memory; segments of killed ones are removed, those of living ones are not."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dm_common.ros import shared_memory
from dm_common.ros.shared_memory import (
    PEERS,
    PROFILE,
    RANGE,
    SHARED_MEMORY,
    UDP,
    UDP_LOCAL,
    WHOLE,
    remove_orphaned_segments,
    use_udp_alone,
)

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
        assert all(segment.exists() for segment in segments)
        process.kill()
        process.wait()
        remove_orphaned_segments(0.0)
        assert not any(segment.exists() or segment.with_name(f"{segment.name}_el").exists() for segment in segments)


@pytest.mark.parametrize(
    ("passed_s", "stays"), [(0.0, True), (1.9, True), (2.1, False), (-1.9, True), (-3600.0, False)]
)
def test_segments_go_at_an_age_at_which_a_living_process_has_locked_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, passed_s: float, stays: bool
) -> None:
    """The clock may have been set back since the segment was made."""
    left = [tmp_path / "fastrtps_0123456789abcdef_el", tmp_path / "fastrtps_0123456789abcdef"]
    for file in left:
        file.touch()
    now = left[0].stat().st_mtime + passed_s
    monkeypatch.setattr(shared_memory, "SHARED_MEMORY", tmp_path)
    monkeypatch.setattr(shared_memory.time, "time", lambda: now)
    remove_orphaned_segments()
    assert [file.exists() for file in left] == [stays, stays]


@pytest.mark.parametrize(
    ("given", "reach", "profile", "alone"),
    [
        ("LOCALHOST", "SYSTEM_DEFAULT", WHOLE, UDP_LOCAL),
        ("SUBNET", "SUBNET", WHOLE, UDP),
        ("LOCALHOST", "SYSTEM_DEFAULT", UDP, UDP_LOCAL),
        ("LOCALHOST", "SYSTEM_DEFAULT", UDP_LOCAL, UDP_LOCAL),
        ("LOCALHOST", "LOCALHOST", "of_the_user.xml", "of_the_user.xml"),
    ],
)
def test_a_process_takes_the_profile_without_shared_memory(
    environment: Callable[..., dict[str, str]], given: str, reach: str, profile: str, alone: str
) -> None:
    assert environment(given, profile) == {RANGE: reach, PROFILE: alone}


def test_with_peers_or_another_middleware_nodes_stay_as_they_were_told(
    environment: Callable[..., dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A Fast DDS profile keeps no other middleware to the machine, and only LOCALHOST and SUBNET heed peers."""
    expected = {RANGE: "LOCALHOST", PROFILE: WHOLE}
    monkeypatch.setenv(PEERS, "192.168.3.4")
    assert environment("LOCALHOST", WHOLE) == expected
    assert environment("SUBNET", WHOLE) == {RANGE: "SUBNET", PROFILE: UDP}
    monkeypatch.delenv(PEERS)
    monkeypatch.setattr(shared_memory, "get_rmw_implementation_identifier", lambda: "rmw_cyclonedds_cpp")
    assert environment("LOCALHOST", WHOLE) == expected


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, str]]:
    """What a process takes that is given this range and this profile, among those of the suite."""
    monkeypatch.delenv(PEERS, raising=False)

    def environment(given: str, profile: str) -> dict[str, str]:
        for name in (profile, WHOLE, UDP, UDP_LOCAL):
            (tmp_path / name).touch()
        monkeypatch.setenv(PROFILE, str(tmp_path / profile))
        monkeypatch.setenv(RANGE, given)
        use_udp_alone()
        return {RANGE: os.environ[RANGE], PROFILE: Path(os.environ[PROFILE]).name}

    return environment


@pytest.mark.parametrize("profile", ["", "/nowhere/fastdds.xml"])
def test_without_the_profiles_of_the_suite_all_stays(monkeypatch: pytest.MonkeyPatch, profile: str) -> None:
    monkeypatch.setenv(PROFILE, profile)
    monkeypatch.setenv(RANGE, "LOCALHOST")
    use_udp_alone()
    assert (os.environ[RANGE], os.environ[PROFILE]) == ("LOCALHOST", profile)
