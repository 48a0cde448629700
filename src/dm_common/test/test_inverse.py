"""The inverse of the memory law undoes it, wherever the mirror stands."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_common.hysteresis.inverse import TOLERANCE, invert
from dm_common.hysteresis.model import HysteresisModel
from example_hysteresis import plays, rich

STATIC = HysteresisModel(np.zeros(1), np.array([[1.0, 0.2, 0.05]]), np.zeros(0), 0.0, 0.0, np.zeros(0))
LAWS = [plays(), rich(), STATIC]
signal = st.floats(-1.0, 1.0)


@pytest.mark.parametrize("law", LAWS)
@given(turns=st.lists(st.tuples(signal, signal, signal), max_size=6), wanted=st.tuples(*[st.floats(-0.7, 0.7)] * 3))
@settings(max_examples=60, deadline=None)
def test_the_law_of_the_inverse_is_what_was_wanted(law: HysteresisModel, turns: list, wanted: tuple) -> None:
    state = law.demagnetised(3, 0.0)
    for number, turn in enumerate(turns):
        state = law.move(state, np.array(turn), 2.0 * number)
    for ahead in (0.0, 0.5):
        found = invert(law, state, np.array(wanted), -1.0, 1.0, ahead)
        reached = law.advance(law.move(state, found.signals, state.time), state.time + ahead)
        np.testing.assert_allclose(law.effective(reached), wanted, atol=2.0 * TOLERANCE)
        np.testing.assert_array_equal(found.missed, 0.0)


@pytest.mark.parametrize("law", LAWS)
def test_a_limit_stops_it_and_tells_what_is_missed(law: HysteresisModel) -> None:
    state = law.demagnetised(3, 0.0)
    found = invert(law, state, np.array([5.0, -5.0, 0.1]), -0.5, 0.6)
    np.testing.assert_allclose(found.signals[:2], [0.6, -0.5])
    reached = law.effective(law.move(state, found.signals, 0.0))
    np.testing.assert_allclose(found.missed, [5.0 - reached[0], -5.0 - reached[1], 0.0], atol=1e-7)


def test_without_hysteresis_signals_are_effective_signals() -> None:
    law = HysteresisModel.linear()
    found = invert(law, law.demagnetised(2, 0.0), np.array([0.3, 1.4]), -1.0, 1.0)
    np.testing.assert_allclose(found.signals, [0.3, 1.0])
    np.testing.assert_allclose(found.missed, [0.0, 0.4])


@pytest.mark.parametrize("wanted", [np.zeros(2), np.array([0.0, np.nan, 0.0])])
def test_wrong_wishes_are_refused(wanted: np.ndarray) -> None:
    law = rich()
    with pytest.raises(ValueError, match="must be 3 finite numbers"):
        invert(law, law.demagnetised(3, 0.0), wanted, -1.0, 1.0)
