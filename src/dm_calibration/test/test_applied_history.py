"""The state of the mirror that belongs to the stamp of a map."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace

import numpy as np
import pytest

from dm_calibration.procedure.applied_history import SMALL_MOVE, AppliedHistory, MapNotUsableError
from dm_common.hysteresis.inverse import invert
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_common.mirror import Applied

#: A signal with a backlash of half-width 0.3 that carries half of it.
LAW = HysteresisModel(np.array([0.0, 0.3]), np.array([[0.5], [0.5]]), np.zeros(0), 0.0, 0.0, np.zeros(0))
#: The same with creep, which a held shape is corrected for.
CREEPING = replace(LAW, creep_rate=0.02, creep_time=CREEP_TIMES)


class Driver:
    """Moves and reports."""

    def __init__(self, history: AppliedHistory) -> None:
        self.history = history
        self.signals, self.turned_at = np.zeros(2), np.zeros(2)
        self.turns = self.degausses = 0
        self.report(0.0)

    def report(self, time: float, moving: bool = False, active: bool = True) -> None:
        known = self.degausses > 0
        report = Applied(time, self.signals, self.turns, self.turned_at, self.degausses, known, moving, active=active)
        self.history.observe(replace(report, heard=time))

    def go(self, time: float, value: float) -> None:
        self.turns, self.turned_at = self.turns + 1, self.signals
        self.signals = np.full(2, value)
        self.report(time)

    def degauss(self, time: float) -> None:
        self.degausses += 1
        self.go(time, 0.0)


@pytest.fixture
def history() -> AppliedHistory:
    return AppliedHistory()


@pytest.fixture
def driver(history: AppliedHistory) -> Driver:
    return Driver(history)


def test_a_map_gets_the_signals_of_its_own_time(history: AppliedHistory, driver: Driver) -> None:
    driver.go(10.0, 0.2)
    driver.go(20.0, 0.4)
    settled = history.settled(15.0, 1.0)
    assert (settled.effective == 0.2).all()
    assert settled.since == 10.0
    assert (history.settled(25.0, 1.0).effective == 0.4).all()


@pytest.mark.parametrize(
    ("time", "words"),
    [
        (-1.0, "no actuator_state from that time"),
        (10.4, r"moved 0.400 s before the stamp of the map: must stand still for 1 s"),
        (19.5, r"moved 0.500 s after the stamp of the map"),
        (30.5, "pdm_driver was not active"),
        (40.5, "the mirror was moving"),
    ],
)
def test_a_mirror_that_did_not_stand_still(time: float, words: str, history: AppliedHistory, driver: Driver) -> None:
    driver.go(10.0, 0.2)
    driver.go(20.0, 0.4)
    driver.report(30.0, active=False)
    driver.report(40.0, moving=True)
    with pytest.raises(MapNotUsableError, match=words):
        history.settled(time, 1.0)


def test_holding_a_shape_against_creep_is_no_move(history: AppliedHistory, driver: Driver) -> None:
    driver.go(10.0, 0.2)
    driver.go(20.0, 0.2001)
    assert history.settled(20.2, 1.0).effective == pytest.approx(0.2001)


def held(driver: Driver, wanted: float, began: float, until: float) -> None:
    """Go to the effective signals `wanted` and keep them by corrections, as often as the focus controller does."""
    law = CREEPING
    driver.degauss(began - 10.0)
    state = law.move(law.demagnetised(2, 0.0), np.zeros(2), began - 10.0)
    time, wait = began, 0.02
    while time < until:
        state = law.advance(state, time)
        signals = invert(law, state, np.full(2, wanted), -1.0, 1.0, 0.5 * wait).signals
        state = law.move(state, signals, time)
        driver.go(time, float(signals[0]))
        wait = max(0.02, 0.07 * (time - began))
        time += wait


def test_corrections_of_a_held_shape_are_no_move(history: AppliedHistory, driver: Driver) -> None:
    """Soon after a large move they are large, and come in the middle of an exposure."""
    history.follow(CREEPING)
    held(driver, 0.8, 10.0, 40.0)
    reports = {seen.report.time: seen.report.signals[0] for seen in history.recent()}
    times = np.array(list(reports))
    first, last = (reports[times[np.abs(times - stamp).argmin()]] for stamp in (10.5, 11.5))
    assert abs(last - first) > 10 * SMALL_MOVE
    for stamp in (11.0, 13.0, 20.0, 39.0):
        settled = history.settled(stamp, 0.5)
        assert settled.effective == pytest.approx(0.8, abs=SMALL_MOVE)
        assert settled.since == pytest.approx(10.2, abs=0.2)
    assert history.still_for(41.0) == pytest.approx(30.8, abs=0.2)


def test_a_command_amid_corrections_is_a_move(history: AppliedHistory, driver: Driver) -> None:
    history.follow(CREEPING)
    held(driver, 0.8, 10.0, 13.0)
    driver.go(13.1, float(driver.signals[0]) + 0.002)
    with pytest.raises(MapNotUsableError, match=r"moved 0.100 s after the stamp"):
        history.settled(13.0, 0.5)


def test_a_correction_under_way_is_no_move(history: AppliedHistory, driver: Driver) -> None:
    driver.go(10.0, 0.2)
    for time, requested, still in ((20.0, 0.2001, True), (21.0, 0.6, False)):
        history.observe(Applied(time, driver.signals, 2, None, 0, True, True, np.full(2, requested)))
        assert (history.still_for(21.0) > 0.0) == still


def test_effective_signals_follow_the_hysteresis(history: AppliedHistory, driver: Driver) -> None:
    history.follow(LAW)
    driver.degauss(1.0)
    driver.go(2.0, 0.8)
    driver.go(4.0, 0.4)
    assert history.settled(6.0, 1.0).effective == pytest.approx(0.5 * 0.4 + 0.5 * 0.5)


def test_a_law_that_comes_later_is_followed_from_the_last_degauss(history: AppliedHistory, driver: Driver) -> None:
    driver.degauss(1.0)
    driver.go(2.0, 0.8)
    driver.go(4.0, 0.4)
    history.follow(LAW)
    assert history.settled(6.0, 1.0).effective == pytest.approx(0.45)


def test_an_unknown_history_is_refused(history: AppliedHistory, driver: Driver) -> None:
    history.follow(LAW)
    driver.go(2.0, 0.8)
    with pytest.raises(MapNotUsableError, match=r"history of the actuators is not known: .*; a degauss"):
        history.settled(4.0, 1.0)


def test_a_silent_driver_is_noticed(history: AppliedHistory, driver: Driver) -> None:
    driver.go(10.0, 0.2)
    assert not history.heard_since(10.5)
    driver.report(10.6)
    assert history.heard_since(10.5)


def test_another_number_of_signals_starts_anew(history: AppliedHistory, driver: Driver) -> None:
    history.follow(LAW)
    driver.report(1.0)
    driver.signals = np.zeros(3)
    with pytest.raises(ValueError, match="applied: 3 signals, before there were 2"):
        driver.report(2.0)
    with pytest.raises(MapNotUsableError, match="no actuator_state from that time"):
        history.settled(5.0, 1.0)


def test_what_another_mirror_held_is_not_held_against_this_one(history: AppliedHistory) -> None:
    """Its creep of hours went on in the calibration node, and maps of the next mirror were refused as surprising."""
    fresh = AppliedHistory()
    history.follow(CREEPING)
    before = Driver(history)
    before.degauss(1.0)
    before.go(10.0, 0.8)
    before.report(36_000.0)
    history.recall(None, another=True)
    for followed in (history, fresh):
        followed.follow(replace(CREEPING, creep_rate=0.021))
        Driver(followed).degauss(40_000.0)
    forgotten, expected = (each.settled(40_010.0, 1.0).effective for each in (history, fresh))
    np.testing.assert_allclose(forgotten, expected, atol=1e-12)


def test_a_report_counts_as_heard_once_it_is_followed(
    history: AppliedHistory, driver: Driver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who waits for it, in another thread, asks for the state at once."""
    track, waiting = history._track, list[Future[bool]]()

    def tracked(report: Applied) -> None:
        waiting.append(pool.submit(history.heard_since, 10.0))
        assert not wait(waiting, 0.05).done
        track(report)

    with ThreadPoolExecutor() as pool:
        monkeypatch.setattr(history, "_track", tracked)
        driver.go(10.0, 0.2)
        assert waiting[0].result()


def test_a_shape_from_before_the_clock_was_set_back_is_not_that_of_a_map(
    history: AppliedHistory, driver: Driver
) -> None:
    driver.go(100.0, 0.2)
    driver.go(3000.0, 0.4)
    assert history.latest is not None
    history.observe(replace(history.latest, heard=2016.0))  # the driver repeats its report: the shape still stands
    with pytest.raises(MapNotUsableError, match="from that time; the last is stamped 984 s after its arrival"):
        history.settled(2015.0, 0.5)
    driver.report(2020.0)  # a correction that holds the shape
    assert history.still_for(2021.0) == 1.0
    assert (history.settled(2025.0, 0.5).effective == 0.4).all()
