"""Maps that arrive later: followed when the mirror drifts, refused when they are bad, kept beside the calibration."""

from __future__ import annotations

import re
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from dm_msgs.msg import Capabilities, SurfaceMapInfo, SurfaceSamples, ZernikeCoefficients
from rclpy.exceptions import InvalidHandle

from dm_calibration.calibration import CALIBRATED_ERROR_MAX, Calibration
from dm_calibration.calibration_messages import calibration_message, put_updates
from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.quality import GRADE_DEAD
from dm_calibration.procedure.applied_history import AppliedHistory, MapNotUsableError
from dm_calibration.recalibration import drift_filter
from dm_calibration.recalibration.check_log import append_check, read_checks
from dm_calibration.recalibration.displaced import described
from dm_calibration.recalibration.drift import Displaced, Drift, UpdateOptions
from dm_calibration.recalibration.map_listener import MapListener
from dm_calibration.recalibration.updates import InUse, RecalibrationManager, Verdict
from dm_calibration.store.calibration_store import CalibrationStore
from dm_calibration.store.hdf5_image import HASH, read_image, write_image
from dm_common.atomic_write import StoreError
from dm_common.hysteresis.creep_record import rested
from dm_common.hysteresis.model import HysteresisModel
from dm_common.measurement import Measurement
from dm_common.optics.sampling import edge_clustered_points
from dm_common.optics.zernike import TERM_RMS
from steady_mirror import Floats, SteadyMirror

Made = tuple[SteadyMirror, Calibration]

#: Without a hysteresis model the node allows for hysteresis; this mirror has none.
EXACT = UpdateOptions(signal_sigma=1e-4)
#: The same where maps show less, of a mirror that is known not to drift.
STEADY = UpdateOptions(signal_sigma=5e-3, gain_rate=0.0, figure_rate=0.0)


@pytest.fixture(scope="module")
def made() -> Made:
    bench = SteadyMirror()
    return bench, bench.calibrate()


@pytest.fixture
def bench(made: Made) -> SteadyMirror:
    bench = made[0]
    bench.drift(0.0)
    bench.clock_ns = made[1].stamp_ns
    bench.plant.random = np.random.default_rng(8)  # the same noise whatever tests were run before
    bench.apply(np.random.default_rng(4).uniform(-0.7, 0.7, bench.mirror.actuators))
    return bench


@pytest.fixture
def updates(made: Made, tmp_path: Path) -> RecalibrationManager:
    return begun(made, tmp_path)


def begun(made: Made, folder: Path, options: UpdateOptions = EXACT, remark: str = "") -> RecalibrationManager:
    updates = RecalibrationManager(folder, lambda: options)
    assert remark in updates.begin(made[1])
    return updates


def in_use(manager: RecalibrationManager) -> InUse:
    assert manager.in_use is not None
    return manager.in_use


def known(manager: RecalibrationManager) -> Drift:
    return in_use(manager).drift


def changed_fit(manager: RecalibrationManager, temperature: float = np.nan) -> InfluenceFit:
    kept = in_use(manager)
    return kept.filter.changed(kept.drift, temperature)


def promise(manager: RecalibrationManager) -> float:
    """Error (m) that the published calibration promises for coefficients."""
    message = calibration_message(in_use(manager).calibration, None, "mirror", 1.0)
    put_updates(message, in_use(manager), np.nan, [], False)
    return message.held_out_max_zernike


def error(bench: SteadyMirror, fit: InfluenceFit) -> float:
    """Largest coefficient error (m) beyond tilt of `fit` at the present shape, without noise."""
    plant = bench.plant
    true = plant.figure_coefficients + plant.fit_terms(plant.influence.T).T @ bench.signals
    return float(np.abs(fit.zernike_offset + fit.influence_zernike @ bench.signals - true)[3:].max())


def test_a_map_that_agrees_is_taken(bench: SteadyMirror, updates: RecalibrationManager) -> None:
    verdict = updates.take(bench.measure("check"), bench.settled())
    assert verdict.accepted
    assert 0.3 < verdict.comparison.surprise < 1.7
    assert known(updates).revision == 1
    assert known(updates).checked_ns == bench.clock_ns


def test_an_older_map_that_comes_late_is_not_the_last_check(bench: SteadyMirror, updates: RecalibrationManager) -> None:
    older, newer = bench.measure("older"), bench.measure("newer", days=2.0)
    for measured in (newer, older):
        assert updates.take(measured, bench.settled()).accepted
    assert (known(updates).revision, known(updates).checked_ns) == (2, newer.stamp_ns)


def test_a_map_dated_a_year_ahead_does_not_end_the_updates(bench: SteadyMirror, updates: RecalibrationManager) -> None:
    """Its clock was set right afterwards: no drift was expected for a year, and maps were refused as surprising."""
    now, rng, gain = bench.clock_ns, np.random.default_rng(11), np.linspace(0.003, 0.01, bench.mirror.actuators)
    assert updates.take(bench.measure("ahead", days=365.0), bench.settled()).accepted
    bench.clock_ns = now
    for night in range(1, 41):
        bench.apply(rng.uniform(-0.7, 0.7, bench.mirror.actuators))
        bench.drift(gain * night / 100)
        verdict = updates.take(bench.measure("night", days=1.0), bench.settled(), now_ns=bench.clock_ns + 10**9)
        assert verdict.accepted, night
    assert known(updates).checked_ns == bench.clock_ns


@pytest.mark.slow
def test_slow_drift_is_followed(bench: SteadyMirror, made: Made, tmp_path: Path) -> None:
    updates = begun(made, tmp_path)
    rng = np.random.default_rng(11)
    gain = 0.01 * rng.uniform(0.3, 1.0, bench.mirror.actuators)
    figure = np.zeros(21)
    figure[4] = 20e-9 * np.sqrt(6.0)  # astigmatism of 20 nm rms
    for night in range(100):
        bench.apply(rng.uniform(-0.7, 0.7, bench.mirror.actuators))
        bench.drift(gain * (night + 1) / 100, figure * (night + 1) / 100)
        assert updates.take(bench.measure("night", days=1.0), bench.settled()).accepted, night
    drift = known(updates)
    assert drift.offset_rms == pytest.approx(20e-9, rel=0.1)
    assert np.abs(drift.gain - gain).max() < 0.25 * gain.max()
    assert error(bench, changed_fit(updates)) < 0.1 * error(bench, made[1].fit)


