"""Laws from Shack-Hartmann slopes of a simulated membrane mirror, without ROS, with the example."""

from __future__ import annotations

import runpy
import sys
import tracemalloc
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dm_calibration import identify_response
from dm_calibration.hysteresis.candidate_fit import CANDIDATES, Candidate
from dm_calibration.hysteresis.features import play_values
from dm_calibration.hysteresis.identify import ExcitationError
from dm_common import Floats
from dm_simulation.mirror.membrane import Membrane, MembraneConfig

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "compare_laws.py"
STATIC = (CANDIDATES[0], Candidate("squares", 0, 2, 0), Candidate("static", 0, 3, 0))
LENSLETS, APERTURE, STEP = 8, 0.010, 1e-5  # a side; m; m
NOISE = 4e-7  # rad, of a slope


@cache
def record(squared: bool, drift: float = 0.0, count: int = 160) -> tuple[Floats, Floats, Floats]:
    """Commands (M, 19), slopes (M, 2 lenslets) rad and times (M,) s of random volts, or random volts squared."""
    config = MembraneConfig(actuators=19, pitch=2.6e-3, electrode_diameter=2.4e-3, drift=drift, drift_time=2e3)
    rng = np.random.default_rng(1919)
    membrane = Membrane(config, rng)
    grid = (np.arange(LENSLETS) + 0.5) / LENSLETS - 0.5
    x, y = (axis.ravel() * APERTURE for axis in np.meshgrid(grid, grid))
    inside = np.hypot(x, y) < APERTURE / 2
    x, y = x[inside], y[inside]
    slopes = np.concatenate(
        [
            (membrane.influence_at(x + dx, y + dy) - membrane.influence_at(x - dx, y - dy)) / (2 * STEP)
            for dx, dy in ((STEP, 0.0), (0.0, STEP))
        ]
    )
    commands = rng.uniform(-1.0, 1.0, (count, 19))
    times = 9.0 * np.arange(count, dtype=np.float64)
    measured = np.empty((count, len(slopes)))
    for row, (signals, time) in enumerate(zip(commands, times, strict=True)):
        share = 0.5 * (signals + 1.0)
        membrane.apply(200.0 * np.sqrt(share) if squared else 100.0 + 100.0 * share, float(time))
        measured[row] = slopes @ membrane.displacement
    return commands, measured + NOISE * rng.standard_normal(measured.shape), times


def test_volts_need_squares_and_volts_squared_do_not() -> None:
    volts = identify_response(*record(False), candidates=STATIC)
    assert volts.name != "linear"
    assert volts.held_out["linear"] > 3.0 * volts.held_out["squares"]
    assert volts.held_out["static"] < 1.03 * volts.held_out["squares"]
    squared = identify_response(*record(True), candidates=STATIC)
    assert squared.held_out["linear"] < 1.2 * squared.held_out["squares"]  # what is left is the gap that narrows
    assert squared.held_out["linear"] < 0.5 * volts.held_out["linear"]
    assert not squared.law.has_history


def test_a_zero_that_drifts_is_part_of_the_fit() -> None:
    still = identify_response(*record(True), candidates=STATIC[:1])
    _, steady, _ = record(True)
    signal = np.sqrt(steady.var(axis=0).mean())
    for drift, most in ((1e-7, 1.2), (5e-7, 2.5)):  # it goes by an exponential, the fit by a straight line
        found = identify_response(*record(True, drift), candidates=STATIC[:1])
        gone = record(True, drift)[1] - steady
        assert found.held_out["linear"] < most * still.held_out["linear"]
        assert found.held_out["linear"] < 0.4 * np.sqrt(gone.var(axis=0).mean()) / signal
        assert np.linalg.norm(found.drift - gone[-1]) < 0.1 * np.linalg.norm(gone[-1])


def test_more_numbers_than_measurements_change_nothing() -> None:
    commands, measured, times = (array[:80] for array in record(True))
    assert measured.shape[1] > len(measured)
    whole = identify_response(commands, measured, times, candidates=STATIC[:1])
    ours = identify_response(commands, measured @ np.linalg.qr(measured.T)[0], times, candidates=STATIC[:1])
    assert whole.held_out["linear"] == pytest.approx(ours.held_out["linear"], rel=1e-6)
    assert whole.influence.shape == (19, measured.shape[1])
    np.testing.assert_allclose(whole.predict(commands, times).shape, measured.shape)


