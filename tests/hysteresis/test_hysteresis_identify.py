"""Identification of hysteresis and creep on the simulation's own actuators, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dm_calibration.hysteresis.candidate_fit import CANDIDATES, COMMON, PREISACH, Candidate, CandidateProblem
from dm_calibration.hysteresis.excitation import excitation
from dm_calibration.hysteresis.hysteresis_fit import _remarks
from dm_calibration.hysteresis.identify import ExcitationError, Identification, _own_law_fits, identify
from dm_calibration.hysteresis.own_laws import OwnLaws
from dm_calibration.hysteresis.responses import Responses
from dm_calibration.hysteresis.run import Run
from dm_common.hysteresis.inverse import invert
from dm_common.hysteresis.law_shape import slope_min
from dm_simulation.mirror.piezo import PiezoActuators, PiezoConfig
from linear_mirror import make_mirror

pytestmark = pytest.mark.slow

LINEAR, PLAIN = CANDIDATES[0], PiezoConfig()
#: Tried with the linear one alone where not the choice among laws is tested.
PLAYS = next(candidate for candidate in CANDIDATES if candidate.name == "Prandtl-Ishlinskii")
OWN = next(candidate for candidate in CANDIDATES if candidate.own and candidate.kind == PREISACH.kind)


def simulated_run(
    law: str,
    maps: int = 150,
    noise: float = 2e-10,
    creep: float = 0.01,
    seed: int = 3,
    more: PiezoConfig = PLAIN,
    third: float = 1.0,
    resumed: int = 0,
) -> tuple[Run, NDArray[np.bool_]]:
    """A run of the excitation on seven of the simulation's actuators, seen through a random matrix, and its checks.

    The third actuator moves by the share `third` of what is asked. After `resumed` maps the run was interrupted and
    went on with a degauss; 0 = it was not.
    """
    mirror = make_mirror(rings=1)
    rng = np.random.default_rng(seed)
    piezo = PiezoActuators(replace(more, law=law, creep=creep), rng, np.zeros(mirror.actuators))
    commands = excitation(mirror, maps)
    commands.signals[:, 2] *= third
    mixing = rng.standard_normal((mirror.actuators, 12)) / 4.0
    time = np.cumsum(1.0 + commands.dwell)
    values: list[NDArray[np.float64]] = []
    for signals, seen in zip(commands.signals, time, strict=True):
        if resumed and len(values) == resumed:
            for swing in np.linspace(1.0, 0.0, 101) * (-1.0) ** np.arange(101):
                piezo.apply(np.full(mirror.actuators, swing), piezo._time)
        piezo.apply(signals, piezo._time)
        piezo.advance(float(seen))
        values.append(piezo.displacement @ mixing)
    measured = np.array(values) + noise * rng.standard_normal((maps, mixing.shape[1]))
    responses = Responses(measured, mixing.shape[1], np.ones(maps, dtype=bool))
    segment = np.where(np.arange(maps) < resumed, 0, 1) if resumed else None
    return Run(commands.signals, time, responses, 0.0, segment=segment), commands.check


def held_out_rms(found: Identification) -> float:
    return float(np.sqrt(np.nanmean(np.square(found.held_out))))


@pytest.fixture(scope="module")
def rising() -> Run:
    """A run that can be spoilt."""
    return simulated_run("prandtl_ishlinskii", 80)[0]


def test_loops_that_widen_with_speed_and_creep_that_changes_over_the_range() -> None:
    kinds = [candidate for candidate in CANDIDATES if candidate.name.startswith("Preisach") and not candidate.slopes]
    plain, lagging = (
        identify(*simulated_run("preisach", 200, more=more), [LINEAR, *kinds])
        for more in (PLAIN, PiezoConfig(rate_dependence=0.03, creep_position=0.2))
    )
    assert lagging.fit.candidate.own
    assert lagging.fit.law.creep_slope == pytest.approx(0.2, abs=0.1)
    assert held_out_rms(lagging) < 3.0 * held_out_rms(plain)


@pytest.mark.parametrize(
    ("law", "factor"), [("prandtl_ishlinskii", 20.0), ("preisach", 20.0), ("bouc_wen", 20.0), ("mixed", 8.0)]
)
def test_held_out_moves_are_predicted_much_better_than_by_a_linear_law(law: str, factor: float) -> None:
    run, check = simulated_run(law)
    found, linear = identify(run, check, COMMON), identify(run, check, [LINEAR])
    assert held_out_rms(linear) > factor * held_out_rms(found)
    assert slope_min(found.fit.law).min() > 0.1


def test_a_law_is_chosen_by_coefficients_whatever_the_noise_of_patterns_beyond_them() -> None:
    """Noise of 480 patterns, all in units of what a common law leaves, hid that own laws leave a ninth of it."""
    run, check = simulated_run("drawn_preisach")
    shown = run.responses.values
    noise = 1e-7 * np.random.default_rng(12).standard_normal((len(shown), 480))
    noisy = replace(run, responses=replace(run.responses, values=np.hstack((shown, noise))))
    assert identify(noisy, check, [LINEAR, PREISACH, OWN]).fit.candidate is OWN


@pytest.mark.parametrize(("law", "least", "most"), [("drawn_preisach", 0.05, 0.2), ("drawn_unlike", 0.4, 0.8)])
def test_how_far_actuators_differ_is_found(law: str, least: float, most: float) -> None:
    run, check = simulated_run(law)
    scatter = np.full(run.responses.values.shape[1], 1e-9)
    laws = OwnLaws(run, OWN, CandidateProblem(run, PREISACH, scatter).fit(~check).law, scatter, 0.1)
    laws.fit(~check & (np.arange(len(check)) < 34))
    assert laws.spread is None  # less than five maps for each of the seven actuators do not tell
    laws.fit(~check)
    assert laws.spread is not None
    assert least <= laws.spread <= most


def test_a_richer_law_that_leaves_hardly_less_counts_as_the_simpler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its folds tell nothing more, and it comes after the simpler one, from which own laws begin."""
    begun = list[str]()

    def seen(run: Run, candidate: Candidate, starts: Any, *rest: Any) -> Any:
        begun.extend(fit.candidate.name for fit in starts)
        return _own_law_fits(run, candidate, starts, *rest)

    monkeypatch.setattr("dm_calibration.hysteresis.identify._own_law_fits", seen)
    richer = replace(PLAYS, name="one power more", powers=PLAYS.powers + 1)
    found = identify(*simulated_run("prandtl_ishlinskii", noise=1e-9), [LINEAR, PLAYS, richer, OWN])
    assert found.scores[richer.name] == found.scores[PLAYS.name]
    assert begun == [PLAYS.name, richer.name]


