"""The driver's health on /diagnostics."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from dm_common.errors import ErrorCode, Refusal
from dm_common.ros.lifecycle import ERROR, OK, WARN
from dm_driver.driver_health import driver_health


@pytest.mark.parametrize(
    ("changed", "level", "words"),
    [
        ({}, OK, "active"),
        ({"history_known": False}, WARN, "history is not known"),
        ({"enabled": False}, WARN, "inactive"),
        ({"link_up": False, "fault": "no route"}, ERROR, "no route"),
        (
            {"unrecorded": "the disk is full"},
            WARN,
            "the disk is full; if the driver is killed, its next start moves in one step",
        ),
        ({"refusal": Refusal(ErrorCode.BUSY, "held")}, WARN, "the last command was refused: held"),
        ({"refusal": Refusal(ErrorCode.BUSY, "held"), "enabled": False}, WARN, "inactive"),
        ({"refusal": Refusal(ErrorCode.ELECTRONICS_UNREACHABLE, "unplugged")}, OK, "active"),
    ],
)
def test_health_is_good_only_where_nothing_is_missing(changed: dict[str, Any], level: bytes, words: str) -> None:
    state = {"link_up": True, "enabled": True, "history_known": True, "moving": None, "fault": ""} | changed
    counters = SimpleNamespace(frames=0, link_losses=0, reconnects=0, overtaken=0, overruns=0)
    unrecorded = state.pop("unrecorded", "")
    writer: Any = SimpleNamespace(state=lambda: SimpleNamespace(**state), counters=counters, unrecorded=unrecorded)
    health = driver_health(writer, state.pop("refusal", None), {})
    assert health.level == level and words in health.message


def test_a_command_does_not_hide_why_the_configuration_was_refused() -> None:
    refused = Refusal(ErrorCode.DRIVER_INACTIVE, "the driver is not configured")
    health = driver_health(None, refused, {"DRIVER_INACTIVE": 1}, "volts.max = 900 V")
    assert health.level == ERROR and health.message == "volts.max = 900 V"
