"""Whose goal runs, from status and feedback in any order."""

from __future__ import annotations

import time
from typing import Any

import pytest
from dm_msgs.action import Calibrate

from console_stand_in import EXECUTING, SUCCEEDED, FakeNode, Goal
from dm_tools.long_actions import ExternalGoals


def watched() -> tuple[ExternalGoals, FakeNode]:
    node: Any = FakeNode()
    return ExternalGoals(node, Calibrate, "calibrate"), node


def test_a_goal_of_this_console_is_not_elsewhere() -> None:
    watch, node = watched()
    goal = Goal(node, 1)
    watch.own(goal.identity)
    goal.publish_status(EXECUTING)
    goal.feed(1, 2e-9)
    assert not watch.running
    assert watch.residuals == [2e-9]


def test_a_goal_of_somebody_else_is_seen_until_it_ends() -> None:
    watch, node = watched()
    goal = Goal(node, 2)
    goal.feed(1, 2e-9)
    assert watch.running
    goal.publish_status(SUCCEEDED)
    goal.feed(2, 3e-9)  # feedback that comes late
    assert not watch.running


def test_a_goal_whose_node_has_gone_has_ended() -> None:
    watch, node = watched()
    Goal(node, 3).publish_status(EXECUTING)
    assert watch.running
    node.servers = []
    assert not watch.running


def test_a_goal_that_says_nothing_for_long_still_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """While it fits, or waits for a map that somebody saves by hand."""
    watch, node = watched()
    Goal(node, 3).publish_status(EXECUTING)
    later = time.monotonic() + 3600.0
    monkeypatch.setattr(time, "monotonic", lambda: later)
    assert watch.running


def test_a_node_that_was_started_again_knows_nothing_of_the_goals_of_before() -> None:
    watch, node = watched()
    Goal(node, 3).publish_status(EXECUTING)
    assert watch.running
    node.servers = ["first", "second"]  # who was killed is forgotten later
    assert watch.running
    node.servers = ["second"]
    assert not watch.running and watch.cancel() is None
    Goal(node, 4).publish_status(EXECUTING)
    assert watch.running


def test_residuals_stay_until_the_next_run_tells_its_first() -> None:
    watch, node = watched()
    first, second = Goal(node, 4), Goal(node, 5)
    first.feed(1, 2e-9)
    first.feed(1, 2e-9)  # the same map
    first.feed(2, 3e-9)
    first.publish_status(SUCCEEDED)
    second.publish_status(EXECUTING)
    assert watch.residuals == [2e-9, 3e-9]
    second.feed(1, 4e-9)
    assert watch.residuals == [4e-9]


def test_the_goal_that_runs_is_the_one_that_is_cancelled() -> None:
    watch, node = watched()
    watch.cancel()
    assert not hasattr(node, "asked")
    Goal(node, 6).publish_status(EXECUTING)
    watch.cancel()
    assert list(node.asked.goal_info.goal_id.uuid) == [6] * 16  # type: ignore[attr-defined]