def test_drift_faster_than_expected_is_followed_and_widens_bounds_until_it_ends(
    bench: SteadyMirror, made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gains change by up to 0.13 % a day for two weeks, four times as fast as expected: most maps came to disagree."""
    drift = 1.25e-3 * np.random.default_rng(3).uniform(-1.0, 1.0, bench.mirror.actuators)
    errors, refused, promises = list[float](), list[int](), list[float]()
    for kept in (1.0, drift_filter.MISFIT_KEPT):  # the first one never learns that drift is faster
        monkeypatch.setattr(drift_filter, "MISFIT_KEPT", kept)
        (folder := tmp_path / f"{kept}").mkdir()
        updates = begun(made, folder, replace(EXACT, figure_rate=1e-10))
        rng, missed = np.random.default_rng(11), list[float]()
        bench.clock_ns, promises, told = made[1].stamp_ns, [promise(updates)], list[str]()
        refused.append(0)
        for night in range(45):
            bench.apply(rng.uniform(-0.7, 0.7, bench.mirror.actuators))
            bench.drift(min(night + 1, 15) * drift)
            missed.append(error(bench, changed_fit(updates)))
            refused[-1] += not updates.take(bench.measure("night", days=1.0), bench.settled()).accepted
            promises.append(promise(updates))
            told.append(" ".join(updates.widened))
        errors.append(float(np.mean(missed[15:25])))
    assert refused[0] > 10 and refused[1] <= 2
    assert errors[1] < 0.3 * errors[0]
    assert promises[15] > 1.2 * promises[0] and promises[-1] < 1.3 * promises[0]
    assert re.search(r"faster than updates.gain_rate and updates.figure_rate: bounds are \d\d% wider until", told[14])


def test_bounds_count_the_drift_to_be_expected_since_the_last_map(updates: RecalibrationManager) -> None:
    """Drawn as the options say, 95 % of the errors of terms that use half of the range are within the bound."""
    kept, rng, days, draws = in_use(updates), np.random.default_rng(6), 30.0, 2000
    bounds = [kept.filter.drift_error(kept.drift, elapsed * 86400.0) for elapsed in (0.0, 1.0, days)]
    assert bounds[0] == 0.0 and bounds[2] == pytest.approx(np.sqrt(days) * bounds[1])
    fit, size = kept.calibration.fit, np.sqrt(days / 2.0) * EXACT.gain_rate
    gains = size * (rng.standard_normal((draws, 1)) + rng.standard_normal((draws, fit.actuators)))
    alone = np.linalg.pinv(fit.influence_zernike[3:]).T
    halves = 0.5 * alone / np.abs(alone).max(axis=1, keepdims=True)
    figure = np.sqrt(days / kept.filter.reduction.size) * EXACT.figure_rate / TERM_RMS[3:]
    errors = np.einsum("di,si,ki->dsk", gains, halves, fit.influence_zernike[3:])
    errors += figure * rng.standard_normal((draws, 1, len(figure)))
    inside = np.mean(np.abs(errors).max(axis=2) < bounds[2], axis=0)  # of each term
    assert 0.9 < inside.min() < 0.99


def test_one_map_after_a_month_does_not_end_the_doubt_that_drift_causes(
    bench: SteadyMirror, made: Made, tmp_path: Path
) -> None:
    """It shows a part of the drift, and changes nothing yet: of 160 requests after it none was inside its bound."""
    days, rng, inside = 30.0, np.random.default_rng(5), list[bool]()
    size, figure = EXACT.gain_rate * np.sqrt(days / 2.0), np.zeros(21)
    for draw in range(8):
        (folder := tmp_path / f"{draw}").mkdir()
        updates, bench.clock_ns = begun(made, folder), made[1].stamp_ns
        gain = size * (rng.standard_normal() + rng.standard_normal(bench.mirror.actuators))
        figure[3:] = np.sqrt(days / in_use(updates).filter.reduction.size) * EXACT.figure_rate / TERM_RMS[3:]
        figure[3:] *= rng.standard_normal(18)
        bench.drift(gain, figure)
        bench.apply(rng.uniform(-0.5, 0.5, bench.mirror.actuators))
        bounds = [promise(updates)]
        assert updates.take(bench.measure("month", days=days), bench.settled()).accepted
        bounds.append(promise(updates))
        assert 5.0 * bounds[0] < bounds[1]
        for _ in range(20):
            bench.apply(rng.uniform(-0.5, 0.5, bench.mirror.actuators))
            inside.append(error(bench, changed_fit(updates)) <= bounds[1])
    assert np.mean(inside) > 0.9


def test_one_bad_map_changes_nothing(bench: SteadyMirror, updates: RecalibrationManager) -> None:
    updates.take(bench.measure("good"), bench.settled())
    before = changed_fit(updates)
    verdict = updates.take(bench.measure("bumped", bump=30e-9), bench.settled())
    assert not verdict.accepted
    assert verdict.comparison.surprise > 3.0
    assert "bad map, or the mirror has changed" in verdict.reason
    assert not verdict.comparison.displaced
    assert np.array_equal(changed_fit(updates).influence_sag, before.influence_sag)
    assert np.array_equal(changed_fit(updates).sag_offset, before.sag_offset)
    assert known(updates).revision == 1
    assert not updates.mirror_changed


@pytest.mark.parametrize("stuck", [(6,), (0, 11)])
def test_actuators_that_stick_are_named(
    bench: SteadyMirror, updates: RecalibrationManager, stuck: tuple[int, ...]
) -> None:
    settled = bench.settled()
    at = bench.signals.copy()
    at[list(stuck)] = 0.0
    bench.apply(at)
    verdict = updates.take(bench.measure("stuck"), settled)
    assert not verdict.accepted
    assert set(verdict.comparison.displaced) == set(stuck)
    for actuator in stuck:
        wanted = settled.effective[actuator]
        assert verdict.comparison.displaced[actuator].more == pytest.approx(-wanted, abs=0.01)
        assert f"actuator {actuator + 1} stands at " in verdict.reason
        assert f"instead of {wanted:+.2f}, as if it were dead" in verdict.reason or abs(wanted) < 0.1
        assert verdict.comparison.displaced[actuator].probability > 0.99


@pytest.mark.parametrize("other", [0.0, 0.02])
def test_one_map_of_an_actuator_that_sticks_widens_the_bound_for_every_other_shape(
    bench: SteadyMirror, updates: RecalibrationManager, other: float
) -> None:
    """Where it is asked to stand nearly where it stays, the map shows little of what it does elsewhere.

    Nor is the bound larger than what it does at the far end where another one is off by little.
    """

    def shown(wanted: Floats) -> Verdict:
        settled = replace(bench.settled(), effective=wanted)
        at = np.where(np.arange(wanted.size) == 6, 0.2, wanted)
        at[11] += other
        bench.apply(at)
        return updates.take(bench.measure("stuck"), settled)

    rng = np.random.default_rng(4)
    shapes = rng.uniform(-0.7, 0.7, (20, bench.mirror.actuators))
    shapes[0, 6] = 0.35
    first = shown(shapes[0]).comparison.max_zernike
    bound = known(updates).disagreement
    errors = [shown(wanted).comparison.max_zernike for wanted in shapes[1:]]
    assert max(errors) > 2.0 * first
    assert max(errors) < bound < 4.0 * max(errors)


def test_it_goes_on_without_actuators_that_stick(bench: SteadyMirror, made: Made, tmp_path: Path) -> None:
    updates, stuck = begun(made, tmp_path), [6, 11]
    settled = bench.settled()
    at = bench.signals.copy()
    at[stuck] = [0.0, 0.3]
    bench.apply(at)
    map_ = bench.measure("stuck")
    assert "./dm check --without 7 --without 12 continues without" in updates.take(map_, settled, dry_run=True).reason
    verdict = updates.take(map_, settled, without=[*stuck, *stuck])  # named twice it stands where it stands
    assert verdict.accepted and not updates.mirror_changed
    assert "Used without actuators 7 (fixed at " in verdict.reason and ", 12 (fixed at +0.30)" in verdict.reason
    for manager in (updates, begun(made, tmp_path)):  # it is stored
        fit = changed_fit(manager)
        np.testing.assert_allclose(known(manager).stuck[stuck], [0.0, 0.3], atol=0.01)
        assert not fit.influence_sag[:, stuck].any() and (fit.grades[stuck] == GRADE_DEAD).all()
        assert error(bench, fit) < 3e-9
        message = calibration_message(in_use(manager).calibration, None, "mirror", 1.0)
        put_updates(message, in_use(manager), np.nan, manager.doubts, False)
        assert message.quality == Capabilities.APPROXIMATE and message.actuator_grade[6] == "dead"
        assert any("Used without actuators 7" in sentence for sentence in message.known_limitations)
    for _ in range(2):  # later maps agree, whatever is asked of the two
        wanted = np.random.default_rng(8).uniform(-0.7, 0.7, bench.mirror.actuators)
        at = np.where(np.isin(np.arange(wanted.size), stuck), at, wanted)
        bench.apply(at)
        later = updates.take(bench.measure("later"), replace(settled, effective=wanted))
        assert later.accepted, later.reason
    bench.apply(wanted)
    back = updates.take(bench.measure("back"), replace(settled, effective=wanted))
    assert f"actuator 12 stands at {wanted[11]:+.2f} instead of +0.30, moves again" in back.reason
    assert back.reason.endswith("; ./dm check --forget uses it again")
    updates.forget()
    assert updates.take(bench.measure("whole"), replace(settled, effective=wanted)).accepted


@pytest.mark.parametrize("weak", [False, True])
def test_one_that_is_given_up_and_may_only_be_weakened_keeps_bounds_wide_until_another_shape_shows_it(
    bench: SteadyMirror, made: Made, tmp_path: Path, weak: bool
) -> None:
    """Of a patch at 70 %, given up because of one map, 4 nm were told and 88 made."""
    updates, settled = begun(made, tmp_path), bench.settled()
    worst, at = int(np.abs(settled.effective).argmax()), bench.signals.copy()
    at[worst] *= 0.7
    bench.apply(at)
    assert not updates.take(bench.measure("weak"), settled).accepted
    for name, without in (("given up", [worst]), ("the same shape", [])):
        assert updates.take(bench.measure(name), settled, without=without).accepted
        again = begun(made, tmp_path)  # it is stored
        assert promise(again) > 50e-9 and "if not only weakened: check another shape" in again.doubts[0]
    wanted = np.random.default_rng(8).uniform(-0.5, 0.5, bench.mirror.actuators)
    wanted[worst] = 0.0  # nothing is asked of it any more
    bench.apply(wanted if weak else np.where(np.arange(wanted.size) == worst, at, wanted))
    assert updates.take(bench.measure("another"), replace(settled, effective=wanted)).accepted != weak
    assert (promise(updates) < 10e-9) != weak and ("weakened" in updates.doubts[0]) == weak


@pytest.mark.parametrize("share, signal", [(0.25, -0.09), (0.5, 0.07), (0.05, 0.7), (0.0, 0.09)])
def test_one_that_is_given_up_near_mid_range_counts_as_weakened_until_a_map_shows_it_at_the_same_place(
    bench: SteadyMirror, made: Made, tmp_path: Path, share: float, signal: float
) -> None:
    """Of a patch at 25 %, given up in a shape that asked little of it, 9 nm were told and 227 made."""
    updates, settled, wanted = begun(made, tmp_path), bench.settled(), bench.signals.copy()
    for name, at in (("given up", signal), ("hardly another shape", 1.1 * signal), ("another", -0.6)):
        wanted[6] = at
        bench.apply(np.where(np.arange(wanted.size) == 6, share * wanted, wanted))
        without = [6] if name == "given up" else []
        updates.take(bench.measure(name), replace(settled, effective=wanted), without=without)
        assert error(bench, changed_fit(updates)) < 2.0 * promise(updates), name
        assert ("if not only weakened" in updates.doubts[0]) == (bool(share) or name != "another"), name
    assert (promise(updates) < 10e-9) == (not share)


@pytest.mark.parametrize("signal", [-0.5, 0.05])
def test_one_that_is_given_up_again_elsewhere_has_moved_and_is_not_taken_for_stuck(
    bench: SteadyMirror, made: Made, tmp_path: Path, signal: float
) -> None:
    updates, settled = begun(made, tmp_path), bench.settled()
    worst, wanted = int(np.abs(settled.effective).argmax()), bench.signals.copy()
    for name, more in (("one shape", 1.0), ("another shape", signal / wanted[worst])):
        wanted[worst] *= more
        bench.apply(np.where(np.arange(wanted.size) == worst, 0.7 * wanted, wanted))
        assert updates.take(bench.measure(name), replace(settled, effective=wanted), without=[worst]).accepted
        assert promise(updates) > 50e-9 and "if not only weakened: check another shape" in updates.doubts[0]
        assert known(updates).stuck[worst] == pytest.approx(0.7 * wanted[worst], abs=0.01)


def test_an_actuator_that_was_dead_when_calibrated_and_moves_is_named(tmp_path: Path) -> None:
    bench = SteadyMirror()
    moves = bench.plant.influence
    bench.plant.influence = moves * (np.arange(bench.mirror.actuators) != 6)
    updates = begun((bench, bench.calibrate()), tmp_path)
    bench.apply(np.random.default_rng(4).uniform(-0.7, 0.7, bench.mirror.actuators))
    assert updates.take(bench.measure("dead"), bench.settled()).accepted
    bench.plant.influence = moves
    reason = updates.take(bench.measure("back"), bench.settled()).reason
    assert "actuator 7 moves, but showed no response in the calibration (" in reason
    assert reason.endswith("%); ./dm calibrate measures it")


def test_where_another_one_sticks_than_was_given_up_the_map_names_that_alone(
    bench: SteadyMirror, updates: RecalibrationManager
) -> None:
    """The one given up was named too, with the place that the map would show it at if it alone were displaced."""
    settled, at = bench.settled(), bench.signals.copy()
    at[6] = -1.0
    bench.apply(at)
    map_ = bench.measure("stuck")
    alone = updates.take(map_, settled, dry_run=True)
    verdict = updates.take(map_, settled, without=[7])
    assert not verdict.accepted and not known(updates).given_up
    assert "./dm check --without 7 continues without" in verdict.reason and "actuator 8" not in verdict.reason
    assert verdict.comparison.max_zernike == alone.comparison.max_zernike


def test_an_actuator_that_stands_where_it_should_is_not_given_up(
    bench: SteadyMirror, updates: RecalibrationManager
) -> None:
    with pytest.raises(MapNotUsableError, match=r"actuator 7 stands at .*: this shape does not show that it fails"):
        updates.take(bench.measure("fine"), bench.settled(), without=[6])
    assert known(updates).revision == 0 and not known(updates).given_up


def test_an_actuator_is_not_given_up_at_a_place_that_none_reaches(
    bench: SteadyMirror, updates: RecalibrationManager
) -> None:
    settled, beyond = bench.settled(), bench.signals.copy()
    beyond[6] = 1.6
    bench.apply(beyond)
    with pytest.raises(MapNotUsableError, match=r"actuator 7 stands at \+1\.60 \+- 0\.00, none beyond 1\.5: the map"):
        updates.take(bench.measure("dust"), settled, without=[6])


def test_the_last_actuator_is_not_given_up(bench: SteadyMirror, updates: RecalibrationManager) -> None:
    """Nothing could be planned without any."""
    settled, count = bench.settled(), bench.mirror.actuators
    bench.apply(np.where(np.arange(count) == 6, bench.signals, 0.9))
    assert updates.take(bench.measure("all but one"), settled, without=[k for k in range(count) if k != 6]).accepted
    bench.apply(np.full(count, 0.9))
    with pytest.raises(MapNotUsableError, match="no actuator that responds would be left: calibrate anew"):
        updates.take(bench.measure("the last"), settled, without=[6])


def test_what_was_given_up_creeps_on_inside_the_bound(bench: SteadyMirror, made: Made, tmp_path: Path) -> None:
    updates, settled = begun(made, tmp_path), bench.settled()
    fallen = bench.signals.copy()
    fallen[6] = -1.0
    bench.apply(fallen)
    assert updates.take(bench.measure("fallen"), settled, without=[6]).accepted
    kept, law = in_use(updates), HysteresisModel.linear(0.01)
    assert kept.filter.stuck_error(kept.drift) == 0.0, "nothing is known of its creep"
    kept.filter._creep_law = law
    message = calibration_message(kept.calibration, None, "mirror", 1.0)
    put_updates(message, kept, np.nan, [], False)
    now, hour = law.move(rested(law, fallen * 0.0, 0.0), fallen, 0.0), 3600.0
    crept = (law.effective(law.advance(now, hour)) - law.effective(law.advance(now, 1.0)))[6]
    further = np.abs(kept.calibration.fit.influence_zernike[3:, 6] * crept).max()
    assert 0.3 * message.held_out_max_zernike < further < message.held_out_max_zernike


def test_an_actuator_without_any_influence_is_not_given_up(made: Made, tmp_path: Path) -> None:
    bench, calibration = SteadyMirror(), made[1]
    moves, fit = np.arange(bench.mirror.actuators) != 4, calibration.fit
    none = {name: getattr(fit, name) * moves for name in ("influence_zernike", "influence_sag", "response")}
    bench.plant.influence = bench.plant.influence * moves
    bench.clock_ns = calibration.stamp_ns
    updates = begun((bench, replace(calibration, fit=replace(fit, **none))), tmp_path)
    with pytest.raises(MapNotUsableError, match=r"actuator 5 stands at .*: this shape does not show that it fails"):
        updates.take(bench.measure("fine"), bench.settled(), without=[4])


def test_the_last_actuator_is_never_offered_to_go_on_without() -> None:
    dead, three = {1: Displaced(-0.5, 1.0)}, np.full(3, 0.5)
    for given_up, offered in (([False] * 3, True), ([True, False, True], False)):
        text = described(dead, three, np.array(given_up), np.zeros(3, bool))
        assert ("./dm check --without 2" in text) == offered and "as if it were dead (100%)" in text


def test_one_that_is_not_sure_does_not_keep_back_what_to_do_about_one_that_is() -> None:
    shown = {1: Displaced(-0.5, 1.0), 2: Displaced(-0.2, 0.0)}
    text = described(shown, np.full(3, 0.5), np.zeros(3, bool), np.zeros(3, bool))
    assert "actuator 3 stands at +0.30 instead of +0.50, as if weakened to 60% (0%)" in text
    assert text.endswith("; ./dm check --without 2 continues without what does not move")


def test_a_place_that_no_actuator_reaches_is_not_told() -> None:
    """A map with a third of the pupil missing passed for actuators at -5.8 and +2.9."""
    shown = {1: Displaced(-5.3, 0.0), 2: Displaced(2.6, 0.0)}
    text = described(shown, np.full(3, 0.3), np.zeros(3, bool), np.zeros(3, bool))
    assert text == "bad map, or the mirror has changed"


@pytest.mark.parametrize("gain", [0.6, 0.87])
def test_a_weakened_actuator_is_named_with_its_probability(
    bench: SteadyMirror, updates: RecalibrationManager, gain: float
) -> None:
    """Without it, one that still moves would err by tens of nanometres."""
    settled = bench.settled()
    worst = int(np.abs(settled.effective).argmax())
    at = bench.signals.copy()
    at[worst] *= gain
    bench.apply(at)
    verdict = updates.take(bench.measure("weak"), settled)
    assert f"actuator {worst + 1} stands at" in verdict.reason
    condition = "if it is at the same place in another shape, ./dm check"
    assert f"as if weakened to {gain:.0%} (100%); {condition}" in verdict.reason


@pytest.mark.parametrize(("away", "named"), [(0.0, False), (0.03, True)])
def test_a_map_that_agrees_names_an_actuator_that_begins_to_fail(
    bench: SteadyMirror, made: Made, tmp_path: Path, away: float, named: bool
) -> None:
    """One that lost 10 % within a week was told when maps disagreed, days after bounds had ceased to hold."""
    settled = bench.settled()
    at = bench.signals.copy()
    at[4] += away
    bench.apply(at)
    updates = begun(made, tmp_path, STEADY)
    before = promise(updates)
    verdict = updates.take(bench.measure("weak"), settled)
    assert verdict.accepted
    assert ("expected difference; actuator 5 stands at +0.18 instead of +0.15 (100%)" in verdict.reason) == named
    assert named or verdict.reason.endswith("expected difference")
    # In other shapes it may err as much.
    effect = np.abs(made[1].fit.influence_zernike[3:, 4]).max() * away
    assert promise(updates) == pytest.approx(max(before, effect), rel=0.1)
    assert "an actuator that may begin to fail" in " ".join(updates.widened) if named else not updates.widened
    bench.apply(bench.signals - away * (np.arange(bench.signals.size) == 4))
    assert updates.take(bench.measure("well", days=1.0), bench.settled()).accepted
    assert promise(updates) == pytest.approx(before, rel=0.2) and not updates.widened


@pytest.mark.parametrize("place", [0.5, -0.3])
def test_a_map_of_the_shape_in_which_an_actuator_got_stuck_does_not_restore_the_bound(
    bench: SteadyMirror, made: Made, tmp_path: Path, place: float
) -> None:
    """Between two shapes in turn the bound was 0.4 nm with an error of 1355 in the next one."""
    shapes = np.random.default_rng(4).uniform(-0.7, 0.7, (3, bench.mirror.actuators))
    shapes[:, 4] = -0.05, place, -0.9 * np.sign(place)
    promises, updates = list[float](), begun(made, tmp_path, STEADY)
    for wanted in shapes[:2]:
        bench.apply(np.where(np.arange(wanted.size) == 4, place, wanted))
        settled = replace(bench.settled(), effective=wanted)
        assert updates.take(bench.measure("check"), settled).accepted == bool(promises)
        promises.append(promise(updates))
    bench.apply(np.where(np.arange(bench.mirror.actuators) == 4, place, shapes[2]))
    assert promises[0] == promises[1] > np.abs(changed_fit(updates).influence_zernike[3:, 4]).max()
    bench.apply(shapes[2])  # it moves again
    assert updates.take(bench.measure("well"), bench.settled()).accepted and promise(updates) < 5e-9


def test_a_map_in_which_a_weakened_actuator_hardly_moves_does_not_restore_the_bound(
    bench: SteadyMirror, made: Made, tmp_path: Path
) -> None:
    """Of a patch that had lost a fifth, such a map made the bound 2 nm, with errors of 18."""
    shapes = np.random.default_rng(4).uniform(-0.7, 0.7, (4, bench.mirror.actuators))
    shapes[:, 4] = 0.5, 0.01, -0.02, 0.5
    promises = list[float]()
    for wanted, gain in zip(shapes, (0.8, 0.8, 0.8, 1.0), strict=True):
        settled = replace(bench.settled(), effective=wanted)
        bench.apply(wanted * np.where(np.arange(wanted.size) == 4, gain, 1.0))
        updates = begun(made, tmp_path, STEADY)  # also across a restart
        assert updates.take(bench.measure("check"), settled).accepted == bool(promises)
        promises.append(promise(begun(made, tmp_path, STEADY)))
        assert ("may begin to fail" in " ".join(updates.widened)) == (abs(wanted[4]) < 0.1)
    assert promises[0] == promises[1] == promises[2] > 100e-9
    assert promises[3] < 5e-9


def test_one_that_moves_again_widens_bounds_too(bench: SteadyMirror, made: Made, tmp_path: Path) -> None:
    updates, settled = begun(made, tmp_path, UpdateOptions(signal_sigma=2e-2)), bench.settled()
    for name, at in (("dead", -0.4), ("moves", -0.2)):
        bench.apply(np.where(np.arange(bench.signals.size) == 6, at, bench.signals))
        assert updates.take(bench.measure(name), settled, without=[6] if name == "dead" else []).accepted
    assert "begin to fail, or moves again: bounds are wider" in updates.widened[-1]


def test_an_error_of_the_law_is_not_put_down_to_actuators(bench: SteadyMirror, updates: RecalibrationManager) -> None:
    """It passed for two actuators displaced by a few hundredths of a signal, which were to be given up."""
    settled = bench.settled()
    at = bench.signals.copy()
    at[[4, 6]] += [0.02, -0.03]
    bench.apply(at)
    verdict = updates.take(bench.measure("law"), settled)
    assert not verdict.accepted and "--without" not in verdict.reason
    assert known(updates).disagreement == verdict.comparison.max_zernike


def test_a_mirror_counts_as_calibrated_as_long_as_its_present_bound_is_small_enough(
    bench: SteadyMirror, updates: RecalibrationManager
) -> None:
    settled, at = bench.settled(), bench.signals.copy()
    at[6] += 0.2
    for shape, agrees in ((at, False), (bench.signals.copy(), True)):
        bench.apply(shape)
        assert updates.take(bench.measure("shape"), settled).accepted == agrees
        promised = promise(updates)
        for error_max, changed in ((0.99, False), (1.01, True), (1.01, False)):
            message = calibration_message(in_use(updates).calibration, None, "mirror", 1.0)
            put_updates(message, in_use(updates), np.nan, [], changed, error_max * promised)
            assert (message.quality == Capabilities.CALIBRATED) == (error_max > 1.0 and not changed)


@pytest.mark.parametrize("term", [3, 4, 5, 6, 7])
def test_a_change_of_one_coefficient_is_not_put_down_to_actuators(
    bench: SteadyMirror, updates: RecalibrationManager, term: int
) -> None:
    """Such as by another focus of the interferometer: after weeks it looks much like one or two displaced actuators."""
    bench.drift(0.0, 40e-9 * np.eye(21)[term])
    verdict = updates.take(bench.measure("focus", days=60.0), bench.settled())
    assert not verdict.accepted
    assert all(one.probability < 0.1 for one in verdict.comparison.displaced.values())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_mirror_that_does_not_drift_is_not_made_worse(
    bench: SteadyMirror, made: Made, tmp_path: Path, seed: int
) -> None:
    """A map a month, so that the prior lets each one change much: before, it took the noise of the map for drift."""
    updates = begun(made, tmp_path)
    rng = np.random.default_rng(seed)
    errors = []
    for _ in range(12):
        bench.apply(rng.uniform(-0.7, 0.7, bench.mirror.actuators))
        errors.append([error(bench, fit) for fit in (made[1].fit, changed_fit(updates))])
        assert updates.take(bench.measure("month", days=30.0), bench.settled()).accepted
    without, kept = np.sqrt(np.mean(np.square(errors), axis=0))
    assert kept < 1.02 * without


def warm_months(
    bench: SteadyMirror, updates: RecalibrationManager, rng: np.random.Generator, gain: float, figure: float, maps: int
) -> None:
    """Maps of random shapes, a day apart, at 15 to 25 degC; gains and astigmatism change by so much per K."""
    for _ in range(maps):
        temperature = float(rng.uniform(15.0, 25.0))
        warm(bench, rng, gain, figure, temperature)
        measured = replace(bench.measure("warm", days=1.0), temperature=temperature)
        verdict = updates.take(measured, bench.settled())
        assert verdict.accepted, verdict.reason


def warm(bench: SteadyMirror, rng: np.random.Generator, gain: float, figure: float, temperature: float) -> None:
    """Another shape at this temperature; the calibration is of 20 degC."""
    bench.drift(gain * (temperature - 20.0), figure * (temperature - 20.0) * np.sqrt(6.0) * (np.arange(21) == 4))
    bench.apply(rng.uniform(-0.7, 0.7, bench.mirror.actuators))


def at_20_degrees(made: Made) -> Made:
    bench, calibration = made
    maps = calibration.maps
    return bench, replace(calibration, maps=replace(maps, temperature=np.full(len(maps), 20.0)))


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "figure"), [(1e-3, 2e-9), (0.0, 3e-9), (-2e-3, 0.0)])
def test_what_the_temperature_does_is_foretold(
    bench: SteadyMirror, made: Made, tmp_path: Path, gain: float, figure: float
) -> None:
    """Learnt from a month of maps, stored, and corrected at a temperature that has not been before."""
    warmed, rng = at_20_degrees(made), np.random.default_rng(21)
    warm_months(bench, begun(warmed, tmp_path), rng, gain, figure, 30)
    updates, errors = begun(warmed, tmp_path), []
    assert known(updates).thermal_trust > 0.5
    for temperature in (12.0, 16.0, 24.0, 28.0):
        warm(bench, rng, gain, figure, temperature)
        fits = (made[1].fit, changed_fit(updates), changed_fit(updates, temperature))
        errors.append([error(bench, fit) for fit in fits])
    without, not_known, with_temperature = np.sqrt(np.mean(np.square(errors), axis=0))
    assert with_temperature < 0.3 * without
    # Where it stops coming the bound says what it may do; where it comes, no bound is wider.
    kept = in_use(updates)
    bound = kept.filter.warm_error(kept.drift, np.nan)
    assert 0.3 * not_known < bound < 10.0 * not_known
    assert kept.filter.warm_error(kept.drift, 20.0) == 0.0
    message = calibration_message(in_use(updates).calibration, None, "mirror", 1.0)
    put_updates(message, in_use(updates), np.nan, [], False)
    assert message.held_out_max_zernike > bound
    warm(bench, rng, gain, figure, 25.0)  # and a map without it is still taken
    assert updates.take(bench.measure("not known"), bench.settled()).accepted


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_temperature_that_does_nothing_makes_nothing_worse(
    bench: SteadyMirror, made: Made, tmp_path: Path, seed: int
) -> None:
    warmed, rng, errors = at_20_degrees(made), np.random.default_rng(seed), []
    updates = begun(warmed, tmp_path)
    for _ in range(12):
        warm_months(bench, updates, rng, 0.0, 0.0, 1)
        bench.apply(rng.uniform(-0.7, 0.7, bench.mirror.actuators))
        fits = (made[1].fit, changed_fit(updates, float(rng.uniform(15.0, 25.0))))
        errors.append([error(bench, fit) for fit in fits])
    without, kept = np.sqrt(np.mean(np.square(errors), axis=0))
    assert kept < 1.02 * without


def test_nothing_is_used_before_a_second_shape_has_borne_it_out(
    bench: SteadyMirror, made: Made, updates: RecalibrationManager
) -> None:
    bench.drift(2e-3)
    settled = bench.settled()
    for _ in range(3):  # repeats of one shape are no evidence
        updates.take(bench.measure("check"), settled)
    assert known(updates).trust == 0.0
    assert np.array_equal(changed_fit(updates).influence_sag, made[1].fit.influence_sag)
    rng = np.random.default_rng(5)
    for _ in range(3):
        bench.apply(rng.uniform(-0.7, 0.7, bench.mirror.actuators))
        updates.take(bench.measure("another"), bench.settled())
    assert known(updates).trust > 0.5
    assert error(bench, changed_fit(updates)) < error(bench, made[1].fit)


def test_a_bad_map_widens_the_bound_at_once_and_a_good_one_restores_it(
    bench: SteadyMirror, made: Made, tmp_path: Path
) -> None:
    promises = {}
    for name, bump in (("first", 0.0), ("bad", 40e-9), ("good", 0.0)):
        begun(made, tmp_path).take(bench.measure(name, bump=bump), bench.settled())
        promises[name] = promise(begun(made, tmp_path))  # also across a restart
    assert promises["bad"] > 20e-9
    assert promises["good"] == promises["first"] < 5e-9


def test_a_map_of_another_shape_is_refused(bench: SteadyMirror, updates: RecalibrationManager) -> None:
    claimed = bench.settled()
    bench.apply(-bench.signals)
    assert not updates.take(bench.measure("wrong"), claimed).accepted


def test_several_bad_maps_in_a_row_tell_of_a_changed_mirror(bench: SteadyMirror, updates: RecalibrationManager) -> None:
    reasons, widened = list[str](), [updates.widened]
    for _ in range(3):
        reasons.append(updates.take(bench.measure("bumped", bump=30e-9), bench.settled()).reason)
        widened.append(updates.widened)
    assert updates.mirror_changed
    assert widened[0] == widened[3] == []  # in the end it is a doubt
    assert widened[1] == ["The last map disagrees with this calibration: bounds are wider until one agrees."]
    assert widened[2][0].startswith("The last 2 maps disagree with this calibration")
    assert "calibrate again" not in reasons[1]
    assert "3 maps in a row disagree: the mirror has changed: calibrate again" in reasons[2]
    assert updates.take(bench.measure("good"), bench.settled()).accepted
    assert not updates.mirror_changed and not updates.widened


def test_maps_of_one_unmoved_mirror_count_for_less_and_less(bench: SteadyMirror, updates: RecalibrationManager) -> None:
    settled = bench.settled()
    sizes = []
    for _ in range(12):
        updates.take(bench.measure("again"), settled)
        sizes.append(np.trace(known(updates).covariance))
    gained = -np.diff(sizes)
    assert gained[-1] < 0.2 * gained[0]


def test_a_dry_run_compares_only(bench: SteadyMirror, updates: RecalibrationManager, tmp_path: Path) -> None:
    verdict = updates.take(bench.measure("check"), bench.settled(), dry_run=True)
    assert verdict.accepted
    assert known(updates).revision == 0
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: replace(m, wavelength=635e-9), "wavelength 635.000 nm, the calibration's is 632.800 nm"),
        (lambda m: replace(m, wavelength=float("nan")), "wavelength nan nm"),
        (lambda m: replace(m, radius=10e-3), r"aperture radius 10.000 mm, the calibration's is 11.000 mm \+-2.0%"),
        (lambda m: replace(m, points=edge_clustered_points(200)), "sampled at other points"),
        (lambda m: replace(m, valid_fraction=0.4), "40.0% of the pixels are valid: must be at least 50.0%"),
        (lambda m: replace(m, sag=np.where(m.points.x > -0.3, np.nan, m.sag)), "of the sampled area has data"),
        (lambda m: replace(m, coefficients=m.coefficients[:15]), "the map has 15 Zernike terms, the calibration 21"),
        (lambda m: replace(m, coefficients=np.full(21, np.nan)), "coefficients: hold values that are not finite"),
        (lambda m: replace(m, stamp_ns=1), r"stamp \d+\.\d{3} s before the calibration was finished"),
    ],
)
def test_maps_that_cannot_be_compared_are_refused(
    change: Callable[[Measurement], Measurement], words: str, bench: SteadyMirror, updates: RecalibrationManager
) -> None:
    with pytest.raises(MapNotUsableError, match=words):
        updates.take(change(bench.measure("check")), bench.settled())
    assert known(updates).revision == 0


def test_a_map_from_which_the_instrument_took_something_else_is_refused(
    bench: SteadyMirror, made: Made, tmp_path: Path
) -> None:
    updates = begun((made[0], replace(made[1], system_error_subtracted=0)), tmp_path)
    measured = bench.measure("check")
    with pytest.raises(MapNotUsableError, match="system_error_subtracted = 1, the calibration's is 0"):
        updates.take(replace(measured, system_error_subtracted=1), bench.settled())
    assert updates.take(measured, bench.settled()).accepted  # not known of it


def test_options_that_change_while_a_calibration_is_in_use_count_for_the_next_map(
    bench: SteadyMirror, made: Made, tmp_path: Path
) -> None:
    options = EXACT
    updates = RecalibrationManager(tmp_path, lambda: options)
    updates.begin(made[1])
    assert updates.take(bench.measure("first"), bench.settled()).accepted
    bench.drift(2e-2)
    measured, settled = bench.measure("check"), bench.settled()
    exact = updates.take(measured, settled, dry_run=True).comparison.surprise
    options = replace(EXACT, signal_sigma=0.1)
    assert updates.take(measured, settled, dry_run=True).comparison.surprise < 0.1 * exact
    assert known(updates).revision == 1  # what was learnt stays


def test_points_without_data_do_no_harm(bench: SteadyMirror, updates: RecalibrationManager) -> None:
    measured = bench.measure("check")
    gaps = np.where(np.arange(measured.sag.size) % 10 == 0, np.nan, measured.sag)
    whole = updates.take(measured, bench.settled(), dry_run=True).comparison
    verdict = updates.take(replace(measured, sag=gaps), bench.settled())
    assert verdict.accepted
    assert verdict.comparison.surprise == pytest.approx(whole.surprise, rel=0.3)


def test_updates_are_there_again_and_the_calibration_file_is_as_it_was(
    bench: SteadyMirror, made: Made, tmp_path: Path
) -> None:
    file = CalibrationStore(tmp_path).save(made[1])
    content = file.read_bytes()
    updates = begun(made, tmp_path)
    bench.drift(2e-4)
    updates.take(bench.measure("check"), bench.settled())
    again = begun(made, tmp_path)
    assert known(again).revision == 1
    assert np.array_equal(changed_fit(again).influence_sag, changed_fit(updates).influence_sag)
    assert file.read_bytes() == content
    assert [entry.remark for entry in CalibrationStore(tmp_path).entries()] == [""]


def test_updates_of_before_temperatures_were_kept_are_read(
    bench: SteadyMirror, made: Made, updates: RecalibrationManager, tmp_path: Path
) -> None:
    """What was known of gains and figure is known, and of the temperature as much as at the start."""
    updates.take(bench.measure("check", days=1.0), bench.settled())
    stored, (file,) = known(updates), tmp_path.glob("*.updates.hdf5")
    columns, attributes = read_image(file)
    size = stored.gain.size + stored.offset.size
    before = {"gain": stored.gain, "offset": stored.offset, "covariance": stored.covariance[:size, :size]}
    kept = {name: value for name, value in attributes.items() if name not in ("warm_foretold", "warm_borne_out", HASH)}
    file.write_bytes(write_image({**before, "stuck": columns["stuck"]}, kept))
    read = known(begun(made, tmp_path))
    assert read.revision == 1 and np.array_equal(read.gain, stored.gain)
    assert np.array_equal(read.covariance[:size, :size], before["covariance"])
    assert not read.thermal.any() and not read.crept.any() and read.thermal_trust == 0.0
    assert np.diag(read.covariance)[size : size + read.thermal.size].all()
    file.write_bytes(write_image({**before, "covariance": before["covariance"][None]}, kept))
    assert known(begun(made, tmp_path, remark="finite numbers")).revision == 0


def test_forgotten_updates_are_gone(
    bench: SteadyMirror, made: Made, updates: RecalibrationManager, tmp_path: Path
) -> None:
    updates.take(bench.measure("check"), bench.settled())
    updates.forget()
    assert known(updates).revision == 0
    assert np.array_equal(changed_fit(updates).influence_sag, made[1].fit.influence_sag)
    assert not list(tmp_path.glob("*.updates.hdf5"))


def test_a_damaged_file_is_told_and_ignored(
    bench: SteadyMirror, made: Made, updates: RecalibrationManager, tmp_path: Path
) -> None:
    updates.take(bench.measure("check"), bench.settled())
    file = next(tmp_path.glob("*.updates.hdf5"))
    file.write_bytes(file.read_bytes()[:2000])
    again = begun(made, tmp_path, remark="not a whole HDF5 file")
    assert known(again).revision == 0
    assert len(again.doubts) == 1 and "Corrections by earlier maps are missing" in again.doubts[0]
    again.take(bench.measure("check"), bench.settled())
    assert not again.doubts


def test_updates_of_another_content_are_ignored(
    bench: SteadyMirror, made: Made, updates: RecalibrationManager, tmp_path: Path
) -> None:
    updates.take(bench.measure("check"), bench.settled())
    fit = replace(made[1].fit, zernike_offset=made[1].fit.zernike_offset + 1e-9)
    other = (made[0], replace(made[1], fit=fit))
    assert known(begun(other, tmp_path, remark="basis_sha256")).revision == 0


def test_an_update_that_cannot_be_stored_changes_nothing(bench: SteadyMirror, made: Made, tmp_path: Path) -> None:
    nowhere = tmp_path / "file"
    nowhere.write_text("no folder")
    updates = begun(made, nowhere)
    with pytest.raises(StoreError, match="was not stored"):
        updates.take(bench.measure("check"), bench.settled())
    assert known(updates).revision == 0


def test_a_rate_of_zero_keeps_the_gains(bench: SteadyMirror, made: Made, tmp_path: Path) -> None:
    widths = []
    for gain in (0.0, 1e-3):
        updates = begun(made, tmp_path / str(gain), replace(EXACT, gain_rate=gain, figure_rate=0.0))
        updates.take(bench.measure("later", days=100.0), bench.settled())
        widths.append(np.diag(known(updates).covariance)[: bench.mirror.actuators].max())
    assert widths[0] < 0.1 * widths[1]


def test_every_check_is_in_the_log(bench: SteadyMirror, updates: RecalibrationManager, tmp_path: Path) -> None:
    updates.take(bench.measure("good"), bench.settled())
    updates.take(bench.measure("good"), bench.settled(), dry_run=True)
    bench.drift(0.2)
    updates.take(bench.measure("bad"), bench.settled())
    (file,) = tmp_path.glob("*.checks.csv")
    with file.open("a") as stream:
        stream.write("1.7e9,1,3e-9,2e")  # power was lost
    good, bad = read_checks(file)
    assert (good.accepted, bad.accepted) == (1, 0) and good.time < bad.time == pytest.approx(1e-9 * bench.clock_ns)
    assert good.max_zernike < 2e-9 < bad.max_zernike and good.surprise < 2.0 < bad.surprise
    assert 1 <= good.actuator <= bench.mirror.actuators
    whole = file.read_bytes()
    for content, taken in ((whole, 3), (whole + b"\r\n", 3), (whole + b"\0" * 200_000, 3), (b"", 1)):
        file.write_bytes(content)
        updates.take(bench.measure("bad"), bench.settled())
        assert len(read_checks(file)) == taken
    assert read_checks(tmp_path / "none.csv") == []
    with file.open("r+b") as stream:  # the log of many years is not read to add a line to it; a sparse file
        stream.truncate(2**33)
    append_check(file, good)
    with file.open("rb") as stream:
        stream.seek(2**33)
        assert stream.read().startswith(b"\r\n") and stream.tell() < 2**33 + 300
    file.unlink()


def clock_of(nanoseconds: int, **more: Any) -> SimpleNamespace:
    """A node whose clock shows this time."""
    clock = SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=nanoseconds))
    return SimpleNamespace(get_clock=lambda: clock, **more)


def test_bounds_that_have_grown_with_the_time_without_a_map_are_published(
    updates: RecalibrationManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    listener, published = cast(Any, MapListener.__new__(MapListener)), list[float]()
    message = calibration_message(in_use(updates).calibration, None, "mirror", 1.0)

    def publish() -> None:
        listener.amend(message)
        published.append(message.held_out_max_zernike)

    listener._updates, listener._manager = updates, SimpleNamespace(publish_again=publish)
    listener._temperatures = SimpleNamespace(published=lambda: np.nan, now=lambda: np.nan, changed=False)
    listener._values = {"updates.stale_after": 1e9, "calibrated_error_max": CALIBRATED_ERROR_MAX}
    listener._was_stale = False
    monkeypatch.setattr("dm_calibration.recalibration.map_listener.PUBLISH_PERIOD_S", 0.0)
    for hour in (0, *range(24 * 30)):  # the first message is that of the calibration
        listener._node = clock_of(in_use(updates).calibration.stamp_ns + hour * 3600 * 10**9)
        publish() if not published else listener.tick()
    assert 5 < len(published) < 30 and published == sorted(published)
    assert published[-1] > 1.5 * published[0]


def test_what_a_map_shows_while_the_message_is_made_is_published_too(
    updates: RecalibrationManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    listener = cast(Any, MapListener.__new__(MapListener))

    class Meanwhile:
        """Another thread takes a map in as soon as what is in use was read."""

        mirror_changed = False

        @property
        def in_use(self) -> InUse:
            listener._dirty = True
            return in_use(updates)

    listener._updates, listener._temperatures = Meanwhile(), SimpleNamespace(published=lambda: np.nan)
    listener._node = clock_of(in_use(updates).calibration.stamp_ns)
    listener._values = {"calibrated_error_max": CALIBRATED_ERROR_MAX}
    monkeypatch.setattr(MapListener, "_doubts", lambda _listener: [])
    listener.amend(calibration_message(in_use(updates).calibration, None, "mirror", 1.0))
    assert listener._dirty


def silent_listener(monkeypatch: pytest.MonkeyPatch, log: SimpleNamespace) -> Any:
    """A MapListener that has heard nothing of the driver, without its node."""
    listener = cast(Any, MapListener.__new__(MapListener))
    monkeypatch.setattr("dm_calibration.recalibration.map_listener.REPORT_WAIT_S", 0.5)
    listener._node = clock_of(10**18, active=True, get_logger=lambda: log, check_active=lambda: None)
    listener._values = {"updates.enable": True, "updates.still_time": 0.1}
    listener._updates, listener._busy = SimpleNamespace(in_use=True), lambda: False
    listener._temperatures, listener._refused = SimpleNamespace(at=lambda _time: np.nan), 0
    listener._incomplete, listener._compared = {}, deque(maxlen=64)
    listener._turn, listener._exchange = threading.Lock(), threading.Lock()
    listener.history, listener._worker = AppliedHistory(), ThreadPoolExecutor(1)
    return listener


def hear(listener: Any, stamp: int) -> None:
    """A map comes over the topics."""
    values = np.ones(3)
    parts = {
        "zernike": ZernikeCoefficients(coefficients=stamp * np.ones(21)),
        "samples": SurfaceSamples(x=values, y=values, weight=values, sag=values),
        "info": SurfaceMapInfo(),
    }
    for name, message in parts.items():
        message.header.stamp.sec = stamp
        listener._on_part(name, message)


def test_maps_do_not_queue_up_while_the_driver_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten a second for a night filled the memory, and the newest was judged hours late."""
    listener = silent_listener(monkeypatch, SimpleNamespace(info=lambda _text, **_options: None))
    passed, all_heard = [0.0], threading.Event()

    def wait(condition: Callable[[], bool], longest_s: float) -> bool:
        passed[0] += max(longest_s, 0.0)
        return condition()

    module = "dm_calibration.recalibration.map_listener"
    monkeypatch.setattr(f"{module}.time", SimpleNamespace(monotonic=lambda: passed[0]))
    monkeypatch.setattr(f"{module}.wait_until", wait)
    listener._worker.submit(all_heard.wait)
    for stamp in range(1, 21):
        hear(listener, stamp)
    all_heard.set()
    listener._worker.shutdown()
    assert listener._refused == 20 and "has not reported" in listener._last_refusal
    assert 0.4 < passed[0] < 3.0


def test_an_update_that_the_disk_does_not_take_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not told as a map that came while the mirror moved: until somebody makes room nothing is corrected any more."""
    told = list[str]()
    listener = silent_listener(monkeypatch, SimpleNamespace(warning=lambda text, **_options: told.append(text)))

    def full(*_arguments: object) -> None:
        raise StoreError("the update of x was not stored in y: No space left on device")

    listener._updates.take, listener.history = full, SimpleNamespace(heard_since=lambda _at: True, settled=lambda *_: 0)
    hear(listener, 1)
    listener._worker.shutdown()
    assert told == ["map not used: the update of x was not stored in y: No space left on device"]
    assert listener._last_refusal.endswith("No space left on device")


@pytest.mark.parametrize("running", [True, False])
def test_a_map_that_comes_while_the_process_ends_is_no_error(running: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    told = list[str]()
    listener = silent_listener(monkeypatch, SimpleNamespace(error=told.append))
    listener._node.context = SimpleNamespace(ok=lambda: running)

    def gone(*_arguments: object) -> None:
        raise InvalidHandle("destruction was requested")

    listener._updates.take, listener.history = gone, SimpleNamespace(heard_since=lambda _at: True, settled=lambda *_: 0)
    hear(listener, 1)
    listener._worker.shutdown()
    assert told == ["map not used: InvalidHandle: destruction was requested"] * running
    assert listener._refused == 1


def test_a_wide_gap_of_a_mirror_that_is_well_is_no_surprise(bench: SteadyMirror, made: Made, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for turn in np.linspace(0.0, 2 * np.pi, 6):
        updates = begun(made, tmp_path / f"{turn:.1f}")
        bench.apply(rng.uniform(-0.5, 0.5, bench.mirror.actuators))
        measured = bench.measure("in part")
        hidden = measured.points.x * np.cos(turn) + measured.points.y * np.sin(turn) > 0.3
        assert hidden.mean() > 0.25
        gaps = np.where(hidden, np.nan, measured.sag)
        assert updates.take(replace(measured, sag=gaps), bench.settled()).accepted


def test_where_an_actuator_stands_is_found_with_its_middle_out_of_view(
    bench: SteadyMirror, made: Made, tmp_path: Path
) -> None:
    updates, settled = begun(made, tmp_path), bench.settled()
    at = bench.signals.copy()
    at[6] = -1.1
    bench.apply(at)
    measured, calibration = bench.measure("stuck"), made[1]
    x, y = (place[6] / calibration.aperture_radius for place in (calibration.actuator_x, calibration.actuator_y))
    hidden = np.hypot(measured.points.x - x, measured.points.y - y) < 0.1
    assert hidden.any()
    gaps = np.where(hidden, np.nan, measured.sag)
    assert updates.take(replace(measured, sag=gaps), settled, without=[6]).accepted
    assert known(updates).stuck[6] == pytest.approx(-1.1, abs=0.01)
