"""The node `calibration` that gets stuck at one place, to be killed there: `python stuck_calibration.py PLACE`."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from typing import Any

from dm_calibration import calibration_action, calibration_manager, calibration_node
from dm_calibration.procedure import run_journal
from dm_calibration.store import calibration_store as store

#: What is printed when the place is reached.
MARK = "stuck at "


def stuck(place: str) -> None:
    print(f"{MARK}{place}", flush=True)
    time.sleep(600.0)


def before(place: str, good: Callable[..., Any]) -> Callable[..., Any]:
    """`good`, never reached."""

    def wrapped(*arguments: Any, **named: Any) -> Any:
        stuck(place)
        return good(*arguments, **named)

    return wrapped


def after(place: str, good: Callable[..., Any]) -> Callable[..., Any]:
    """`good`, from which nothing returns."""

    def wrapped(*arguments: Any, **named: Any) -> Any:
        result = good(*arguments, **named)
        stuck(place)
        return result

    return wrapped


def half_a_frame(handle: int, content: bytes, position: int) -> int:
    """The tenth frame gets half way to the disk."""
    half_a_frame.frames += 1  # type: ignore[attr-defined]
    if half_a_frame.frames < 12:  # type: ignore[attr-defined]
        return WRITE(handle, content, position)
    WRITE(handle, bytes(content)[: len(content) // 2], position)
    stuck("frame")
    return 0


WRITE = os.pwrite
half_a_frame.frames = 0  # type: ignore[attr-defined]


def main(place: str) -> int:
    match place:
        case "fit":
            calibration_action.calibrate = before(place, calibration_action.calibrate)
        case "before_store":
            store.write_whole = before(place, store.write_whole)
        case "after_store":
            store.write_whole = after(place, store.write_whole)
        case "read_back":
            calibration_manager.raw_hash = before(place, calibration_manager.raw_hash)
        case "frame":
            run_journal.os = type("Os", (), {**vars(os), "pwrite": staticmethod(half_a_frame)})  # type: ignore[assignment]
    return calibration_node.main()


if __name__ == "__main__":
    sys.exit(main(sys.argv.pop(1)))
