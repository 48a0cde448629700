"""Hysteresis and creep of a whole run on the simulation, with maps that are missing or wrong."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dm_calibration import calibrator
from dm_calibration.calibrator import calibrate, fit_effective
from dm_calibration.hysteresis import hysteresis_fit
from dm_calibration.hysteresis.candidate_fit import CANDIDATES
from dm_calibration.hysteresis.features import play_values
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit, fit_hysteresis
from dm_calibration.hysteresis.responses import Responses
from dm_calibration.hysteresis.run import Run, run_of
from dm_calibration.influence.maps import MapSet, StepKind
from dm_calibration.influence.screening import FitOptions
from dm_calibration.procedure.outcome import Outcome
from dm_calibration.procedure.plan import PlanKind, PlanOptions, make_plan
from dm_calibration.procedure.procedure import Procedure
from dm_common.errors import MeasurementError
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_common.hysteresis.observer import HysteresisTracker
from dm_common.measurement import Measurement
from dm_common.mirror import Applied
from dm_common.optics.zernike import PISTON_TILT, basis
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig

pytestmark = pytest.mark.slow

MAPS = 100


class Blinking(SimulatedBench):
    """An interferometer that gives no map for some labels."""

    blind: tuple[str, ...] = ()

    def measure(self, label: str) -> Measurement:
        if label in self.blind:
            self.time += 5.0
            raise MeasurementError(302, "no map within 5 s")
        return super().measure(label)


@cache
def outcome(blind: tuple[str, ...] = (), low: float = -1.0) -> Outcome:
    """Of a mirror whose signals go from `low` to 1."""
    bench = Blinking(SimulationConfig(law="prandtl_ishlinskii", seed=23, pixels=120))
    bench.blind = blind
    bench.limits = replace(bench.limits, low=low)
    bench.mirror = replace(bench.mirror, limits=bench.limits)
    procedure = Procedure(
        make_plan(PlanKind.HYSTERESIS, bench.mirror, PlanOptions(hysteresis_maps=MAPS)), bench.mirror, bench
    )
    return procedure.run()


def run(blind: tuple[str, ...] = (), low: float = -1.0) -> MapSet:
    return outcome(blind, low).maps()


@cache
def fitted(low: float = -1.0) -> HysteresisFit:
    return plays(run(low=low))


def plays(maps: MapSet) -> HysteresisFit:
    """By play operators alone, for speed."""
    laws = [candidate for candidate in CANDIDATES if candidate.name in ("linear", "Prandtl-Ishlinskii")]
    return fit_hysteresis(maps, candidates=laws)


def test_commands_without_a_map_stay_in_the_history() -> None:
    blind = ("rest 3", "excitation 30", "excitation 31", "check 95")
    maps = run(blind)
    assert maps.label == run().label
    assert not np.isfinite(maps.coefficients[[maps.label.index(label) for label in blind]]).any()
    whole, gappy = fitted(), plays(maps)
    assert gappy.maps == whole.maps - len(blind)
    assert 0.5 < gappy.held_out_max_zernike / whole.held_out_max_zernike < 2.0
    assert any("excitation 30" in remark for remark in gappy.remarks)
    assert hysteresis_fit.NO_DEGAUSS not in gappy.remarks


def test_a_range_that_is_not_symmetric_is_as_good() -> None:
    """Mid range, where a degauss ends, is not at 0 then."""
    assert run(low=-0.5).rest == 0.25
    unwired = run(low=-0.5).applied.copy()
    unwired[:, :3] = -1.0  # as the driver reports them
    assert replace(run(low=-0.5), applied=unwired).rest == 0.25
    assert fitted(-0.5).held_out_max_zernike < 1.5 * fitted().held_out_max_zernike
    assert not any("contradict" in remark for remark in fitted(-0.5).remarks)
    assert fitted(-0.5).unknown_sigma < 0.9 * fitted().unknown_sigma  # loops are smaller


def test_the_law_is_fitted_to_the_very_maps_that_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many rounds contradict the law: here one map more in each."""
    fitted_to = []

    def one_more(run: Run, *_: object, **__: object) -> Any:
        fitted_to.append(run)
        residual = np.where(np.arange(60) == len(fitted_to), 100.0, 1.0)[:, None]
        return SimpleNamespace(closest=residual)

    monkeypatch.setattr(hysteresis_fit, "identify", one_more)
    every = Responses(np.zeros((60, 1)), 1, np.ones(60, dtype=bool))
    run = Run(np.zeros((60, 1)), np.arange(60.0), every)
    _, kept = hysteresis_fit._without_outliers(run, np.zeros(60, dtype=bool), ())
    assert kept is fitted_to[-1]
    assert kept.responses.usable.sum() == 60 - hysteresis_fit.OUTLIER_ROUNDS + 1


