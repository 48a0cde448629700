"""The commands of a hysteresis plan: legal, turning, the same for the same seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_calibration.hysteresis.excitation import CHECK_SHARE, FLAT_KNOWN, MAPS_MIN, excitation, next_part
from dm_calibration.hysteresis.identify import check_excitation
from dm_calibration.hysteresis.responses import Responses
from dm_calibration.hysteresis.run import Run
from dm_common.limits import Limits
from dm_common.mirror import Mirror
from linear_mirror import make_mirror


def limited(difference: float, low: float = -1.0, high: float = 1.0) -> Mirror:
    mirror = make_mirror(rings=1)
    return replace(mirror, limits=Limits(low, high, mirror.limits.pairs, difference))


@pytest.mark.parametrize("difference", [0.5, 1.0, 2.0])
@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), (-0.4, 0.8)])
def test_commands_keep_the_limits(difference: float, low: float, high: float) -> None:
    mirror = limited(difference, low, high)
    commands = excitation(mirror, 200)
    assert all(mirror.limits.allow(signals) for signals in commands.signals)


@pytest.mark.parametrize("difference", [0.5, 1.0, 2.0])
def test_every_actuator_turns_over_a_wide_swing(difference: float) -> None:
    signals = excitation(limited(difference), 150).signals
    change = np.diff(signals, axis=0)
    assert ((change[1:] * change[:-1] < 0.0).sum(axis=0) >= 50).all()
    assert (np.ptp(signals, axis=0) > 1.5).all()


def test_actuators_that_move_one_after_the_other_turn_too() -> None:
    steps = np.random.default_rng(4).uniform(-1.0, 1.0, (160, 4))
    signals = np.zeros_like(steps)
    for row in range(1, 160):
        signals[row] = np.where(np.arange(4) == row % 4, steps[row], signals[row - 1])
    run = Run(signals, np.arange(160.0), Responses(np.zeros((160, 3)), 3, np.ones(160, dtype=bool)))
    assert check_excitation(run) == ()


def test_the_last_moves_are_checks() -> None:
    commands = excitation(make_mirror(rings=1), 200)
    assert commands.check.sum() == round(CHECK_SHARE * 200)
    assert commands.check[-int(commands.check.sum()) :].all()
    assert commands.degaussed == (160, 180)


@pytest.mark.parametrize("rings", [1, 2, 3])
@pytest.mark.parametrize("maps", [100, 150, 200, 300])
def test_some_of_the_checks_are_held(rings: int, maps: int) -> None:
    commands = excitation(make_mirror(rings=rings), maps)
    assert 4 * maps >= 100 * (commands.dwell[commands.check] > 0.0).sum() >= 2 * maps


def test_shapes_lean_to_one_side_for_minutes_and_some_maps_are_early() -> None:
    mirror = make_mirror(rings=2)
    commands = excitation(mirror, 300)
    squares = mirror.x**2 + mirror.y**2
    lean = commands.signals @ (squares - squares.mean())
    held = (commands.dwell > 0.0) & ~commands.in_use
    in_use = np.flatnonzero(commands.in_use & ~commands.check)
    one_way, other_way = np.split(lean[in_use], [len(in_use) // 2])
    assert 2.0 * one_way.min() > one_way.mean() > 0.0 > other_way.mean() > 2.0 * other_way.max()
    for half in np.split(lean[commands.check], 2):  # what the law is tested with bends either way
        assert 0.2 < (half > 0.0).mean() < 0.8
    first = np.arange(300) < np.median(np.flatnonzero(held))
    assert (lean[held & first] > 0.0).all()
    assert (lean[held & ~first] < 0.0).mean() > 0.9  # but for the one in the middle
    early = commands.settle_share < 1.0
    assert 0.15 < early[~commands.check].mean() < 0.4
    assert not (early & ((commands.dwell > 0.0) | commands.check)).any()


def test_every_other_shape_is_as_in_use_once_random_ones_tell_the_flat() -> None:
    mirror = make_mirror(rings=1)
    commands = excitation(mirror, 200)
    random, checks = FLAT_KNOWN * mirror.actuators, int(commands.check.sum())
    assert not commands.in_use[:random].any() and commands.in_use[commands.check].all()
    assert commands.in_use[random:-checks].mean() == pytest.approx(0.5, abs=0.01)
    assert next_part(mirror, 20, 1).in_use[:-4].mean() == 0.5


@pytest.mark.parametrize("difference", [0.5, 1.0, 2.0])
def test_random_signals_come_nearly_as_often_at_the_ends(difference: float) -> None:
    """The third of the range that is nearest to an end has a third of them, one in ten less."""
    commands = excitation(limited(difference), 2000)
    signals = commands.signals[~commands.in_use & (commands.dwell == 0.0)]
    assert (np.abs(signals) > 2.0 / 3.0).mean() > 0.3


def test_a_seed_is_a_sequence() -> None:
    one, same, other = (excitation(make_mirror(rings=1), 80, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.signals, same.signals)
    assert not np.array_equal(one.signals, other.signals)


@pytest.mark.parametrize("maps", [MAPS_MIN - 1, 100_000])
def test_another_number_of_maps_is_refused(maps: int) -> None:
    with pytest.raises(ValueError, match=f"hysteresis_maps = {maps}"):
        excitation(make_mirror(rings=1), maps)