def test_the_noise_of_many_values_does_not_hide_hysteresis() -> None:
    rng = np.random.default_rng(7)
    commands = rng.uniform(-1.0, 1.0, (160, 3))
    effective = commands + 0.06 * play_values(commands, np.linspace(0.1, 0.7, 4)).sum(axis=1)
    measured = effective @ np.exp(-np.square((np.linspace(-1.0, 1.0, 300) - [[-0.6], [0.0], [0.6]]) / 0.3))
    noisy = measured + 0.2 * measured.std() * rng.standard_normal(measured.shape)
    found = identify_response(commands, noisy, candidates=(CANDIDATES[0], CANDIDATES[2]))
    assert found.name == "Prandtl-Ishlinskii" and found.held_out[found.name] == pytest.approx(0.2, rel=0.05)
    even = np.square(commands) @ np.linalg.qr(measured.T)[0][:, :3].T  # no linear response at all
    assert identify_response(commands, even, candidates=STATIC[:2]).held_out["squares"] < 1e-6
    noisy[9, ::2] += 3.0 * measured.std()  # in no pattern of the actuators
    noisy[9, 1::2] -= 3.0 * measured.std()
    assert "no law explains: 10." in identify_response(commands, noisy, candidates=CANDIDATES[:1]).remark


def test_an_actuator_that_never_moves_is_named() -> None:
    commands, measured, times = record(True)
    commands = np.where(np.arange(19) == 2, 0.0, commands)
    found = identify_response(commands, measured, times, candidates=STATIC[:1])
    assert "actuator 3 is that of the others" in str(found) and np.isfinite(found.influence).all()


def test_masked_values_count_as_missing() -> None:
    commands, measured, times = record(True)
    masked = np.ma.masked_array(np.where((np.arange(160) == 6)[:, None], 1e3, measured), mask=False)
    masked[6] = np.ma.masked
    found = identify_response(commands, masked, times, candidates=STATIC[:1])
    missing = identify_response(commands, masked.filled(np.nan), times, candidates=STATIC[:1])
    assert found.measurements == 159 and found.held_out == missing.held_out
    for array, text in ((commands, "commands: row 7 holds NaN"), (times, "times: number 7 is NaN")):
        bad = np.ma.masked_array(array, mask=np.zeros(array.shape, dtype=bool))
        bad[6] = np.ma.masked
        with pytest.raises(ValueError, match=text):
            identify_response(bad, measured, times) if array is commands else identify_response(commands, measured, bad)


def test_rows_that_no_law_explains_are_named() -> None:
    commands, measured, times = record(True)
    stale = measured.copy()
    stale[70] = stale[69]
    found = identify_response(commands, stale, times, candidates=STATIC[:1])
    assert "Rows that no law explains: 71." in str(found) == repr(found)  # a notebook shows the latter
    assert not identify_response(commands, measured, times, candidates=STATIC[:1]).remark


def test_a_shape_may_be_measured_several_times() -> None:
    commands, measured, times = (np.repeat(array, 2, axis=0) for array in record(True))
    twice = identify_response(commands, measured, times + np.tile((0.0, 0.1), 160), candidates=STATIC[:1])
    assert twice.held_out["linear"] == pytest.approx(0.01, rel=0.3)


def test_commands_of_0_to_1_are_doubted_where_the_law_has_a_history() -> None:
    commands, measured, times = record(True)
    hysteresis = CANDIDATES[2:3]  # Prandtl-Ishlinskii
    assert "never negative" in identify_response(0.5 * (commands + 1.0), measured, times, candidates=hysteresis).remark
    assert "never negative" not in identify_response(commands, measured, times, candidates=hysteresis).remark


def test_long_records_need_little_memory() -> None:
    rng = np.random.default_rng(20)
    commands = rng.uniform(-1.0, 1.0, (6000, 1))
    measured = commands + 0.01 * rng.standard_normal((6000, 1))
    tracemalloc.start()
    try:
        found = identify_response(commands, measured, candidates=STATIC[:1])
        assert tracemalloc.get_traced_memory()[1] < 100e6  # bytes; a matrix of all pairs of rows has 288e6
    finally:
        tracemalloc.stop()
    assert found.held_out["linear"] < 0.02