def test_maps_that_test_the_law_are_compared_with_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fit has not seen them, so that in a short run they are all far from it compared with the others."""
    test = np.arange(60) >= 48
    residual = np.where(test, 10.0, 1.0)[:, None] * np.where(np.arange(60) == 50, 9.0, 1.0)[:, None]
    monkeypatch.setattr(hysteresis_fit, "identify", lambda *_, **__: SimpleNamespace(closest=residual))
    run = Run(np.zeros((60, 1)), np.arange(60.0), Responses(np.zeros((60, 1)), 1, np.ones(60, dtype=bool)))
    kept = hysteresis_fit._without_outliers(run, test, ())[1].responses.usable
    assert np.flatnonzero(~kept).tolist() == [50]


@pytest.mark.parametrize(("worse", "every", "factor"), [(2.0, 4, 2.0), (0.5, 4, 1.0), (2.0, 8, 1.0)])
def test_held_moves_with_larger_errors_raise_the_promise(worse: float, every: int, factor: float) -> None:
    """If there are four of them or more."""
    maps, test = run(), np.array([kind == StepKind.CHECK for kind in run().kind])
    held = test & (np.cumsum(test) % every == 0)
    stamps = maps.stamp_ns[0] + round(20e9) * np.arange(len(maps))
    maps = replace(maps, stamp_ns=stamps, moved_ns=stamps - np.where(held, round(10e9), round(0.7e9)))
    error = np.where(test, np.where(held, worse, 1.0), np.nan)
    found: Any = SimpleNamespace(held_out=error[:, None] * np.ones(maps.terms - PISTON_TILT))
    assert hysteresis_fit._held(found, maps) == pytest.approx(factor)


def test_a_map_that_contradicts_effective_signals_is_not_in_their_influence_function() -> None:
    """By less than hysteresis would explain, had the law not accounted for it."""
    maps, mirror = run(), SimulatedBench(SimulationConfig(seed=23, pixels=120)).mirror
    wrong = maps.label.index("excitation 50")
    surface = np.zeros(maps.terms)
    surface[4] = 1e-7
    coefficients, sag = maps.coefficients.copy(), maps.sag.copy()
    coefficients[wrong] += surface
    sag[wrong] += basis(maps.points.x, maps.points.y)[:, : maps.terms] @ surface
    fit = fit_effective(replace(maps, coefficients=coefficients, sag=sag), fitted(), FitOptions(), mirror)
    assert fit.reasons[wrong].startswith("outlier") and fit.used.sum() == len(maps) - 1


@pytest.mark.parametrize("times", [1, 3])
def test_an_actuator_that_does_not_follow_now_and_then_is_named(monkeypatch: pytest.MonkeyPatch, times: int) -> None:
    """Its contact opens: it stands at mid range in some maps, which are outliers. One of them may be anything."""
    maps, mirror = run(), SimulatedBench(SimulationConfig(seed=23, pixels=120)).mirror
    followed = fit_effective(maps, fitted(), FitOptions(), mirror)
    moved = [row for row, signal in enumerate(maps.applied[:, 8]) if abs(signal) > 0.6][:times]
    coefficients, sag = maps.coefficients.copy(), maps.sag.copy()
    coefficients[moved] -= maps.applied[moved, 8:9] * followed.influence_zernike[:, 8]
    sag[moved] -= maps.applied[moved, 8:9] * followed.influence_sag[:, 8]
    monkeypatch.setattr(calibrator, "fit_hysteresis", lambda *_, **__: fitted())
    monkeypatch.setattr(Outcome, "maps", lambda _: replace(maps, coefficients=coefficients, sag=sag))
    said = calibrate(outcome(), mirror=mirror).limitations
    labels = ", ".join(maps.label[row] for row in moved)
    sentence = f"Actuator 9 did not follow its command in 3 of the 3 maps left out as outliers ({labels})"
    assert sum(sentence in each for each in said) == sum("did not follow" in each for each in said) == (times > 1)


def test_creep_of_before_is_found_though_each_wrong_map_hides_the_next() -> None:
    """More of them than there are rounds."""
    rng = np.random.default_rng(6)
    effective, noise = rng.standard_normal((120, 3)), rng.standard_normal((120, 5))
    fading = np.exp(-np.linspace(0.0, 3.0, 120))[:, None, None] * np.ones(3)
    values = 1e-6 * (effective + 0.5 * fading[:, 0]) @ rng.standard_normal((3, 5)) + 1e-9 * noise
    values[20:25] += 1e-7 * 12.0 ** np.arange(hysteresis_fit.OUTLIER_ROUNDS + 1)[:, None]
    measured = Run(effective, np.arange(120.0), Responses(values, 5, np.ones(120, dtype=bool)))
    np.testing.assert_allclose(hysteresis_fit._crept_before(measured, effective, fading), 0.5, atol=0.1)


@pytest.mark.parametrize("low", [-1.0, -0.5])
def test_who_follows_the_reports_finds_the_signals_that_the_gains_belong_to(low: float) -> None:
    """Creep of before the run fades as fast in the one as in the other, with a spectrum of each actuator's own too."""
    maps, law = run(low=low), fitted(low).law
    own = np.exp(0.3 * np.random.default_rng(4).standard_normal((maps.actuators, len(law.creep_time))))
    effective, law = hysteresis_fit._followed(maps, replace(law, creep_spectrum=own / own.mean()), run_of(maps))
    assert np.abs(law.crept).max() > 0.1
    rest, moved = np.full(maps.actuators, maps.rest), maps.moved_s() + 1e-9 * int(maps.stamp_ns[0])
    tracker = HysteresisTracker(law, maps.rest)
    tracker.observe(Applied(law.crept_at - 60.0, rest, 0, None, 0, False))
    tracker.observe(Applied(law.crept_at - 0.5, rest, 2, rest, 1, True))
    degausses = 1 + np.cumsum(maps.degaussed)
    for turns, (shape, when, count) in enumerate(zip(maps.applied, moved, degausses, strict=True), start=3):
        before = tracker.state
        assert before is not None
        when = max(float(when), law.crept_at)
        turned_at = before.signals
        if maps.degaussed[turns - 3]:
            tracker.observe(Applied(when, turned_at, turns - 1, turned_at, int(count) - 1, True, moving=True))
            turned_at = shape
        tracker.observe(Applied(when, shape, turns, turned_at, int(count), True))
    assert tracker.state is not None
    found = law.effective(law.advance(tracker.state, 1e-9 * int(maps.stamp_ns[-1])))
    np.testing.assert_allclose(found, effective.applied[-1], atol=2e-5)


