"""Segments of killed nodes are removed, those of living ones are not."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dm_common.ros.executor import SHARED_MEMORY, remove_orphaned_segments

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
