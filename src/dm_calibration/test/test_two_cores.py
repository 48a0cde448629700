"""Halves of a job: the same result however and wherever they run."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from dm_calibration import two_cores
from dm_calibration.map_files.surface_map import INVALID_COUNTS, sag_from_counts
from dm_calibration.optics.map_fit import MapFitter

LARGE = two_cores.WORTH_PIXELS


def test_halves_come_back_in_order() -> None:
    assert two_cores.both(lambda: 1, lambda: 2, 0) == two_cores.both(lambda: 1, lambda: 2, LARGE) == (1, 2)


def test_half_that_nobody_takes_is_done_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    leave = threading.Event()
    blocker = threading.Thread(target=two_cores.both, args=(leave.wait, leave.wait, LARGE))
    blocker.start()
    time.sleep(0.1)
    assert two_cores.both(lambda: 1, threading.get_ident, LARGE) == (1, threading.get_ident())
    leave.set()
    blocker.join(10)


@pytest.mark.parametrize("half", [0, 1])
def test_failure_of_a_half_is_raised(half: int) -> None:
    jobs = [lambda: 1, lambda: 1]
    jobs[half] = lambda: 1 // 0
    with pytest.raises(ZeroDivisionError):
        two_cores.both(*jobs, LARGE)
    assert two_cores.both(lambda: 1, lambda: 2, LARGE) == (1, 2)


def test_one_core_and_two_give_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    size = 600
    assert size**2 >= LARGE
    generator = np.random.default_rng(5)
    counts = generator.integers(-(10**6), 10**6, (size, size)).astype(">i4")
    counts[generator.random((size, size)) < 0.02] = INVALID_COUNTS

    def results() -> tuple[np.ndarray, np.ndarray, float]:
        sag = sag_from_counts(counts, 1e-12)
        fit = MapFitter(np.isfinite(sag), size / 2, size / 2, size / 2).fit(sag)
        return sag, fit.coefficients, fit.residual_rms

    monkeypatch.setattr("os.cpu_count", lambda: 2)
    several = results()
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    alone = results()
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(several, alone, strict=True))
    assert np.array_equal(np.isnan(alone[0]), counts >= INVALID_COUNTS)
