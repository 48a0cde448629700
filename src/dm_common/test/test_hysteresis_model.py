"""The memory law: what every hysteresis operator must do, creep in closed form, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_common.hysteresis.duhem import DuhemOperator
from dm_common.hysteresis.law_shape import normalised, slope_min, span
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from example_hysteresis import RADIUS, fading, lagging, plays, rich

signal = st.floats(-1.0, 1.0)
LAWS = [plays(), rich(), fading()]


def drive(law: HysteresisModel, *signals: float) -> float:
    """Static effective signal at the end of a sequence from the demagnetised state."""
    state = law.demagnetised(1, 0.0)
    for value in signals:
        state = law.move(state, np.array([value]), 0.0)
    return float(state.position[0])


@given(history=st.lists(signal, max_size=6), low=signal, high=signal, inner=signal)
@settings(max_examples=40, deadline=None)
def test_plays_close_minor_loops_and_wipe_them_out(history: list[float], low: float, high: float, inner: float) -> None:
    low, high = min(low, high), max(low, high)
    turn = low + 0.5 * (1.0 + inner) * (high - low)
    law = plays()
    assert drive(law, *history, low, high, turn, high) == pytest.approx(drive(law, *history, low, high), abs=1e-12)
    onward = (low, -1.0, 1.0, 0.2)
    assert drive(law, *history, 1.0, -1.0, turn, *onward) == pytest.approx(drive(law, 1.0, -1.0, *onward), abs=1e-12)


@pytest.mark.parametrize("law", LAWS)
@given(turns=st.lists(signal, min_size=1, max_size=6), cuts=st.integers(2, 7))
@settings(max_examples=40, deadline=None)
def test_it_does_not_matter_how_a_way_is_cut(law: HysteresisModel, turns: list[float], cuts: int) -> None:
    cut = [float(u) for a, b in zip([0.0, *turns], turns, strict=False) for u in np.linspace(a, b, cuts + 1)[1:]]
    # The Duhem operator looks its way up in a table.
    assert drive(law, *cut) == pytest.approx(drive(law, *turns), abs=1e-6)


def test_the_hysteresis_matters() -> None:
    for law in LAWS:
        assert abs(drive(law, 1.0, 0.2) - drive(law, -1.0, 0.2)) > 0.02


def test_what_fades_follows_its_equation() -> None:
    law, signals = replace(fading(), duhem_slope=np.zeros(0)), (0.7, -0.9, 0.2)
    operators = law.fading
    states, z, u = np.zeros((1, 6)), np.zeros((2, 3)), 0.0
    for signal in signals:
        states = operators.move(states, np.array([u]), np.array([signal]))
        steps = 4000
        step = (signal - u) / steps
        for number in range(steps):
            middle = u + (number + 0.5) * step
            rise = middle ** np.arange(3) * step
            z = (z * (1.0 - 0.5 * law.fading_rate[:, None] * abs(step)) + rise) / (
                1.0 + 0.5 * law.fading_rate[:, None] * abs(step)
            )
        u = signal
    np.testing.assert_allclose(states[0], z.ravel(), atol=1e-5)
    for there in (0.5, -0.4):  # on from there, either way: what it adds, and the slope of that
        way = np.array([[np.sign(there - u)]])
        value, slope = operators.along(states, np.array([u]), np.array([[there]]), way)
        moved = [operators.move(states, np.array([u]), np.array([there + step])) for step in (-1e-6, 0.0, 1e-6)]
        before, here, after = (operators.value(each)[0] for each in moved)
        assert value[0, 0] == pytest.approx(here, abs=1e-12)
        assert slope[0, 0] == pytest.approx((after - before) / 2e-6, abs=1e-6)


def test_creep_follows_its_elements() -> None:
    law = replace(plays(0.02), play_radius=np.zeros(1), play_weight=np.ones((1, 1)))
    start = law.move(law.demagnetised(1, 5.0), np.array([0.5]), 5.0)
    share = 0.02 * np.log10(CREEP_TIMES[-1] / CREEP_TIMES[0]) / (len(CREEP_TIMES) - 1)
    for elapsed in (0.1, 7.0, 5000.0):
        expected = 0.5 * (1.0 + share * (1.0 - np.exp(-elapsed / CREEP_TIMES)).sum())
        assert law.effective(law.advance(start, 5.0 + elapsed))[0] == pytest.approx(expected, rel=1e-12)


def test_creep_grows_by_its_rate_per_decade() -> None:
    law = plays(0.01)
    moved = law.move(law.demagnetised(1, 0.0), np.array([0.8]), 0.0)
    ten, thousand = (law.effective(law.advance(moved, t))[0] for t in (10.0, 1000.0))
    assert thousand - ten == pytest.approx(0.02 * moved.position[0], rel=0.02)


def test_waiting_in_parts_is_waiting_at_once() -> None:
    law = lagging()
    moved = law.move(law.demagnetised(3, 0.0), np.array([0.1, -0.4, 0.9]), 0.0)
    parts = law.advance(law.advance(law.advance(moved, 0.3), 2.0), 600.0)
    np.testing.assert_allclose(parts.crept, law.advance(moved, 600.0).crept, atol=1e-12)
    np.testing.assert_allclose(law.effective(parts), law.effective_at(moved, moved.signals, 600.0), atol=1e-12)


def test_a_clock_set_back_stands_still() -> None:
    law = rich()
    state = law.demagnetised(2, 10.0)
    assert law.advance(state, 4.0) is state


def test_a_degauss_forgets_hysteresis_and_keeps_creep() -> None:
    law = lagging()
    used = law.move(law.demagnetised(2, 0.0), np.array([0.9, -0.9]), 0.0)
    wiped, fresh = law.degaussed(used, 100.0), law.demagnetised(2, 100.0)
    np.testing.assert_array_equal(wiped.play, fresh.play)
    np.testing.assert_array_equal(wiped.fading, fresh.fading)
    np.testing.assert_array_equal(wiped.crept, law.advance(used, 100.0).crept)
    np.testing.assert_array_equal(wiped.lagged, law.advance(used, 100.0).lagged)


@pytest.mark.parametrize("law", LAWS)
def test_slope_min_is_below_every_slope_and_not_far(law: HysteresisModel) -> None:
    rng = np.random.default_rng(0)
    state = law.demagnetised(400, 0.0)
    steepest = np.inf
    for _ in range(30):
        target = rng.uniform(-1.0, 1.0, 400)
        step = 1e-3 * np.sign(target - state.signals)
        before = law.move(state, target - step, 0.0)
        after = law.move(before, target, 0.0)
        sure = np.abs(target - state.signals) > 1e-3
        steepest = min(steepest, ((after.position - before.position) / step)[sure].min())
        state = after
    assert slope_min(law).min() <= steepest + 1e-9
    assert slope_min(law).min() > steepest - 0.15


def test_slope_min_of_own_laws_is_that_of_the_steepest_loop_alone() -> None:
    slopes, weights = np.tile([[[1.5, 0.0, 0.0]], [[0.5, 2.0, 0.0]]], (1, 2, 1)), np.array([-0.02, -0.3])
    alone = [replace(rich(), duhem_slope=slopes[[k]], duhem_weight=weights[[k]]) for k in range(2)]
    both = replace(rich(), duhem_slope=slopes, duhem_weight=weights)
    assert slope_min(both) == pytest.approx(np.concatenate([slope_min(law) for law in alone]), abs=1e-12)


@pytest.mark.parametrize("ends", [(-1.0, 1.0), (0.0, 1.0), (-0.5, 1.0)])
def test_normalised_spans_what_the_signals_span(ends: tuple[float, float]) -> None:
    assert span(normalised(rich(), *ends), *ends) == pytest.approx(ends[1] - ends[0], rel=1e-9)


def test_duhem_of_first_order_is_an_exponential() -> None:
    rate = 1.6
    operator = DuhemOperator(np.array([rate]))
    change = np.array([0.3, -0.7, 1.5, 0.0])
    rising = np.sign(change) * (1.0 - np.exp(-rate * np.abs(change))) / rate
    np.testing.assert_allclose(operator.move(np.zeros(4), change), rising, atol=5e-5)  # a table of 2001 knots


def test_a_duhem_operator_without_end_is_refused() -> None:
    with pytest.raises(ValueError, match="does not stay within"):
        DuhemOperator(np.array([-3.0]))


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("creep_rate", 0.5, "creep_rate = 0.5"),
        ("play_radius", -RADIUS, "play_radius = -0.6"),
        ("play_weight", np.ones((2, 1)), "play_weight has the shape"),
        ("duhem_weight", np.nan, "duhem_weight"),
        ("creep_time", np.array([1.0, 0.0]), "creep_time"),
        ("lag_spectrum", np.ones(1000), "lag_spectrum has the shape"),
    ],
)
def test_a_law_that_makes_no_sense_is_refused(field: str, value: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(rich(), **{field: value})  # type: ignore[arg-type]


def test_duhem_operators_of_each_actuator_are_those_of_one() -> None:
    """On moves of both directions; rises by the first polynomial, falls by the second."""
    rng = np.random.default_rng(3)
    slopes = np.array([1.6, 0.3]) * np.exp(0.1 * rng.standard_normal((5, 2, 2)))
    slopes[0] = slopes[0, 0]
    together = DuhemOperator(slopes)
    alone = [DuhemOperator(np.stack((slope, slope))[:1]) for slope in slopes]
    symmetric = DuhemOperator(slopes[0, 0])
    z, change = np.zeros(5), rng.uniform(-1.0, 1.0, (40, 5))
    first = np.zeros(1)
    ones = np.zeros((5, 1))
    for step in change:
        before = z
        z = together.move(z, step)
        first = symmetric.move(first, step[:1])
        ones = np.stack([one.move(old, to) for one, old, to in zip(alone, ones, step[:, None], strict=True)])
        np.testing.assert_allclose(together.move(before[:, None], np.stack((step, 0.5 * step), axis=1))[:, 0], z)
        slope = (together.move(before, step + 1e-6 * np.sign(step)) - z) / (1e-6 * np.sign(step))
        inside = slope > 0.05  # not where a table ends
        np.testing.assert_allclose(together.rise(z, np.sign(step))[inside], slope[inside], atol=5e-3)
    assert z[0] == pytest.approx(first[0], abs=1e-9)
    np.testing.assert_allclose(ones[:, 0], z, atol=1e-12)
