"""Creep state of the actuators on disk: a restarted node knows which shapes were held before, and for how long."""

from __future__ import annotations

import io
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dm_common import Floats

if TYPE_CHECKING:
    from dm_common.hysteresis.model import HysteresisModel, HysteresisState
    from dm_common.hysteresis.observer import HysteresisObserver

#: Folder in which the focus controller keeps its records, unless configured otherwise.
STATE_FOLDER = "~/.ros/focus_controller"
#: Standard deviation of a shape held unobserved, as a share of a full-range shape, which is thus at 2 sigma.
UNSEEN = 0.5
#: Time constant, s, above which creep elements are too slow for a calibration run; relative error of their weights.
SLOW_S, SLOW_SHARE = 300.0, 0.35


class CreepRecord(NamedTuple):
    """Creep of one mirror at one moment.

    Attributes:
        time: s, of the clock that commands are stamped with.
        creep_time: (J,) s, of the elements.
        crept: (N, J) states of the elements: effective signals, low-pass filtered.
        crept_sigma: (J,) see :class:`~dm_common.hysteresis.model.HysteresisState`.
        lagged: (N, L) states of the first L elements that follow the signals themselves. If the law has more of these
            elements, and for records of older versions, `crept` is used instead.
    """

    time: float
    creep_time: Floats
    crept: Floats
    crept_sigma: Floats
    lagged: Floats


def write_record(file: Path, record: CreepRecord) -> None:
    """Replace `file` in one step, so that a power failure leaves either the old or the new record.

    Raises:
        OSError: it cannot be written; the previous record is then unchanged.
    """
    from dm_common.atomic_write import write_whole  # not imported at start, to save time

    image = io.BytesIO()
    np.savez(image, **record._asdict())
    write_whole(file, image.getvalue())


def read_record(file: Path, now: float) -> CreepRecord | None:
    """The record in `file`; None when there is none.

    Args:
        now: s; 0 = not known, for instance before a simulator has published the time.

    Raises:
        ValueError: the record cannot be used (the message says why), or is later than `now`: the clock was set back.
    """
    try:
        with np.load(file, allow_pickle=False) as stored:
            names = [name if name in stored.files else "crept" for name in CreepRecord._fields]
            values = [np.asarray(stored[name], dtype=np.float64) for name in names]
    except FileNotFoundError:
        return None
    except Exception as error:  # NumPy raises many kinds of error for a damaged file
        raise ValueError(f"{file}: {error}: earlier creep is not known") from error
    time, creep_time, crept, sigma, lagged = values
    whole = time.ndim == 0 and crept.ndim == 2 and crept.shape[1:] == creep_time.shape == sigma.shape
    whole = whole and lagged.ndim == 2 and len(lagged) == len(crept)
    if not whole or not all(np.isfinite(value).all() for value in values):
        raise ValueError(f"{file}: its arrays do not fit together: earlier creep is not known")
    if 0.0 < now < float(time):
        raise ValueError(f"{file}: written {float(time) - now:.0f} s from now: was the clock set back?")
    return CreepRecord(float(time), creep_time, crept, sigma, lagged)


def rested(
    law: HysteresisModel, signals: Floats, time: float, middle: float = 0.0, record: CreepRecord | None = None
) -> HysteresisState:
    """The state at `time` (s) of a mirror at `signals` (N,), assumed to have stood there since its last known state.

    That state is the one in `record`, or the one in which the calibration found the mirror. Slow creep elements still
    keep part of it; shapes that were held in between are not known and count by `crept_sigma`.
    """
    moved = law.move(law.demagnetised(len(signals), time, middle), signals, time)
    settled = np.repeat(moved.position[:, None], len(law.creep_time), axis=1)
    lagged = np.repeat(signals[:, None], len(law.lag_time), axis=1)
    sigma = np.full(len(law.creep_time), UNSEEN)
    if record is not None and record.time < law.crept_at <= time and law.crept.shape == signals.shape:
        record = None  # the calibration has seen the mirror since
    if record is None or record.time > time or not np.array_equal(record.creep_time, law.creep_time):
        held = np.repeat(law.crept[:, None], len(law.creep_time), axis=1)
        record = CreepRecord(law.crept_at, law.creep_time, held, np.zeros(len(law.creep_time)), held)
    if record.crept.shape == settled.shape and time >= record.time:
        left = np.exp(-(time - record.time) / law.creep_time)
        settled += (record.crept - settled) * left
        sigma = held_unseen(law, record.crept_sigma * left, time - record.time)
        lags = lagged.shape[1]
        followed = record.lagged if record.lagged.shape[1] >= lags else record.crept
        lagged += (followed[:, :lags] - lagged) * left[:lags]
    return replace(moved, crept=settled, crept_sigma=sigma, lagged=lagged)


def held_unseen(law: HysteresisModel, sigma: Floats, elapsed: float) -> Floats:
    """(J,) `crept_sigma` after `elapsed` s at an unobserved shape; `sigma` (J,): the remainder of the earlier one."""
    return np.hypot(sigma, UNSEEN * -np.expm1(-max(elapsed, 0.0) / law.creep_time))


def slow_creep(law: HysteresisModel, elapsed: float) -> float:
    """Standard deviation of an effective signal by creep too slow for a run to determine, `elapsed` s after a map."""
    share = np.where(law.creep_time > SLOW_S, np.atleast_2d(law.creep_share).mean(axis=0), 0.0)
    return SLOW_SHARE * float(held_unseen(law, np.zeros(len(share)), elapsed) @ share)


def record_of(law: HysteresisModel, state: HysteresisState | None, now: float) -> CreepRecord | None:
    """The creep record at `now` (s); None if the law has no creep, or without a state."""
    if state is None or not law.creep_rate:
        return None
    state = law.advance(state, now)
    return CreepRecord(state.time, law.creep_time, state.crept, state.crept_sigma, state.lagged)


class CreepRecorder:
    """Keeps the record of the mirror that an observer follows.

    Args:
        folder: of the records; may be reassigned; empty = nothing is kept.
        warn: called from any thread with the message of a failure.
    """

    def __init__(self, folder: str, observer: HysteresisObserver, warn: Callable[[str], None]) -> None:
        self.folder, self._observer, self._warn = folder, observer, warn
        self._serial: str | None = None
        self._disk = ThreadPoolExecutor(max_workers=1)  # fsync may take long

    def recall(self, serial: str, now: float) -> None:
        """Continue from the record of the mirror `serial`, if there is one; reports of another mirror are discarded."""
        if serial == self._serial:
            return
        another, self._serial = self._serial is not None, serial
        file, record = self._file(serial), None
        try:
            record = read_record(file, now) if file is not None else None
        except ValueError as error:
            self._warn(str(error))
        self._observer.recall(record, another)

    def keep(self, now: float) -> None:
        """Write the creep state of the actuators at `now` (s) to disk, if it is known.

        Without a link to the electronics the last record stays, since the outputs may have changed.
        """
        latest = self._observer.latest
        if self._serial is None or latest is None or not latest.linked:
            return
        file = self._file(self._serial)
        record = record_of(self._observer.law, self._observer.state, now)
        if file is not None and record is not None:
            self._disk.submit(self._write, file, record)

    def _file(self, serial: str) -> Path | None:
        from dm_common.state_files import state_file  # not imported at start, to save time

        return state_file(self.folder, ".creep.npz", serial)

    def _write(self, file: Path, record: CreepRecord) -> None:
        try:
            write_record(file, record)
        except OSError as error:
            self._warn(f"state_folder: {error}: the next start will not know the creep so far")
