"""Positions of the actuators, which of them are neighbours, and their rings."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_common.geometry import hexagonal_positions, neighbour_pairs, pitch, ring_count, rings


def test_pdm30_37_pattern() -> None:
    x, y = hexagonal_positions(37, 4.3e-3)
    radius, angle = np.hypot(x, y), np.degrees(np.arctan2(y, x)) % 360
    assert radius[0] == 0
    assert radius[1:7] == pytest.approx(4.3e-3)
    assert sorted(set(np.round(radius[7:19] * 1e3, 3))) == [round(4.3 * math.sqrt(3), 3), 8.6]
    assert radius[[19, 22, 25, 28, 31, 34]] == pytest.approx(12.9e-3)
    assert radius.max() == pytest.approx(12.9e-3)
    for ring in (slice(1, 7), slice(7, 19), slice(19, 37)):
        assert (np.diff(angle[ring]) > 0).all()
        assert angle[ring][0] == pytest.approx(0)
    distance = np.hypot(x[:, None] - x, y[:, None] - y)
    assert distance[np.triu_indices(37, 1)].min() == pytest.approx(4.3e-3)


@settings(max_examples=20)
@given(st.floats(-3, 3), st.booleans(), st.booleans())
def test_orientation_of_the_pattern(start_angle: float, clockwise: bool, reflected: bool) -> None:
    x, y = hexagonal_positions(37, 4.3e-3, start_angle, clockwise, reflected)
    sign_x = -1 if reflected else 1
    for first in (1, 7, 19):
        angle = math.atan2(y[first], sign_x * x[first])
        assert math.remainder(angle - start_angle, 2 * math.pi) == pytest.approx(0, abs=1e-9)
    turn = x[1] * y[2] - y[1] * x[2]
    assert (turn > 0) == (clockwise == reflected)
    plain_x, plain_y = hexagonal_positions(37, 4.3e-3)
    assert np.hypot(x, y) == pytest.approx(np.hypot(plain_x, plain_y), abs=1e-12)


def test_neighbours_of_the_pattern() -> None:
    x, y = hexagonal_positions(37, 4.3e-3, start_angle=0.3)
    a, b = neighbour_pairs(x, y).T
    assert len(a) == 90  # edges of a triangular lattice hexagon of side 3: 9 s^2 + 3 s
    assert (a < b).all()
    counts = np.bincount(np.concatenate([a, b]), minlength=37)
    assert (counts[:19] == 6).all()
    assert sorted(counts[19:]) == [3] * 6 + [4] * 12
    assert set(zip(a[a == 0], b[a == 0], strict=True)) == {(0, k) for k in range(1, 7)}


def test_two_actuators_at_one_place_are_refused() -> None:
    with pytest.raises(ValueError, match="actuators 1 and 3 are at the same place"):
        neighbour_pairs(np.array([0.0, 1.0, 0.0]), np.zeros(3))


@pytest.mark.parametrize(("actuators", "rings"), [(1, 0), (7, 1), (19, 2), (37, 3), (61, 4)])
def test_full_patterns(actuators: int, rings: int) -> None:
    assert ring_count(actuators) == rings
    assert hexagonal_positions(actuators)[0].size == actuators


@pytest.mark.parametrize("actuators", [0, 2, 36, 38])
def test_other_numbers_have_no_pattern(actuators: int) -> None:
    with pytest.raises(ValueError, match=f"mirror.actuators = {actuators}"):
        ring_count(actuators)


def test_rings_come_from_positions() -> None:
    assert rings(*hexagonal_positions(37)).tolist() == [0] + [1] * 6 + [2] * 12 + [3] * 18
    shuffled = np.random.default_rng(0).permutation(37)
    x, y = hexagonal_positions(37)
    assert (rings(x[shuffled], y[shuffled]) == rings(x, y)[shuffled]).all()
    assert rings(np.zeros(1), np.zeros(1)).tolist() == [0]
    assert rings(np.array([0.0, 1.0, -1.0, 9.0]), np.zeros(4)).max() >= 1


def test_pitch_is_the_smallest_distance() -> None:
    assert pitch(*hexagonal_positions(19, 3e-3)) == pytest.approx(3e-3)
