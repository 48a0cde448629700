"""Hysteresis laws and creep of the virtual bench."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dm_simulation.mirror.hysteresis import LAWS, Hysteresis, JilesAthertonHysteresis, skew_density
from dm_simulation.mirror.piezo import DRAWN, ROOM, PiezoActuators, PiezoConfig
from dm_simulation.mirror.preisach import PreisachOperator, drawn_density

Array = NDArray[np.float64]
HYSTERETIC = ("prandtl_ishlinskii", "preisach", "bouc_wen", "drawn_preisach", "drawn_bouc_wen")
RETURN_POINT = ("prandtl_ishlinskii", "preisach", "drawn_preisach")
signal = st.floats(-1, 1, allow_nan=False)


@cache
def made(law: str) -> Hysteresis:
    return Hysteresis(law, 0.1, 1)


def fresh(law: str) -> Hysteresis:
    """One actuator with a loop of a tenth that has not moved yet."""
    return copy.deepcopy(made(law))


def drive(law: Hysteresis, *signals: float) -> Array:
    return np.array([law.move(np.array([u]))[0] for u in signals])


@pytest.mark.slow
@pytest.mark.parametrize("law", HYSTERETIC)
@pytest.mark.parametrize("fraction", [0.05, 0.10, 0.15])
def test_loop_opens_by_the_stated_fraction_of_a_total_stroke_of_two(law: str, fraction: float) -> None:
    hysteresis = Hysteresis(law, fraction, 1)
    grid = np.linspace(-1, 1, 501)
    drive(hysteresis, *6 * (1.0, -1.0))
    rising, falling = drive(hysteresis, *grid), drive(hysteresis, *grid[::-1])[::-1]
    stroke = rising[-1] - rising[0]
    assert stroke == pytest.approx(2, rel=1e-3)
    assert np.max(falling - rising) / stroke == pytest.approx(fraction, rel=2e-3)
    assert np.all(falling - rising > -1e-9)  # the lag always has the same sense


def test_without_hysteresis_the_law_is_a_straight_line() -> None:
    grid = np.array([0.3, -0.7, 1.0, 0.2])
    np.testing.assert_allclose(drive(Hysteresis("none", 0.1, 1), *grid), grid)
    np.testing.assert_allclose(drive(Hysteresis("preisach", 0.0, 1), *grid), grid)


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
@settings(max_examples=25, deadline=None)
@given(history=st.lists(signal, max_size=8), start=signal, stop=signal)
def test_branches_are_monotone(law: str, history: list[float], start: float, stop: float) -> None:
    hysteresis = fresh(law)
    branch = drive(hysteresis, *history, *np.linspace(start, stop, 40))[len(history) :]
    assert np.all(np.diff(branch) * np.sign(stop - start) >= -1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("law", HYSTERETIC)
@settings(max_examples=25, deadline=None)
@given(turns=st.lists(signal, min_size=1, max_size=8), cuts=st.integers(2, 9))
def test_rate_independence(law: str, turns: list[float], cuts: int) -> None:
    """Only the turning points count, not in how many steps a move is made."""
    at_once, in_steps = fresh(law), fresh(law)
    last = 0.0
    for turn in turns:
        whole = drive(at_once, turn)[-1]
        cut = drive(in_steps, *np.linspace(last, turn, cuts + 1)[1:])[-1]
        # Bouc-Wen laws are integrated, the others exact.
        assert cut == pytest.approx(whole, abs=1e-5 if "bouc_wen" in law else 1e-12)
        last = turn


@pytest.mark.parametrize("law", RETURN_POINT)
@settings(max_examples=25, deadline=None)
@given(history=st.lists(signal, max_size=6), low=signal, high=signal, inner=st.floats(0.01, 0.99))
def test_return_point_memory(law: str, history: list[float], low: float, high: float, inner: float) -> None:
    """A minor loop closes exactly, and wipes itself out: what follows is as if it had not been."""
    high, low = max(high, low), min(high, low)
    disturbed, plain = fresh(law), fresh(law)
    before = drive(disturbed, *history, low, high)[-1]
    turn = high - inner * (high - low)
    after = drive(disturbed, turn, high)[-1]
    assert after == pytest.approx(before, abs=1e-12)
    drive(plain, *history, low, high)
    onward = (low, 0.5 * (low + high), 1.0, -1.0)
    np.testing.assert_allclose(drive(disturbed, *onward), drive(plain, *onward), atol=1e-12)


def test_bouc_wen_has_no_return_point_memory() -> None:
    hysteresis = Hysteresis("bouc_wen", 0.1, 1)
    before = drive(hysteresis, -1, 1, -1, 1, -1, 0.5)[-1]
    after = drive(hysteresis, 0.0, 0.5)[-1]
    assert abs(after - before) > 1e-3


@pytest.mark.parametrize("law", RETURN_POINT)
def test_minor_loops_between_the_same_signals_are_congruent(law: str) -> None:
    """Congruency holds for Preisach and Prandtl-Ishlinskii: the loops differ by a constant only."""
    loops = []
    for history in ([1.0], [-1.0], [1.0, -0.4], [-1.0, 0.9, -0.3]):
        hysteresis = fresh(law)
        drive(hysteresis, *history, 0.1)
        drive(hysteresis, 0.5, 0.1)
        loop = drive(hysteresis, *np.linspace(0.1, 0.5, 21), *np.linspace(0.5, 0.1, 21))
        loops.append(loop - loop[0])
    for loop in loops[1:]:
        np.testing.assert_allclose(loop, loops[0], atol=1e-12)
    assert np.ptp(loops[0][:21] - loops[0][21:][::-1]) > 1e-4  # and they are loops


def major_loop_asymmetry(law: str) -> float:
    """How far the loop is from its own point reflection."""
    hysteresis = fresh(law)
    grid = np.linspace(-1, 1, 201)
    drive(hysteresis, *6 * (1.0, -1.0))
    rising, falling = drive(hysteresis, *grid), drive(hysteresis, *grid[::-1])
    return float(np.max(np.abs(rising + falling - (rising + falling).mean())))


@pytest.mark.slow
def test_only_the_preisach_loop_is_asymmetric() -> None:
    assert major_loop_asymmetry("prandtl_ishlinskii") < 1e-9
    assert major_loop_asymmetry("bouc_wen") < 1e-3
    assert major_loop_asymmetry("preisach") > 0.02


def test_preisach_equals_a_crowd_of_relays() -> None:
    """The definition itself: relays up above alpha = v + r, down below beta = v - r, weighted with the density."""
    radii, centres = 128, 1200
    r = (np.arange(radii) + 0.5) / radii
    v = (np.arange(centres) + 0.5) / centres * 4 - 2
    law = PreisachOperator(1, skew_density)
    weight = skew_density(v[None, :], r[:, None]) * (4 / centres) / radii
    up = np.repeat((v < 0)[None, :], radii, axis=0)
    start = (weight * up).sum()
    rng = np.random.default_rng(5)
    for u in rng.uniform(-1, 1, 60):
        up = np.where(u >= v + r[:, None], True, np.where(u <= v - r[:, None], False, up))
        assert law.move(np.array([u]))[0] == pytest.approx((weight * up).sum() - start, abs=2e-3)


def test_unknown_laws_and_impossible_loops_are_refused() -> None:
    with pytest.raises(ValueError, match=r"piezo.law = 'magic'.*prandtl_ishlinskii"):
        Hysteresis("magic", 0.1, 1)
    with pytest.raises(ValueError, match=r"creep_fastest = 10 s: must not exceed piezo\.creep_slowest, 5 s"):
        PiezoActuators(PiezoConfig(creep_fastest=10.0, creep_slowest=5.0), np.random.default_rng(1), np.zeros(1))
    with pytest.raises(ValueError, match=r"piezo.hysteresis = 0.9"):
        Hysteresis("prandtl_ishlinskii", 0.9, 1)


DRAWN_LAWS = ("drawn_preisach", "drawn_bouc_wen", "drawn_mixed", "drawn_unlike", "drawn_jiles_atherton")


@pytest.mark.slow
@pytest.mark.parametrize("law", DRAWN_LAWS)
def test_drawn_laws_follow_from_their_seed_and_differ_between_actuators_and_seeds(law: str) -> None:
    def loop(seed: int) -> Array:
        hysteresis = Hysteresis(law, 0.1, 5, np.random.default_rng(seed))
        return np.array([hysteresis.move(np.full(5, u)) for u in (1.0, -1.0, 0.4, -0.3, 0.7)])

    first = loop(1)
    np.testing.assert_array_equal(loop(1), first)
    assert np.abs(loop(2) - first).max() > 1e-3
    assert np.ptp(first[2:], axis=1).min() > 1e-4  # each actuator is another


@pytest.mark.slow
def test_a_drawn_loop_is_no_wider_than_its_density_can_have() -> None:
    law = Hysteresis("drawn_unlike", 0.2, 37, np.random.default_rng(3))
    signals = np.concatenate([np.linspace(-1, 1, 41), np.linspace(1, -1, 41)] * 2)
    moved = np.array([law.move(np.full(37, u)) for u in signals])[-82:]
    assert np.ptp(moved, axis=0) == pytest.approx(2.0, abs=0.02)
    opening = (moved[41:][::-1] - moved[:41]).max(axis=0) / 2.0
    assert opening.max() == pytest.approx(0.2, abs=0.01)
    assert 0.05 < opening.min() < 0.19


def test_a_drawn_density_is_one_of_relays_and_each_actuator_s_own() -> None:
    """The definition again: an operator of a drawn density beside a crowd of relays with the same."""
    density = drawn_density(2, np.random.default_rng(4))
    operator = PreisachOperator(2, density)
    radii, centres = 150, 1200
    r, v = (np.arange(radii) + 0.5) / radii * 1.2, (np.arange(centres) + 0.5) / centres * 4 - 2
    weight = density(v[None, :], r[:, None]) * (4 / centres) * (1.2 / radii)
    assert weight.min() >= 0
    up = np.repeat((v < 0)[None, :], radii, axis=0)
    start = (weight * up).sum(axis=(1, 2))
    for u in np.random.default_rng(5).uniform(-1, 1, 60):
        up = np.where(u >= v + r[:, None], True, np.where(u <= v - r[:, None], False, up))
        switched = (weight * up).sum(axis=(1, 2)) - start
        np.testing.assert_allclose(operator.move(np.full(2, u)), switched, atol=3e-3)
    assert abs(switched[0] / switched[1] - 1) > 0.02


def test_what_a_preisach_operator_remembers_stays_bounded_and_a_degauss_wipes_it_out() -> None:
    """Turning points that are passed go; after a fading swing it answers as at the beginning."""
    density = drawn_density(3, np.random.default_rng(6))
    old, new = PreisachOperator(3, density), PreisachOperator(3, density)
    for u in np.random.default_rng(7).uniform(-1, 1, (500, 3)):
        old.move(u)
    for step in range(400, -1, -1):
        old.move(np.full(3, (-1) ** step * step / 400))
    begun = old.move(np.zeros(3)) - new.move(np.zeros(3))
    np.testing.assert_allclose(begun, 0.0, atol=2e-3)
    for u in (0.3, -0.2, 0.9, -0.9):
        np.testing.assert_allclose(old.move(np.full(3, u)), new.move(np.full(3, u)), atol=2e-3)


def rested(config: PiezoConfig, count: int = 1, signal: float = 0.0) -> PiezoActuators:
    return PiezoActuators(config, np.random.default_rng(7), np.full(count, signal))


LINEAR = PiezoConfig(gain_spread=0.0, law="none", hysteresis=0.0, creep=0.01)


def test_walls_stay_pinned_until_the_signal_has_passed_where_they_would_be() -> None:
    one = np.ones(1)
    law = JilesAthertonHysteresis(1, 0.8 * one, 0.3 * one, 0.0 * one, 0.05 * one)
    top = law.move(one)
    assert 0.5 < top[0] < np.tanh(1 / 0.8)  # behind the curve without walls
    assert law.move(0.9 * one) == top
    assert law.move(-one)[0] < -0.5


def test_crosstalk_lets_an_actuator_follow_the_next_channel() -> None:
    apart, coupled = (rested(replace(LINEAR, creep=0.0, crosstalk=share), 3) for share in (0.0, 0.01))
    for actuators in (apart, coupled):
        actuators.apply(np.array([0.0, 1.0, 0.0]), 0.0)
    moved = (coupled.displacement - apart.displacement) / apart.displacement[1]
    assert 1e-3 < abs(moved[0]) < 0.03
    np.testing.assert_allclose(moved[1:], 0.0, atol=1e-12)


def test_stroke_and_gain_spread() -> None:
    config = PiezoConfig(law="none", creep=0.0)
    actuators = rested(config, 2000)
    actuators.apply(np.full(2000, 1.0), 0.0)
    high = actuators.displacement
    actuators.apply(np.full(2000, -1.0), 0.0)
    stroke = high - actuators.displacement
    assert stroke.mean() == pytest.approx(8e-6, rel=0.005)
    assert stroke.std() / stroke.mean() == pytest.approx(0.03, rel=0.1)
    again = rested(config, 2000)
    np.testing.assert_array_equal(again.gain, actuators.gain)


def test_a_step_creeps_by_one_percent_per_decade() -> None:
    actuators = rested(LINEAR)
    actuators.apply(np.ones(1), 0.0)
    step = actuators.displacement[0]
    at = []
    for time in (1.0, 10.0, 100.0, 1e3):
        actuators.advance(time)
        at.append(actuators.displacement[0] / step)
    np.testing.assert_allclose(np.diff(at), 0.01, rtol=0.01)


@settings(max_examples=25, deadline=None)
@given(times=st.lists(st.floats(0, 1e4), min_size=1, max_size=10))
def test_creep_does_not_depend_on_how_time_is_cut(times: list[float]) -> None:
    steps, leap = rested(LINEAR), rested(LINEAR)
    for actuators in (steps, leap):
        actuators.apply(np.full(1, 0.7), 0.0)
    for time in sorted(times):
        steps.advance(time)
    leap.advance(max(times))
    assert steps.displacement[0] == pytest.approx(leap.displacement[0], rel=1e-12)


def test_creep_superposes_and_dies_away_after_rest() -> None:
    actuators = rested(LINEAR, signal=-1.0)
    start = actuators.displacement[0]
    actuators.advance(1e5)
    assert actuators.displacement[0] == pytest.approx(start, rel=1e-12)  # rested: nothing moves
    actuators.apply(np.ones(1), 1e5)
    actuators.advance(1.1e5)
    actuators.apply(np.full(1, -1.0), 1.1e5)
    actuators.advance(1e8)
    assert actuators.displacement[0] == pytest.approx(start, rel=1e-9)


def test_a_clock_that_jumps_back_does_not_age_the_mirror() -> None:
    actuators = rested(LINEAR)
    actuators.apply(np.ones(1), 100.0)
    actuators.advance(110.0)
    before = actuators.displacement[0]
    actuators.advance(5.0)
    assert actuators.displacement[0] == before
    actuators.advance(6.0)
    assert actuators.displacement[0] > before


def test_temperature_and_drift_go_on_from_a_start_at_any_time_and_through_clocks_that_jump_back() -> None:
    config = replace(DRAWN, creep=0.0, drift=5e-9)
    first, second = (PiezoActuators(config, np.random.default_rng(3), np.zeros(4), start) for start in (0.0, 21600.0))
    np.testing.assert_array_equal(second.displacement, first.displacement)
    first.advance(5000.0)
    for time in (25000.0, 100.0, 1700.0):
        second.advance(time)
    assert second.temperature == pytest.approx(first.temperature, abs=1e-9)
    np.testing.assert_allclose(second.displacement, first.displacement, rtol=0.0, atol=1e-15)


def full_loops(actuators: PiezoActuators, grid: Array, seconds: float = 0.0) -> tuple[Array, Array]:
    """Displacements (U, N) on the rising and the falling branch of a cycle, over rising signals."""
    time, branches = 0.0, []
    for signals in (grid, grid[::-1], grid, grid[::-1]):
        branch = []
        for signal in signals:
            time += seconds
            actuators.apply(np.full(len(actuators.signals), signal), time)
            branch.append(actuators.displacement)
        branches.append(np.array(branch))
    return branches[2], branches[3][::-1]


def test_spreads_between_actuators_are_the_stated_ones() -> None:
    config = replace(DRAWN, law="preisach", gain_spread=0.0, hysteresis_spread=0.15, creep_spread=0.1)
    count = 400
    rising, falling = full_loops(rested(config, count), np.linspace(-1, 1, 41))
    opening = np.max(falling - rising, axis=0) / (rising[-1] - rising[0])
    assert opening.mean() == pytest.approx(0.1, rel=0.05)
    assert opening.std() / opening.mean() == pytest.approx(0.15, rel=0.15)
    actuators = rested(replace(config, law="none"), count)
    actuators.apply(np.ones(count), 0.0)
    before = actuators.displacement
    actuators.advance(1e8)
    crept = actuators.displacement - before
    assert crept.std() / crept.mean() == pytest.approx(0.1, rel=0.15)


def test_loops_widen_with_speed_where_asked() -> None:
    config = PiezoConfig(gain_spread=0.0, law="preisach", creep=0.0, rate_dependence=0.03)
    widths = []
    for seconds in (1.0, 0.1, 0.01):
        rising, falling = full_loops(rested(config), np.linspace(-1, 1, 41), seconds)
        widths.append(np.max(falling - rising))
    growth = np.array(widths[1:]) / widths[:-1] - 1
    assert np.all((growth > 0.01) & (growth < 0.05))


def test_creep_grows_with_position_and_stiffening_takes_stroke() -> None:
    actuators = rested(replace(LINEAR, creep_position=0.2), 2)
    actuators.apply(np.array([0.5, -0.5]), 0.0)
    before = actuators.displacement
    actuators.advance(1e3)
    crept = np.abs(actuators.displacement - before)
    assert crept[0] / crept[1] == pytest.approx(1.1 / 0.9)
    stiff = rested(replace(LINEAR, creep=0.0, stiffening=0.02))
    stiff.apply(np.ones(1), 0.0)
    assert stiff.displacement[0] == pytest.approx(0.98 * 4e-6)


def test_a_stuck_actuator_stays_and_the_others_go_on() -> None:
    actuators = rested(replace(LINEAR, creep=0.0), 2)
    actuators.stuck[0] = True
    actuators.apply(np.full(2, 0.5), 0.0)
    np.testing.assert_allclose(actuators.displacement, [0.0, 2e-6])


def test_gains_and_bases_go_with_the_temperature() -> None:
    """By the share of the gains and the lengths of the bases that belong to one kelvin; nothing else changes."""
    config = PiezoConfig(law="none", creep=0.0, swing=2.0, warm_gain=1e-3, warm_base=5e-9)
    actuators = PiezoActuators(config, np.random.default_rng(3), np.zeros(4))
    seen = []
    for time in (1000.0, 40000.0):
        shapes = []
        for signals in (np.zeros(4), np.full(4, 0.5)):
            actuators.apply(signals, time)
            shapes.append(actuators.displacement)
        seen.append((actuators.temperature - ROOM, shapes[0], shapes[1] - shapes[0]))
    (colder, bases, moved), (warmer, later, more) = seen
    assert abs(warmer - colder) > 0.5 and max(abs(warmer), abs(colder)) <= 2.0
    np.testing.assert_allclose(bases / colder, later / warmer)
    np.testing.assert_allclose(more / moved, (1.0 + 1e-3 * warmer) / (1.0 + 1e-3 * colder), rtol=1e-12)
