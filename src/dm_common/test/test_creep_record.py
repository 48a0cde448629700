"""The record of creep on disk: what it brings back, and what becomes of one that cannot be used."""

from __future__ import annotations

import errno
import os
import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dm_common.hysteresis.creep_record import (
    UNSEEN,
    CreepRecord,
    CreepRecorder,
    read_record,
    record_of,
    rested,
    write_record,
)
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_common.hysteresis.observer import HysteresisObserver
from dm_common.mirror import Applied
from waiting import wait_until

LAW = replace(HysteresisModel.linear(), creep_rate=0.01, creep_time=CREEP_TIMES)
DAY = 86_400.0
AT_REST = CreepRecord(10.0, CREEP_TIMES, np.zeros((3, len(CREEP_TIMES))), np.zeros(len(CREEP_TIMES)), np.zeros((3, 0)))


def report(time: float, signal: float, **changes: object) -> Applied:
    return replace(Applied(time, np.full(3, signal), 0, None, 1, True), **changes)  # type: ignore[arg-type]


def held_for_a_day() -> HysteresisObserver:
    """Of a mirror that went to 0.5 at 0 s, of which nothing else was reported for a day."""
    observer = HysteresisObserver()
    observer.use(LAW, 0.0)
    observer.observe(report(-1.0, 0.0))
    observer.observe(report(0.0, 0.5, turns=1))
    observer.observe(report(0.0, 0.5, turns=1, heard=DAY))
    return observer


def test_the_next_start_knows_what_was_held_for_a_day(tmp_path: Path) -> None:
    file = tmp_path / "mirror.creep.npz"
    before = HysteresisObserver()
    before.use(LAW, 0.0)
    before.observe(report(0.0, 0.5))
    record = record_of(before.law, before.state, DAY)
    assert record is not None
    write_record(file, record)

    after = HysteresisObserver()
    after.recall(read_record(file, DAY + 600.0))
    after.observe(report(DAY + 600.0, -1.0))
    after.use(LAW, 0.0)  # the calibration arrives later
    state = after.state
    assert state is not None
    hours = np.searchsorted(CREEP_TIMES, 3600.0)
    assert (state.crept[:, hours:-1] > 0.2).all()
    assert state.crept[:, 0] == pytest.approx(-1.0)
    assert state.crept_sigma[0] == pytest.approx(UNSEEN)
    assert state.crept_sigma[hours + 1] < 0.3 * UNSEEN

    blind = HysteresisObserver()
    blind.use(LAW, 0.0)
    blind.observe(report(DAY + 600.0, -1.0))
    assert blind.state is not None
    assert (blind.state.crept == -1.0).all()
    assert blind.state.crept_sigma == pytest.approx(np.full(len(CREEP_TIMES), UNSEEN))


def test_a_controller_that_starts_anew_alone_knows_what_still_stands() -> None:
    """The driver repeats the stamp of its last write, of a day before the record."""
    never = held_for_a_day()
    again = HysteresisObserver()
    again.recall(record_of(never.law, never.state, DAY))
    again.observe(report(0.0, 0.5, turns=1, heard=DAY + 60.0))
    again.use(LAW, 0.0)
    for changes in ({}, {"history_known": False}):
        again.observe(report(0.0, 0.5, turns=1, heard=DAY + 120.0, **changes))
        assert again.state is not None and never.state is not None
        now, expected = (LAW.advance(state, DAY + 120.0) for state in (again.state, never.state))
        assert now.crept == pytest.approx(expected.crept, abs=1e-6)
        assert now.crept_sigma == pytest.approx(expected.crept_sigma, abs=1e-6)


def test_after_a_short_power_cut_loops_go_on_lagging_from_where_they_were(tmp_path: Path) -> None:
    """Fast elements follow the signal too: within a second of no power they have not reached where it rests."""
    file = tmp_path / "mirror.creep.npz"
    law = replace(LAW, creep_spectrum=np.full(len(CREEP_TIMES), 1.5), lag_spectrum=np.full(7, -0.5))
    followed = law.advance(law.move(law.demagnetised(3, 0.0), np.full(3, 0.5), 0.0), 600.0)
    record = record_of(law, followed, 600.0)
    assert record is not None
    write_record(file, record)
    for off, fast in ((1.0, 1e-3), (3600.0, 1e-6)):
        there = law.advance(law.move(followed, np.full(3, -0.9), 600.0), 600.0 + off)
        found = rested(law, np.full(3, -0.9), 600.0 + off, 0.0, read_record(file, 700.0))
        assert found.lagged == pytest.approx(there.lagged, abs=fast)
        assert law.effective(found) == pytest.approx(law.effective(there), abs=fast)
    older = rested(law, np.full(3, -0.9), 601.0, 0.0, record._replace(lagged=np.zeros((3, 0))))
    assert (older.lagged[:, -1] > 0.4).all()  # the loop's width off at most


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"crept": np.zeros((3, 2))}, "do not fit together"),
        ({"crept_sigma": np.full(len(CREEP_TIMES), np.nan)}, "do not fit together"),
        ({"time": 1e6}, "was the clock set back"),
    ],
)
def test_a_record_that_makes_no_sense_is_named(tmp_path: Path, change: dict[str, object], text: str) -> None:
    file = tmp_path / "mirror.creep.npz"
    write_record(file, AT_REST._replace(**change))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=text):
        read_record(file, 100.0)


