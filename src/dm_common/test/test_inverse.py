"""The inverse of the memory law undoes it, wherever the mirror stands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_common.bounded import BoundedProgramme
from dm_common.hysteresis.inverse import LAG_LEFT, TOLERANCE, ConstrainedInverse, invert
from dm_common.hysteresis.model import HysteresisModel
from dm_common.limits import Limits
from example_hysteresis import fading, lagging, plays, rich

STATIC = HysteresisModel(np.zeros(1), np.array([[1.0, 0.2, 0.05]]), np.zeros(0), 0.0, 0.0, np.zeros(0))
LAWS = [plays(), rich(), STATIC, lagging(), replace(lagging(), creep_rate=0.02), fading()]
signal = st.floats(-1.0, 1.0)


@pytest.mark.parametrize("law", LAWS)
@given(turns=st.lists(st.tuples(signal, signal, signal), max_size=6), wanted=st.tuples(*[st.floats(-0.7, 0.7)] * 3))
@settings(max_examples=60, deadline=None)
def test_the_law_of_the_inverse_is_what_was_wanted(law: HysteresisModel, turns: list, wanted: tuple) -> None:
    state = law.demagnetised(3, 0.0)
    for number, turn in enumerate(turns):
        state = law.move(state, np.array(turn), 2.0 * number)
    atol = 1.1 * LAG_LEFT if law.lag_spectrum.size else 2.0 * TOLERANCE
    for ahead in (0.0, 0.5):
        found = invert(law, state, np.array(wanted), -1.0, 1.0, ahead)
        reached = law.advance(law.move(state, found.signals, state.time), state.time + ahead)
        np.testing.assert_allclose(law.effective(reached), wanted, atol=atol)
        np.testing.assert_array_equal(found.residual, 0.0)


@pytest.mark.parametrize("ahead", [0.0, 100.0])
@pytest.mark.parametrize("law", LAWS)
def test_a_limit_stops_it_and_tells_what_is_missed(law: HysteresisModel, ahead: float) -> None:
    state = law.demagnetised(3, 0.0)
    found = invert(law, state, np.array([5.0, -5.0, 0.1]), -0.5, 0.6, ahead)
    np.testing.assert_allclose(found.signals[:2], [0.6, -0.5])
    reached = law.effective_at(state, found.signals, ahead)
    np.testing.assert_allclose(found.residual, [5.0 - reached[0], -5.0 - reached[1], 0.0], atol=1e-7)


def test_without_hysteresis_signals_are_effective_signals() -> None:
    law = HysteresisModel.linear()
    found = invert(law, law.demagnetised(2, 0.0), np.array([0.3, 1.4]), -1.0, 1.0)
    np.testing.assert_allclose(found.signals, [0.3, 1.0])
    np.testing.assert_allclose(found.residual, [0.0, 0.4])


@pytest.mark.parametrize("wanted", [np.zeros(2), np.array([0.0, np.nan, 0.0])])
def test_wrong_wishes_are_refused(wanted: np.ndarray) -> None:
    law = rich()
    with pytest.raises(ValueError, match="must be 3 finite numbers"):
        invert(law, law.demagnetised(3, 0.0), wanted, -1.0, 1.0)


@pytest.mark.parametrize(("seed", "move"), [(0, 4), (9, 2)])
def test_actuators_that_turn_do_not_keep_the_search_from_the_nearest_legal_shape(seed: int, move: int) -> None:
    """With the slopes where they stand alone it goes round in circles here and ends at 0.5 and 1.1."""
    law = HysteresisModel(
        np.array([0.0, 0.02, 0.1, 0.3]), np.array([[0.65], [0.1], [0.1], [0.1]]), np.zeros(0), 0.0, 0.0, np.zeros(0)
    )
    x, y, pairs = _hexagon()
    matrix, ridge = _smooth_rows(x, y)
    limits = Limits(-1.0, 1.0, pairs, 0.5)
    programme, inverse = BoundedProgramme(matrix, limits, ridge=ridge), ConstrainedInverse(law, limits, matrix, ridge)
    rng = np.random.default_rng(seed)
    state = law.demagnetised(len(x), 0.0)
    for number in range(move + 1):
        bowl, coma, astigmatism = rng.uniform(-1.0, 1.0, 3) * (1.2, 0.4, 0.4)
        rows = matrix @ (bowl * (x**2 + y**2 - 0.5) + coma * x**3 + astigmatism * x * y)
        near = invert(law, state, programme.solve(rows), -1.0, 1.0).signals
        found = [inverse.solve(state, rows, 0.0, start) for start in (near, state.signals, np.zeros(len(x)))]
        left = [np.linalg.norm(matrix @ effective - rows) for _, effective in found]
        assert number < move or max(left) < 0.06
        state = law.move(state, found[0][0], 0.0)


def test_where_few_limits_bind_nothing_goes_far_for_what_the_surface_does_not_show() -> None:
    """Piston costs nothing. All the way to another one the law is not straight, and rounds that went there led astray:
    a sphere in the middle of the range came out 50 nm off.
    """
    x, y, pairs = _hexagon()
    matrix, ridge = _smooth_rows(x, y)
    matrix -= matrix.mean(axis=1, keepdims=True)  # piston moves no row
    inverse = ConstrainedInverse(rich(), Limits(-1.0, 1.0, pairs, 0.3), matrix, 1e-4 * ridge)
    state = rich().demagnetised(len(x), 0.0)
    for turn in (-0.9, 0.7):
        state = rich().move(state, np.full(len(x), turn), 0.0)
    wanted = 0.6 * (x**2 + y**2) - 0.3
    start = invert(rich(), state, wanted, -1.0, 1.0).signals
    assert 0.3 < np.abs(start[pairs[:, 0]] - start[pairs[:, 1]]).max() < 0.35
    signals, effective = inverse.solve(state, matrix @ wanted, 0.0, start)
    assert np.abs(signals - start).max() < 0.05
    assert np.linalg.norm(matrix @ (effective - wanted)) < 1e-2


def _hexagon() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of 37 actuators, and the pairs of neighbours."""
    axis = np.arange(-3, 4)
    x, y = np.array([(a + b / 2, b * 0.75**0.5) for a in axis for b in axis if abs(a + b) <= 3]).T / 3
    return x, y, np.argwhere(np.triu(np.hypot(x[:, None] - x, y[:, None] - y) < 0.4, 1))


def _smooth_rows(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, float]:
    """Rows of a mirror of smooth influence, its low orders counting a hundred times, and the ridge with it."""
    grid = np.linspace(-0.7, 0.7, 17)
    at_x, at_y = (axis[np.add.outer(grid**2, grid**2) <= 0.5] for axis in np.meshgrid(grid, grid))
    sag = np.exp(-(np.subtract.outer(at_x, x) ** 2 + np.subtract.outer(at_y, y) ** 2) / 0.32)
    powers = np.stack([at_x**i * at_y**j for i in range(6) for j in range(6 - i)], axis=1)
    low = np.linalg.qr(powers)[0]
    return np.vstack((100.0 * (low.T @ sag)[1:], sag - low @ (low.T @ sag))), 1e-4
