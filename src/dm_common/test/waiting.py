"""Waiting for something that other threads or processes do."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any


def wait_until(condition: Callable[[], Any], timeout_s: float = 60.0, what: str = "") -> Any:
    """Return the first true value of `condition()`; fail the test when there is none in time.

    A condition on the last of some messages is not true while none has arrived (IndexError). What takes long is asked
    for ever more rarely, at least ten times a second, so that waiting costs little.
    """
    began, nothing = time.monotonic(), None
    while (waited := time.monotonic() - began) < timeout_s:
        try:
            value, nothing = condition(), None
        except IndexError as error:
            value, nothing = None, error
        if value:
            return value
        time.sleep(min(0.01 + 0.02 * waited, 0.1))
    raise AssertionError(f"not within {timeout_s:g} s: {what or condition}") from nothing
