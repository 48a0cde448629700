"""Whether a node that one waits for has died, or was started anew meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from dm_msgs.msg import MirrorInfo

from dm_common.ros import qos
from dm_common.ros.qos import Liveliness


class Watched(Liveliness):
    """The publishers of a topic as DDS counts them."""

    def __init__(self) -> None:
        node: Any = SimpleNamespace(create_subscription=lambda *_arguments, **_keywords: None)
        super().__init__(node, "pdm_driver", MirrorInfo, "mirror_info", qos.LATCHED)
        self.alive = self.not_alive = 0

    def change(self, alive: int, not_alive: int) -> None:
        """So many more, or fewer, than before."""
        self.alive, self.not_alive = self.alive + alive, self.not_alive + not_alive
        info = SimpleNamespace(alive_count=self.alive, not_alive_count=self.not_alive)
        info.alive_count_change, info.not_alive_count_change = alive, not_alive
        self._on_change(info)


class Time:
    """Stands still but for `sleep`; what is due `at` a time is done then."""

    def __init__(self) -> None:
        self.now = 100.0
        self.at: dict[float, Callable[[], None]] = {}

    def monotonic(self) -> float:
        return self.now

    def sleep(self, duration: float) -> None:
        self.now += duration
        for due in [due for due in self.at if due <= self.now]:
            self.at.pop(due)()


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    time = Time()
    monkeypatch.setattr(qos, "time", time)
    return time


@pytest.fixture
def watched(time: Time) -> Watched:
    return Watched()


def test_a_node_that_comes_at_last_is_what_was_waited_for(watched: Watched) -> None:
    lost_reason = watched.since_now()
    watched.change(1, 0)
    assert lost_reason() == "" and not watched.lost


def test_a_dead_node_is_missing_within_two_seconds_and_a_stall_is_forgiven(watched: Watched, time: Time) -> None:
    """The lease lapses at most LEASE_S after the node said last that it lives; those who wait look often."""
    watched.change(1, 0)
    time.now += qos.LEASE_S
    watched.change(-1, 1)
    assert watched.lost and not watched.missing()
    time.now = 101.9
    assert watched.missing()


def test_a_node_whose_messages_come_lives_though_its_lease_lapsed(watched: Watched, time: Time) -> None:
    watched.change(1, 0)
    time.now += qos.LEASE_S
    watched.change(-1, 1)
    for _ in range(6):
        time.now += 0.5
        watched.heard()
        assert not watched.missing()
    time.now += qos.LEASE_S + 0.1
    assert watched.missing()


def test_a_call_waits_for_a_node_that_others_know_to_be_back(watched: Watched, time: Time) -> None:
    """The controller knew the driver that was started again, the calibration refused: it had died."""
    watched.change(1, 0)
    watched.wait_for_return()
    assert time.now == 100.0
    watched.change(-1, 1)
    time.now += 10.0
    time.at[110.5] = lambda: watched.change(1, 0)
    watched.wait_for_return()
    lost_reason = watched.since_now()
    assert lost_reason() == "" and time.now >= 110.5
    watched.change(-1, 1)
    began = time.now = 120.0
    watched.wait_for_return()
    assert watched.missing() and time.now - began < 2.0


@pytest.mark.parametrize("lapsed_before", [False, True])
def test_a_node_that_was_started_anew_within_its_lease_counts_as_gone(watched: Watched, lapsed_before: bool) -> None:
    watched.change(1, 0)
    lost_reason = watched.since_now()
    if lapsed_before:
        watched.change(-1, 1)
    watched.change(1, 0)
    assert not watched.missing()
    assert lost_reason() == "the node pdm_driver was restarted meanwhile: ask again"
    assert watched.since_now()() == ""


def test_a_lease_that_lapses_on_a_busy_machine_is_no_new_start(watched: Watched) -> None:
    watched.change(1, 0)
    lost_reason = watched.since_now()
    watched.change(-1, 1)
    assert watched.lost
    watched.change(1, -1)
    assert not watched.lost and lost_reason() == ""


def test_a_node_whose_coming_was_not_heard_of_has_died_all_the_same(watched: Watched) -> None:
    """It may come before the executor listens."""
    watched.alive = 1
    watched.change(-1, 1)
    assert watched.lost and watched.text.startswith("the node pdm_driver has died")
    lost_reason = watched.since_now()
    watched.change(1, 0)
    assert lost_reason() == "the node pdm_driver was restarted meanwhile: ask again"


def test_a_process_watches_a_topic_once() -> None:
    """Two subscriptions with a lease make Fast DDS take a living publisher for dead once it forgets a killed one."""
    made: list[str] = []

    class Stub:
        def create_subscription(self, _type: Any, topic: str, *_arguments: Any, **_keywords: Any) -> None:
            made.append(topic)

    node: Any = Stub()
    watches = [qos.watch(node, "pdm_driver", MirrorInfo, "mirror_info", qos.LATCHED) for _ in range(2)]
    assert watches[0] is watches[1] and made == ["mirror_info"]