def test_a_day_at_a_shape_counts_until_the_driver_that_held_it_was_heard_last() -> None:
    """Another driver, which knows nothing of that shape, comes ten minutes later: what stood meanwhile is in doubt."""
    observer = held_for_a_day()
    observer.observe(report(DAY + 600.0, 0.0, degausses=0, history_known=False))
    state = observer.state
    assert state is not None and "started" in observer.unknown
    minute, hours = np.searchsorted(CREEP_TIMES, (60.0, 3600.0))
    assert (state.crept[:, hours:-1] > 0.2).all()
    assert (np.abs(state.crept[:, :minute]) < 1e-3).all()
    assert state.crept_sigma[:minute] == pytest.approx(UNSEEN, rel=1e-3)
    assert state.crept_sigma[hours + 1] < 0.3 * UNSEEN


@pytest.mark.parametrize("away", [0.0, 600.0])
def test_while_the_link_is_lost_nobody_knows_whether_the_outputs_hold(away: float) -> None:
    observer = held_for_a_day()
    for heard in (DAY, DAY + away):
        lost = report(0.0, 0.5, turns=1, history_known=False, active=False, linked=False, heard=heard)
        observer.observe(lost)
    observer.observe(report(DAY + away, 0.5, turns=1, history_known=False, heard=DAY + away))
    state = observer.state
    assert state is not None and (state.crept[:, :-2] > 0.2).all()
    minute = np.searchsorted(CREEP_TIMES, 60.0)
    assert state.crept_sigma[:minute] == pytest.approx(UNSEEN if away else 0.0, abs=1e-3)
    observer.observe(report(DAY + away + 5.0, 0.0, turns=2, degausses=2))
    assert observer.state is not None and (observer.state.crept_sigma[minute:] > 0.0).all() == bool(away)


def test_what_stood_counts_until_the_first_write_of_a_degauss() -> None:
    """The driver may say that it moves before that write, with the stamp of the one before."""
    crept = []
    for reported_before in (False, True):
        observer, swings = held_for_a_day(), {"turns": 1, "moving": True, "history_known": False}
        if reported_before:
            observer.observe(report(0.0, 0.5, heard=DAY, **swings))
        for time, signal in ((DAY, 0.49), (DAY + 1.0, -0.5)):
            observer.observe(report(time, signal, heard=time, **swings))
        observer.observe(report(DAY + 2.0, 0.0, turns=2, degausses=2))
        assert observer.state is not None
        crept.append(observer.state.crept)
    assert crept[1] == pytest.approx(crept[0], abs=1e-6)


def test_a_small_jump_of_the_clock_is_in_doubt_for_as_long_as_itself() -> None:
    """Not as long as the largest ever seen; a law that comes later says the same of both."""
    observer = held_for_a_day()
    minute, hours = np.searchsorted(CREEP_TIMES, (60.0, 3600.0))
    observer.observe(report(0.0, 0.5, turns=1, heard=DAY), doubtful=DAY)
    assert observer.state is not None and observer.state.crept_sigma[:hours] == pytest.approx(UNSEEN, rel=1e-3)
    observer.observe(report(0.0, 0.5, turns=1, heard=31.0 * DAY), doubtful=6.0)
    sigma = observer.state.crept_sigma
    assert sigma[0] == pytest.approx(UNSEEN) and (sigma[minute:] < 0.1 * UNSEEN).all()
    observer.use(replace(LAW, creep_rate=0.02), 0.0)
    assert observer.state.crept_sigma == pytest.approx(sigma)


def test_creep_goes_on_after_a_clock_that_ran_ahead_is_set_back() -> None:
    observer = held_for_a_day()
    observer.observe(report(0.0, 0.5, turns=1, heard=DAY + 7200.0), doubtful=7200.0)
    assert observer.state is not None and observer.state.time > DAY + 3600.0
    observer.observe(report(DAY + 10.0, -0.5, turns=2, heard=DAY + 10.0))
    assert observer.state.time == DAY + 10.0