def test_the_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    commands, measured, times = record(False, 1e-7, 80)
    np.savez(tmp_path / "record.npz", commands=commands, measured=measured, times=times)
    monkeypatch.setattr(sys, "argv", [EXAMPLE.name, str(tmp_path / "record.npz")])
    found = runpy.run_path(str(EXAMPLE))["found"]
    shown = capsys.readouterr().out
    assert "held-out error, % of the signal (80 measurements)" in shown
    assert found.held_out[found.name] < 0.4 * found.held_out["linear"]
    assert "closest to the wanted measurement: within" in shown
    for name, error in found.held_out.items():
        assert f"{name} " in shown and f"{100 * error:.2f}" in shown


def test_what_is_refused() -> None:
    commands, measured, times = record(True)
    with pytest.raises(ValueError, match=r"measured has the shape \(5, \d+\): must be \(160, values per measurement"):
        identify_response(commands, measured[:5], times)
    with pytest.raises(ValueError, match="commands reach 200: must be normalised"):
        identify_response(200.0 * commands / np.abs(commands).max(), measured, times)
    with pytest.raises(ValueError, match=r"times has the shape \(4,\)"):
        identify_response(commands, measured, times[:4])
    with pytest.raises(ValueError, match="time stamps: map 2"):
        identify_response(commands, measured, -times)
    with pytest.raises(ValueError, match="measured: every row holds NaN"):
        identify_response(commands, np.where(np.arange(measured.shape[1]) == 2, np.nan, measured), times)
    with pytest.raises(ValueError, match="times: all are the same"):
        identify_response(commands, measured, np.ones_like(times))
    for array, text in ((commands, "commands: row 7 holds NaN"), (times, "times: number 7 is NaN")):
        bad = np.where((np.arange(160) == 6).reshape(-1, *[1] * (array.ndim - 1)), np.nan, array)
        with pytest.raises(ValueError, match=text):
            identify_response(bad, measured, times) if array is commands else identify_response(commands, measured, bad)
    with pytest.raises(ValueError, match=r"times go up to 1\.7e\+18: must be in s, not ns"):
        identify_response(commands, measured, 1e9 * times + 1.7e18)
    with pytest.raises(ValueError, match=r"moved: number 1 is \+0\.1 s from the time of its map"):
        identify_response(commands, measured, times, moved=times + 0.1)
    with pytest.raises(ValueError, match=r"times: must be times in s, not datetime64\[m\]"):
        identify_response(commands, measured, np.arange(160).astype("datetime64[m]"))
    with pytest.raises(ValueError, match=r"times: must be times in s: float\(\) argument must be"):
        identify_response(commands, measured, np.array([datetime(2026, 1, 1, tzinfo=UTC)] * 160))
    uneven: Any = [*measured.tolist()[1:], [1.0]]
    for bad, text in (
        (measured + 1j, "not complex128"),
        (measured.astype(str)[:, :1] + "V", "could not convert"),
        (uneven, "setting an array element with a sequence"),
    ):
        with pytest.raises(ValueError, match=rf"measured: must be real numbers[,:] {text}"):
            identify_response(commands, bad, times)
    with pytest.raises(ValueError, match="do not separate actuators 3, 5"):
        identify_response(np.where(np.arange(19) == 4, commands[:, 2:3], commands), measured, times)
    with pytest.raises(ValueError, match="candidates: must be at least one law"):
        identify_response(commands, measured, times, candidates=())
    with pytest.raises(ValueError, match=r"measured reaches 1e\+300: too large"):
        identify_response(commands, np.where(measured > measured.mean(), 1e300, -1e300), times)
    with pytest.raises(ValueError, match="all rows are equal"):
        identify_response(commands, np.ones_like(measured), times)
    found = identify_response(commands, measured, times, candidates=STATIC[:1])
    for bad, text in (
        (commands[0], r"commands has the shape \(19,\): must be \(measurements, 19\)"),
        (commands[:, :3], r"commands has the shape \(160, 3\): must be \(measurements, 19\)"),
        (np.nan * commands, "commands: row 1 holds NaN"),
    ):
        with pytest.raises(ValueError, match=text):
            found.predict(bad)
    with pytest.raises(ExcitationError, match="actuator 3 turned"):
        identify_response(np.where(np.isin(np.arange(19), (2, 3)), 0.0, commands), measured, times)
