"""The prepared inverse agrees with the one that is worked out for every request, or leaves it to that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_common.hysteresis.inverse import invert
from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.limits import Limits
from dm_controller.planning.fast_path import EXACT, PreparedInverse
from example_hysteresis import fading, lagging, plays, rich

ACTUATORS = 37


def fine(law: HysteresisModel) -> HysteresisModel:
    """A law like `law` with as many operators as are identified, so that pieces are as narrow."""
    radius = np.concatenate(([0.0], np.arange(0.025, 1.0, 0.05)))
    weight = np.vstack((law.play_weight[:1], np.tile(law.play_weight[1:].sum(axis=0) / 20, (20, 1))))
    return replace(law, play_radius=radius, play_weight=weight)


LAGGING = replace(lagging(), creep_rate=0.02)
LAWS = [plays(), plays(0.01), fine(rich()), fine(rich(0.0)), fine(lagging()), fine(LAGGING), fine(fading())]


def history(law: HysteresisModel, seed: int) -> HysteresisState:
    generator = np.random.default_rng(seed)
    state = law.demagnetised(ACTUATORS, 0.0)
    for number in range(8):
        state = law.move(state, generator.uniform(-0.8, 0.8, ACTUATORS), 3.0 * number)
    return state


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("ahead", [0.0, 0.5])
def test_it_finds_the_same_signals(law: HysteresisModel, ahead: float) -> None:
    generator = np.random.default_rng(1)
    served = 0
    for seed in range(10):
        state = history(law, seed)
        ready = PreparedInverse(law, state, Limits())
        later = state.time + generator.uniform(0.0, 100.0)
        wanted = generator.uniform(-0.6, 0.6, ACTUATORS)
        found = ready.invert(later, wanted, ahead)
        if found is not None:
            served += 1
            expected = invert(law, law.advance(state, later), wanted, -1.0, 1.0, ahead).signals
            np.testing.assert_allclose(found, expected, atol=2.0 * EXACT)
    assert served >= 8


@pytest.mark.parametrize("law", LAWS)
def test_staying_where_it_is_moves_nothing(law: HysteresisModel) -> None:
    state = history(law, 3)
    found = PreparedInverse(law, state, Limits()).invert(state.time, law.effective(state), 0.0)
    assert found is not None
    np.testing.assert_allclose(found, state.signals, atol=2.0 * EXACT)


def test_pieces_too_wide_to_be_exact_are_left_to_the_other() -> None:
    law = rich()
    for seed in range(10):
        state = history(law, seed)
        wanted = np.random.default_rng(seed).uniform(-0.6, 0.6, ACTUATORS)
        found = PreparedInverse(law, state, Limits()).invert(state.time, wanted, 0.0)
        expected = invert(law, state, wanted, -1.0, 1.0).signals
        assert found is None or np.abs(found - expected).max() < 2.0 * EXACT


@pytest.mark.parametrize("wanted", [2.0, -2.0, np.nan])
def test_what_no_signal_reaches_is_left_to_the_other(wanted: float) -> None:
    law = rich()
    ready = PreparedInverse(law, history(law, 1), Limits())
    effective = np.zeros(ACTUATORS)
    effective[5] = wanted
    assert ready.invert(100.0, effective, 0.0) is None


def test_neighbours_too_far_apart_are_left_to_the_other() -> None:
    law, pairs = plays(), np.array([[0, 1]])
    effective = np.zeros(ACTUATORS)
    effective[0] = 0.2
    for difference, served in ((0.5, True), (0.1, False)):
        ready = PreparedInverse(law, law.demagnetised(ACTUATORS, 0.0), Limits(-1.0, 1.0, pairs, difference))
        assert (ready.invert(1.0, effective, 0.0) is not None) == served


def test_a_law_with_a_dead_zone_is_left_to_the_other() -> None:
    none = np.zeros(0)
    law = HysteresisModel(np.array([0.1, 0.3]), np.array([[0.8], [0.2]]), none, 0.0, 0.0, none)
    assert PreparedInverse(law, law.demagnetised(3, 0.0), Limits()).invert(1.0, np.zeros(3), 0.0) is None