def test_a_torn_record_is_named_and_none_is_none(tmp_path: Path) -> None:
    file = tmp_path / "mirror.creep.npz"
    assert read_record(file, 0.0) is None
    write_record(file, AT_REST)
    whole = file.read_bytes()
    entry = whole.index(b"PK\x01\x02")
    unknown_compression = whole[: entry + 10] + b"\x63" + whole[entry + 11 :]
    open_bracket = whole.replace(b", }", b",  ")
    for torn in (b"PK\x03\x04 torn", unknown_compression, open_bracket):
        file.write_bytes(torn)
        with pytest.raises(ValueError, match=r"mirror\.creep\.npz"):
            read_record(file, 0.0)


def test_a_disk_that_fails_leaves_the_record_that_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "mirror.creep.npz"
    write_record(file, AT_REST)

    def fails(_handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", fails)  # without it the power may take the old record and the new one
    with pytest.raises(OSError, match="No space left"):
        write_record(file, AT_REST._replace(time=20.0))
    kept = read_record(file, 30.0)
    assert kept is not None and kept.time == 10.0
    assert list(tmp_path.iterdir()) == [file]


def test_a_folder_that_cannot_be_synced_has_the_new_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on many file systems in a network."""
    file, sync = tmp_path / "mirror.creep.npz", os.fsync

    def of_files_only(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        sync(handle)

    monkeypatch.setattr(os, "fsync", of_files_only)
    write_record(file, AT_REST)
    kept = read_record(file, 30.0)
    assert kept is not None and kept.time == AT_REST.time


def test_a_record_of_another_law_or_mirror_is_not_used() -> None:
    elements = np.geomspace(1.0, 100.0, 5)
    other = CreepRecord(0.0, elements, np.ones((3, 5)), np.zeros(5), np.zeros((3, 0)))
    larger = AT_REST._replace(time=0.0, crept=np.ones((4, len(CREEP_TIMES))))
    for record in (other, larger):
        assert (rested(LAW, np.zeros(3), 1.0, 0.0, record).crept == 0.0).all()


def test_a_calibration_made_since_counts_for_more_than_a_record() -> None:
    """It has seen the mirror after the record was written."""
    law = replace(LAW, crept_at=50.0, crept=np.full(3, -0.6))
    for record in (None, AT_REST):
        assert rested(law, np.zeros(3), 60.0, 0.0, record).crept[0, -1] == pytest.approx(-0.6, abs=1e-3)
    later = AT_REST._replace(time=55.0)
    assert rested(law, np.zeros(3), 60.0, 0.0, later).crept[0, -1] == pytest.approx(0.0, abs=1e-3)


def test_another_mirror_begins_with_its_own_record_and_no_reports(tmp_path: Path) -> None:
    observer = HysteresisObserver()
    observer.use(LAW, 0.0)
    failures: list[str] = []
    recorder = CreepRecorder(str(tmp_path), observer, failures.append)
    write_record(tmp_path / "a.creep.npz", AT_REST._replace(crept=AT_REST.crept + 0.5))
    (tmp_path / "c.creep.npz").write_bytes(b"torn")
    observer.observe(report(20.0, 0.0))  # reports may come before who the mirror is
    recorder.recall("a", 20.0)
    assert observer.state is not None and (observer.state.crept[:, -1] > 0.4).all()
    recorder.recall("a", 30.0)
    for other in ("b", "c"):
        assert not failures
        recorder.recall(other, 30.0)
        assert observer.state is None
        observer.observe(report(30.0, 0.0))
        assert (observer.state.crept == 0.0).all()
    (failure,) = failures
    assert "c.creep.npz" in failure


def test_a_record_is_kept_for_the_mirror_or_said_not_to_be(tmp_path: Path) -> None:
    observer, failures = HysteresisObserver(), list[str]()
    observer.use(LAW, 0.0)
    observer.observe(report(20.0, 0.5))
    (tmp_path / "file").touch()
    for folder in (tmp_path, tmp_path / "file"):
        recorder = CreepRecorder(str(folder), observer, failures.append)
        recorder.keep(30.0)  # of which mirror is not known yet
        recorder.recall("a", 20.0)
        recorder.keep(40.0)
    wait_until(lambda: len(failures) == 2 and (tmp_path / "a.creep.npz").exists())
    observer.observe(report(20.0, 0.5, history_known=False, active=False, linked=False, heard=50.0))
    recorder.folder = str(tmp_path)
    recorder.keep(60.0)  # nobody knows whether the outputs hold
    recorder._disk.shutdown()
    kept = read_record(tmp_path / "a.creep.npz", 70.0)
    assert kept is not None and kept.time == 40.0
    assert failures[1].startswith("state_folder: ")  # after what could not be read


def test_a_clock_that_does_not_run_yet_refuses_no_record(tmp_path: Path) -> None:
    file = tmp_path / "mirror.creep.npz"
    write_record(file, AT_REST._replace(time=1e6))
    found = read_record(file, 0.0)
    assert found is not None and found.time == 1e6