def test_a_degauss_in_the_course_of_a_run_wipes_its_loops_and_not_its_creep() -> None:
    """In features, and in the effective signals of a law."""
    rng = np.random.default_rng(5)
    signals, time = rng.uniform(-1.0, 1.0, (30, 3)), np.linspace(0.0, 58.0, 30)
    degaussed = np.arange(30) == 20
    signals[degaussed] = 0.0
    nothing = Responses(np.zeros((30, 1)), 1, np.ones(30, dtype=bool))
    whole = Run(signals, time, nothing, -1.0, time - 1.5, degaussed=degaussed)
    plays = whole.along(lambda rows: play_values(rows, np.array([0.2, 0.6])))
    assert not plays[20].any()
    np.testing.assert_array_equal(plays[20:], play_values(signals[20:], np.array([0.2, 0.6])))

    law = HysteresisModel(np.array([0.0, 0.4]), np.array([[0.7], [0.3]]), np.array([1.5]), 0.1, 0.02, CREEP_TIMES)
    state, expected = law.demagnetised(3, -1.0), []
    for row, (shape, when) in enumerate(zip(signals, time, strict=True)):
        if degaussed[row]:
            state = law.degaussed(state, when - 1.5)
        state = law.advance(law.move(state, shape, when - 1.5), when)
        expected.append(law.effective(state))
    np.testing.assert_allclose(whole.follow(law), expected, atol=1e-12)
    assert np.abs(expected[20]).max() > 1e-3  # creep of what stood before


def test_a_figure_that_drifts_is_named() -> None:
    assert not any("drifted" in remark for remark in fitted().remarks)
    maps = run()
    drift = np.zeros_like(maps.coefficients)
    drift[:, 5] = np.linspace(0.0, 100e-9, len(maps))
    found = plays(replace(maps, coefficients=maps.coefficients + drift))
    assert any("the figure drifted more than earlier creep can explain" in remark for remark in found.remarks)


def test_a_map_of_something_else_does_not_enter_the_law() -> None:
    maps, spoilt = run(), np.array(run().coefficients)
    row = maps.label.index("excitation 50")
    spoilt[row, 3:9] += 2e-7
    found = plays(replace(maps, coefficients=spoilt))
    assert found.held_out_max_zernike < 1.5 * fitted().held_out_max_zernike
    assert found.law.creep_rate == pytest.approx(fitted().law.creep_rate, rel=0.05)
    np.testing.assert_allclose(found.law.crept, fitted().law.crept, atol=0.05)
    assert any("excitation 50" in remark for remark in found.remarks)
