"""The tracker: what the driver reports decides what is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_common.hysteresis.creep_record import UNSEEN
from dm_common.hysteresis.observer import HysteresisObserver, HysteresisTracker
from dm_common.mirror import Applied
from example_hysteresis import rich

LAW = rich()
A, B, C = (np.array(signals) for signals in ([0.5, -0.2], [-0.3, 0.8], [0.1, 0.0]))
REST = np.zeros(2)


def report(
    time: float, signals: np.ndarray, turns: int = 0, turned_at: np.ndarray | None = None, **changes: object
) -> Applied:
    return replace(Applied(time, signals, turns, turned_at, 1, True), **changes)  # type: ignore[arg-type]


@pytest.fixture
def tracker() -> HysteresisTracker:
    """One that has seen a degauss."""
    tracker = HysteresisTracker(LAW)
    tracker.observe(report(0.0, REST, degausses=0, history_known=False))
    tracker.observe(report(1.0, REST, turns=1, turned_at=REST))
    assert not tracker.unknown
    return tracker


def test_before_a_degauss_nothing_is_known() -> None:
    tracker = HysteresisTracker(LAW)
    assert tracker.unknown
    tracker.observe(report(0.0, A, degausses=0, history_known=False))
    assert "before this node" in tracker.unknown
    tracker.observe(report(1.0, B, 1, A, degausses=0, history_known=False))
    assert "before this node" in tracker.unknown  # that is why, and not that writes were lost


def test_moves_are_followed(tracker: HysteresisTracker) -> None:
    start = tracker.state
    assert start is not None and tracker.state is not None
    tracker.observe(report(2.0, A, 2, REST))
    tracker.observe(report(3.0, B, 3, A))
    expected = LAW.move(LAW.move(start, A, 2.0), B, 3.0)
    np.testing.assert_allclose(tracker.state.position, expected.position, atol=1e-12)
    assert not tracker.unknown


def test_one_turn_may_be_missed(tracker: HysteresisTracker) -> None:
    start = tracker.state
    assert start is not None and tracker.state is not None
    tracker.observe(report(3.0, B, 2, A))
    np.testing.assert_allclose(tracker.state.position, LAW.move(LAW.move(start, A, 3.0), B, 3.0).position, atol=1e-12)
    assert not tracker.unknown


@pytest.mark.parametrize(("missed", "text"), [(2, "2 turns were not seen"), (1, "a turn was not seen")])
def test_missed_turns_are_noticed_and_the_first_reason_stays(
    tracker: HysteresisTracker, missed: int, text: str
) -> None:
    tracker.observe(report(3.0, C, 2 + missed, B))
    assert tracker.unknown == text
    tracker.observe(report(4.0, A, 12, B))
    assert tracker.unknown == text


def test_a_degauss_cures(tracker: HysteresisTracker) -> None:
    tracker.observe(report(3.0, C, 9, B))
    assert tracker.unknown
    tracker.observe(report(9.0, REST, 10, REST, degausses=2))
    assert not tracker.unknown and tracker.state is not None
    np.testing.assert_array_equal(tracker.state.play, LAW.demagnetised(2, 9.0).play)


def test_a_move_after_a_degauss_of_which_the_end_was_not_seen_is_not_known(tracker: HysteresisTracker) -> None:
    """The degauss may end in any shape: here it ended in B, then the mirror went to A."""
    tracker.observe(report(3.0, C, 1, REST, moving=True, history_known=False, requested=B))
    tracker.observe(report(9.0, A, 3, A, degausses=2))
    assert "after the degauss" in tracker.unknown


@pytest.mark.parametrize(
    "later",
    [
        report(3600.0, C, 4, B),
        report(3600.0, C, 2, B),
        report(3600.0, C, 2, B, history_known=False, moving=True),
        report(3600.0, C, 4, B, degausses=2),
    ],
)
def test_how_long_a_shape_was_held_that_no_report_showed_is_not_known(
    tracker: HysteresisTracker, later: Applied
) -> None:
    """The link to the driver is lost for an hour, in which another program uses the mirror."""
    tracker.observe(later)
    assert tracker.state is not None
    minutes = LAW.creep_time < 600.0
    assert tracker.state.crept_sigma[minutes] == pytest.approx(UNSEEN, rel=0.01)


@pytest.mark.parametrize("time, turned_at", [(3600.0, REST), (1.03, A)])
def test_a_shape_that_is_left_from_where_it_was_seen_or_at_once_leaves_no_doubt(
    tracker: HysteresisTracker, time: float, turned_at: np.ndarray
) -> None:
    """After minutes at rest bounds were four times as wide; at thirty requests a second moves turn on their way."""
    before = tracker.state
    tracker.observe(report(time, C, 2, turned_at))
    assert before is not None and tracker.state is not None
    np.testing.assert_allclose(tracker.state.crept_sigma, LAW.advance(before, time).crept_sigma)


def test_a_clock_that_jumps_in_a_degauss_leaves_creep_in_doubt() -> None:
    observer = HysteresisObserver()
    observer.use(LAW, 0.0)
    observer.observe(report(0.0, A, heard=0.0))
    observer.observe(report(9.0, REST, moving=True, history_known=False, heard=9.0))
    observer.observe(report(3610.0, B, moving=True, history_known=False, heard=3610.0), doubtful=3600.0)
    observer.observe(report(3612.0, REST, 1, REST, degausses=2, heard=3612.0))
    assert observer.state is not None and not observer.unknown
    assert observer.state.crept_sigma[np.searchsorted(LAW.creep_time, 300.0)] > 0.9 * UNSEEN


def test_time_passes_once_if_a_clock_that_ran_ahead_is_set_back_by_less() -> None:
    """The next report may still have the stamp of a write of before both."""
    observer = HysteresisObserver()
    observer.use(LAW, 0.0)
    observer.observe(report(0.0, A, heard=10.0))
    observer.observe(report(0.0, A, heard=7210.0), doubtful=7200.0)
    observer.observe(report(0.0, A, history_known=False, heard=3620.0))
    observer.observe(report(3620.0, B, history_known=False, heard=3620.0))
    assert observer.state is not None
    assert observer.state.crept_sigma[np.searchsorted(LAW.creep_time, 300.0)] > 0.9 * UNSEEN


@pytest.mark.parametrize("follow_later", [False, True])
def test_a_driver_that_knows_no_signals_yet_begins_its_counts_anew(follow_later: bool) -> None:
    """No report of it is heard after that before its counts have passed those of the driver before it."""
    observer = HysteresisObserver()
    if not follow_later:
        observer.use(LAW, 0.0)
    observer.observe(report(0.0, REST, degausses=0, history_known=False, heard=0.0))
    observer.observe(report(1.0, REST, 1, REST, heard=600.0))
    for heard in (700.0, 701.0):
        nothing = report(0.0, np.zeros(0), degausses=0, history_known=False, active=False, heard=heard)
        observer.observe(nothing)
    observer.observe(report(3600.0, A, 2, B, heard=3600.0))
    observer.use(LAW, 0.0)
    assert observer.unknown and observer.state is not None
    assert observer.state.crept_sigma[np.searchsorted(LAW.creep_time, 300.0)] == pytest.approx(UNSEEN, rel=0.01)
    observer.observe(report(3610.0, REST, 3, REST, degausses=2, heard=3610.0))
    assert not observer.unknown


def test_creep_before_a_degauss_is_kept_if_no_swing_was_seen(tracker: HysteresisTracker) -> None:
    """The shape was held until the last report, however long before the move to it began."""
    tracker.observe(report(10.0, 0.1 * A, 2, REST, moving=True, requested=A))
    tracker.observe(report(10.5, A, 2, REST))
    assert tracker.state is not None
    held = tracker.state
    tracker.last = report(10.5, A, 2, REST, heard=3600.0)  # as the observer does with reports that repeat the last
    tracker.observe(report(3605.0, REST, 3, REST, degausses=2))
    expected = LAW.advance(LAW.degaussed(held, 3600.0), 3605.0)
    np.testing.assert_allclose(LAW.effective(tracker.state), LAW.effective(expected), atol=1e-12)
    assert not tracker.unknown


def test_lost_writes_are_noticed(tracker: HysteresisTracker) -> None:
    tracker.observe(report(2.0, A, 2, REST, history_known=False))
    assert "writes were lost" in tracker.unknown


def test_another_activation_begins_anew(tracker: HysteresisTracker) -> None:
    tracker.observe(report(2.0, A, 0, None, degausses=0, history_known=False))
    assert "activated again" in tracker.unknown
    tracker.observe(report(3.0, B, 1, A, degausses=0, history_known=False))
    assert "activated again" in tracker.unknown


def test_a_driver_activated_again_is_noticed_by_its_writes() -> None:
    """Its moves and degausses may have passed those of before until a report of it is heard."""
    observer = HysteresisObserver()
    observer.use(LAW, 0.0)
    observer.observe(report(0.0, REST, degausses=0, history_known=False, sequence=1))
    observer.observe(report(1.0, A, moving=True, sequence=40))
    observer.observe(report(2.0, B, moving=True, sequence=900))
    observer.observe(report(3.0, C, moving=True, sequence=500))
    assert "activated again" in observer.unknown
    for time, writes in ((4.0, 600), (5.0, 950), (6.0, 1000)):
        observer.observe(report(time, B, moving=True, sequence=writes))
    observer.use(replace(LAW, creep_rate=2.0 * LAW.creep_rate), 0.0)  # follows all reports again
    assert "activated again" in observer.unknown


def test_a_clock_set_back_leaves_hysteresis_alone(tracker: HysteresisTracker) -> None:
    tracker.observe(report(50.0, A, 2, REST))
    before = tracker.state
    assert before is not None
    tracker.observe(report(4.0, A, 2, REST))
    assert not tracker.unknown and tracker.state is not None
    assert tracker.state.time == 4.0
    np.testing.assert_array_equal(tracker.state.position, before.position)
    np.testing.assert_array_equal(tracker.state.crept, before.crept)


def test_another_number_of_actuators_is_refused(tracker: HysteresisTracker) -> None:
    with pytest.raises(ValueError, match="3 signals, before there were 2"):
        tracker.observe(report(2.0, np.zeros(3)))


def test_signals_that_are_no_numbers_are_refused(tracker: HysteresisTracker) -> None:
    with pytest.raises(ValueError, match="not finite"):
        tracker.observe(report(2.0, np.array([np.nan, 0.0])))