def test_own_laws_that_fade_are_tried_however_badly_common_ones_do() -> None:
    tried = [one for one in CANDIDATES if one in (LINEAR, PREISACH) or (one.slopes and not one.plays) or one.own]
    found = identify(*simulated_run("preisach", 100), tried)
    assert found.scores["Duhem"] > 1.5 * found.scores["Preisach"]
    assert "Preisach and Duhem, each actuator its own" in found.scores.keys() | found.refused.keys()


def test_the_creep_rate_is_found() -> None:
    run, check = simulated_run("prandtl_ishlinskii", creep=0.015)
    # Rates are per unit of the settled step; the simulation's are too.
    assert identify(run, check, (LINEAR, PLAYS)).fit.law.creep_rate == pytest.approx(0.015, rel=0.05)


@pytest.mark.parametrize("resumed", [1, 2, 20, 29])
def test_a_run_that_was_interrupted_early_finds_the_same_law(resumed: int) -> None:
    """In each fit for the choice, maps of every part show its figure: without them all laws predict equally badly."""
    run, check = simulated_run("prandtl_ishlinskii", resumed=resumed)
    figure = replace(run.responses, values=run.responses.values + 2e-6)
    found = identify(replace(run, responses=figure), check, (LINEAR, PLAYS))
    assert found.fit.candidate is PLAYS
    assert found.scores["linear"] > 10.0


def test_a_mirror_without_hysteresis_is_found_linear() -> None:
    run, check = simulated_run("none", creep=0.0)
    found = identify(run, check)
    assert found.fit.candidate is LINEAR
    assert held_out_rms(found) < 5e-10


@pytest.mark.parametrize(("spread", "name"), [(0.0, "static"), (0.03, "static, each actuator its own")])
def test_a_curved_response_is_found_and_inverted_without_hysteresis(spread: float, name: str) -> None:
    """Electrodes that pull with the square of what nearly is the signal: no history, so none is asked for."""
    run, check = simulated_run("none", creep=0.0)
    rng = np.random.default_rng(11)
    square, cube = rng.normal([0.25, -0.05], spread * np.array([1.0, 0.3]), (7, 2)).T
    position = run.signals + square * run.signals**2 + cube * run.signals**3
    mixing = 1e-6 * rng.standard_normal((7, 12))
    measured = position @ mixing + 2e-10 * rng.standard_normal((len(position), 12))
    found = identify(replace(run, responses=replace(run.responses, values=measured)), check)
    assert found.fit.candidate.name == name
    assert held_out_rms(found) < 4e-10
    law = found.fit.law
    assert not law.has_history and not law.is_identity
    state = law.demagnetised(7, 0.0)
    wanted = rng.uniform(-0.6, 0.6, 7)
    inverted = invert(law, state, law.position_at(state, wanted), -1.0, 1.0)
    np.testing.assert_allclose(inverted.signals, wanted, atol=1e-6)
    np.testing.assert_array_equal(inverted.residual, 0.0)


def test_maps_without_data_change_little() -> None:
    run, check = simulated_run("prandtl_ishlinskii")
    usable = np.ones(len(run.time), dtype=bool)
    usable[10:14] = False
    values = np.where(usable[:, None], run.responses.values, 0.0)
    spoilt = replace(run, responses=Responses(values, run.responses.coefficients, usable))
    plays = (LINEAR, PLAYS)
    assert held_out_rms(identify(spoilt, check, plays)) < 2.0 * held_out_rms(identify(run, check, plays))


def test_too_few_maps_are_refused(rising: Run) -> None:
    usable = np.arange(len(rising.time)) < 12
    few = replace(rising, responses=replace(rising.responses, usable=usable))
    with pytest.raises(ExcitationError, match="12 usable maps"):
        identify(few)


def test_actuators_that_hardly_turn_are_refused(rising: Run) -> None:
    signals = rising.signals.copy()
    signals[:, 4:6] = np.linspace(-1.0, 1.0, len(signals))[:, None]
    with pytest.raises(ExcitationError, match="actuator 5 turned 0 times"):
        identify(replace(rising, signals=signals))
    with pytest.raises(ExcitationError, match="actuator 1 turned 0 times"):
        identify(replace(rising, signals=signals[:, 4:5]))


def test_actuators_that_hardly_move_are_refused(rising: Run) -> None:
    signals = rising.signals.copy()
    signals[:, 2:4] *= 0.05
    with pytest.raises(ExcitationError, match="actuator 4 turned 59 times"):
        identify(replace(rising, signals=signals))


@cache
def with_third(share: float) -> Identification:
    """Own laws of a run in which the third actuator moves by `share` of what is asked."""
    own = next(candidate for candidate in CANDIDATES if candidate.own and candidate.kind == PREISACH.kind)
    return identify(*simulated_run("preisach", third=share), [LINEAR, PREISACH, own])


@pytest.mark.parametrize("third", [0.0, 0.05])
def test_one_actuator_that_hardly_moves_follows_the_law_of_the_others_and_is_named(third: float) -> None:
    whole, found = with_third(1.0), with_third(third)
    assert held_out_rms(found) < 1.2 * held_out_rms(whole)
    assert slope_min(found.fit.law).min() > 0.5 and np.isfinite(found.fit.law.play_weight).all()
    assert not whole.quiet
    assert "the law of actuator 3 is that of the others" in _remarks(found)[-1]


def test_time_that_runs_backwards_is_refused(rising: Run) -> None:
    time = rising.time.copy()
    time[7] = time[5]
    with pytest.raises(ValueError, match=r"map 8 is .* s before the map before it"):
        replace(rising, time=time)


@pytest.mark.parametrize(("first", "checks"), [(30, [*range(48, 60)]), (0, [*range(24, 30), *range(54, 60)])])
def test_no_check_helps_to_predict_another(first: int, checks: list[int]) -> None:
    """They are of one kind: predicted with others in the fit they promised half of what requests erred by.

    This holds for few other maps, and for checks in the middle of a run, which may end after each of its parts.
    """
    run = simulated_run("prandtl_ishlinskii", 60)[0]
    run.responses.usable[:first] = False
    check = np.isin(np.arange(60), checks)
    one, other = np.array_split(checks, 2)
    found = identify(run, check, [LINEAR])
    assert np.isfinite(found.held_out[check]).all() and np.isnan(found.held_out[~check]).all()
    wrong = run.responses.values.copy()
    wrong[other] += 1e-8
    spoilt = identify(replace(run, responses=replace(run.responses, values=wrong)), check, [LINEAR])
    np.testing.assert_array_equal(spoilt.held_out[one], found.held_out[one])
    assert not np.allclose(spoilt.fit.residual[one], found.fit.residual[one], atol=1e-10)


def test_own_laws_that_fade_begin_where_they_leave_much_less(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two laws at once a law without plays fades otherwise: own laws that began there erred three times as much."""

    class Own:
        def __init__(self, run: Any, candidate: Any, law: float, scatter: Any, least: float) -> None:
            self.law = law

        def fit(self, keep: Any) -> Any:
            return SimpleNamespace(residual=np.full((4, 2), self.law), law=self.law)

    monkeypatch.setattr("dm_calibration.hysteresis.identify.OwnLaws", Own)
    starts: Any = [SimpleNamespace(law=left) for left in (1.0, 0.99, 0.5)]
    run: Any = SimpleNamespace(responses=SimpleNamespace(coefficients=2))

    def order(candidate: Candidate) -> list[Any]:
        begun: Any = _own_law_fits(run, candidate, starts, np.ones(2), np.ones(4, dtype=bool), 0.1)
        return [fit.law for _, fit in begun]

    assert order(Candidate("fades", 30, 5, 4, own=True)) == [0.5, 1.0, 0.99]
    assert order(Candidate("does not", 30, 5, 0, own=True)) == [1.0, 0.99, 0.5]
